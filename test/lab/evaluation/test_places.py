"""Sets of still images and scans: reading them, their truth, and the figures."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from umf_ros.core.config import EmbeddingSettings, Verification
from umf_ros.core.errors import ConfigError, UmfError
from umf_ros.embedding import make_embedder
from umf_ros.lab.commands import evaluate
from umf_ros.lab.commands.evaluate import lists_place_sets
from umf_ros.lab.evaluation.places import read_place_sets, read_truth, score_places

PLACES = 6
SHIFT = 2
"""The n-th query shows the place of reference n + 2."""


def picture(place: int, noise: int) -> np.ndarray:
    scene = np.kron(np.random.default_rng(place).integers(30, 220, (8, 10)), np.ones((15, 16)))
    return np.clip(scene + np.random.default_rng(100 + noise).normal(0, 6, scene.shape), 0, 255).astype(np.uint8)


def scan(place: int, noise: int) -> np.ndarray:
    rng = np.random.default_rng(place)
    walls = np.concatenate([np.column_stack([rng.uniform(2, 40, 80) * np.ones(80), y, z]) for y, z in _sheets(rng)])
    jitter = np.random.default_rng(200 + noise).normal(0, 0.02, walls.shape)
    return np.column_stack([walls + jitter, np.full(len(walls), 0.5)]).astype(np.float32)


def _sheets(rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(rng.uniform(-15, 15) + rng.uniform(0, 3, 80), rng.uniform(-1, rng.uniform(0, 8), 80)) for _ in range(6)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("asked", "known", "asked_scans", "known_scans"):
        (tmp_path / name).mkdir()
    for place in range(PLACES):
        cv2.imwrite(str(tmp_path / f"known/{place:03d}.png"), picture(place, place))
        scan(place, place).tofile(tmp_path / f"known_scans/{place:03d}.bin")
    for query in range(PLACES - SHIFT):
        cv2.imwrite(str(tmp_path / f"asked/{query:03d}.png"), picture(query + SHIFT, 50 + query))
        scan(query + SHIFT, 50 + query).tofile(tmp_path / f"asked_scans/{query:03d}.bin")
    (tmp_path / "truth.csv").write_text("".join(f"{query},{query + SHIFT}\n" for query in range(PLACES - SHIFT)))
    (tmp_path / "places.yaml").write_text(
        "- {name: walls, queries: asked, references: known, truth: truth.csv, kind: image}\n"
        "- {name: sheets, queries: asked_scans, references: known_scans, truth: truth.csv, kind: scan}\n"
    )
    return tmp_path


def test_every_place_is_found_by_methods_that_see_it(folder: Path) -> None:
    images, scans = read_place_sets(folder / "places.yaml")
    thumbnail = score_places(images, make_embedder(EmbeddingSettings(method="thumbnail")), Verification())
    context = score_places(scans, make_embedder(EmbeddingSettings(method="scan_context")), Verification())
    for found, name in ((thumbnail, "walls"), (context, "sheets")):
        assert found.flat == {
            f"{name}.recall1": 1.0,
            f"{name}.recall5": 1.0,
            f"{name}.auc_pr": 1.0,
            f"{name}.recall_at_precision1": 1.0,
            f"{name}.recall1_reranked": None,
        }
        assert (found.plain.queries, found.references) == (PLACES - SHIFT, PLACES)


def test_a_wrong_truth_lowers_the_figures(folder: Path) -> None:
    (folder / "truth.csv").write_text("0,2\n1,3,0\n2,0\n\n3,1\n")
    images, _ = read_place_sets(folder / "places.yaml")
    found = score_places(images, make_embedder(EmbeddingSettings(method="thumbnail")), Verification()).flat
    assert found["walls.recall1"] == 0.5
    assert found["walls.recall5"] >= found["walls.recall1"]


def test_the_command_reranks_with_the_network_and_writes_the_figures(folder: Path) -> None:
    app = typer.Typer()
    app.command()(evaluate.command)
    (folder / "results").mkdir()
    (folder / "results" / "latest").symlink_to("a run")
    (folder / "settings.yaml").write_text("verification: {rerank_features: 100}\n")
    arguments = [
        str(folder / "places.yaml"),
        "--config",
        str(folder / "settings.yaml"),
        "--json",
        str(folder / "f.json"),
        "--out",
        str(folder / "results"),
    ]
    found = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert found.exit_code == 0, found.output
    figures = json.loads((folder / "f.json").read_text())
    names = {"recall1", "recall5", "recall1_reranked", "auc_pr", "recall_at_precision1"}
    assert set(figures) == {f"{each}.{name}" for each in ("walls", "sheets") for name in names}
    assert figures["walls.recall1_reranked"] == 1.0
    assert "walls" in next((folder / "results").rglob("evaluation.md")).read_text()
    assert str((folder / "results" / "latest").readlink()) == "a run"  # the report of a run stays in reach


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,1\n", "line 1: expected"),
        ("0,1\n4,0\n", "line 2: there are 4 queries and 6 references"),
        ("0,6\n", "line 1: there are 4"),
        ("0\n1\n", "no query has a true match"),
    ],
)
def test_a_damaged_truth_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "truth.csv").write_text(text)
    with pytest.raises(UmfError, match=message):
        read_truth(tmp_path / "truth.csv", 4, 6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "expected a list of place sets"),
        ("- {name: a, queries: b, references: c, truth: d, kind: sound}", "kind"),
        ("- {queries: b, references: c, truth: d, kind: image}", "name"),
        ("\n".join(2 * ["- {name: a, queries: b, references: c, truth: d, kind: image}"]), "two sets have one name"),
    ],
)
def test_a_wrong_list_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "places.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_place_sets(tmp_path / "places.yaml")


def test_an_empty_folder_and_a_broken_image_are_refused(folder: Path) -> None:
    images, scans = read_place_sets(folder / "places.yaml")
    with pytest.raises(UmfError, match="holds no scan"):
        scans.frames(folder / "asked", None)
    (folder / "asked/999.png").write_bytes(b"no picture")
    with pytest.raises(UmfError, match=r"999\.png cannot be read"):
        images.frames(folder / "asked", None)


def test_lists_of_sequences_are_another_kind_of_list(tmp_path: Path) -> None:
    (tmp_path / "sequences.yaml").write_text("- worlds: somewhere\n")
    assert not lists_place_sets(tmp_path / "sequences.yaml")
    assert not lists_place_sets(tmp_path / "nowhere.yaml")


def test_a_calibration_turns_scans_into_the_body_frame(folder: Path) -> None:
    from umf_ros.sensors.calibration import load_calibration

    calibration = load_calibration("simulated")
    _, scans = read_place_sets(folder / "places.yaml")
    plain, turned = scans.frames(folder / "known_scans", None)[0], scans.frames(folder / "known_scans", calibration)[0]
    rotation, shift = calibration.body_T_lidar[:3, :3], calibration.body_T_lidar[:3, 3]
    np.testing.assert_allclose(turned.points, plain.points @ rotation.T + shift, atol=1e-4)
