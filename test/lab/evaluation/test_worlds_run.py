"""An evaluation on worlds from the weights to the report, and what a preset costs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from landmarks import LineWorld, frame_of
from tiny_worlds import TINY

from umf_ros.frames import Frame
from umf_ros.lab.evaluation import worlds_run
from umf_ros.lab.evaluation.latency import cost_of_weights
from umf_ros.lab.evaluation.worlds_run import PICTURES, WorldsRun
from umf_ros.networks.umf import UMF, count_parameters
from umf_ros.networks.weights import save_weights


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.safetensors"
    save_weights(UMF(TINY), path, {})
    return path


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def textured(stamp: int) -> Frame:
    rng = np.random.default_rng(stamp)
    points = rng.uniform([2, -15, -1], [35, 15, 1], (2000, 3)).astype(np.float32)
    image = rng.integers(0, 255, (48, 64)).astype(np.uint8)
    return replace(frame_of(stamp, 1), left=image, points=points, intensity=np.zeros(2000, np.float32))


def test_tables_figures_and_pictures_of_a_small_network(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the thesis's network takes a minute to convert
    monkeypatch.setattr(worlds_run, "cost_of_weights", lambda _, frames, repeats: cost_of_weights(weights, frames, 1))
    told: list[tuple[str, int]] = []
    run = WorldsRun(weights, [LineWorld()], 1, True, lambda what, done: told.append((what, done)))  # type: ignore[list-item]
    summary = run.run()
    folder = tmp_path / "results"
    folder.mkdir()
    run.write(summary, folder, ["a note"])
    assert json.loads((folder / "evaluation.json").read_text()) == summary.flat()
    assert summary.flat()["parameters_default"] == count_parameters(UMF(TINY))
    text = (folder / "evaluation.md").read_text()
    assert "a note" in text and "scan_context" in text
    for picture in PICTURES.values():
        assert (folder / picture).stat().st_size > 5000 and f"({picture})" in text
    line = LineWorld()
    assert sum(done for what, done in told if what == line.name) == len(line) + line.revisits
    assert [what for what, _ in told[-2:]] == ["taking times", "drawing"]


def test_a_network_is_timed_in_both_runtimes(weights: Path) -> None:
    found = cost_of_weights(weights, [textured(stamp) for stamp in range(2)], repeats=1)
    assert found.name == weights.stem and found.parameters == count_parameters(UMF(TINY))
    assert found.eager_ms > 0 and found.fast_ms > 0
