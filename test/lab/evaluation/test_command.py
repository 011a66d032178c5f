from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import typer
from recordings import ODOMETRY, TRUTH, small_settings, traverse, write_mcap
from tiny_worlds import pose_at, world_arrays
from typer.testing import CliRunner

from umf_ros.core.config import dump_settings
from umf_ros.core.errors import ConfigError, UmfError
from umf_ros.lab.commands import evaluate

app = typer.Typer()
app.callback()(lambda: None)  # so that the name of its command is read
app.command("evaluate")(evaluate.command)


def run(*arguments: str) -> str:
    found = CliRunner().invoke(app, arguments, catch_exceptions=True)
    if isinstance(found.exception, UmfError):
        raise found.exception
    assert found.exit_code == 0, found.output
    return found.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "either a recording or --worlds"),
        (["a.mcap", "--worlds", "test"], "either a recording or --worlds"),
        (["--worlds", "mars"], "expected test or validation, not 'mars'"),
        (["--worlds", "etna"], "etna: with --methods all"),
        (["--worlds", "etna", "--methods", "all", "--count", "2"], "etna has no use for --count"),
        (["--worlds", "test", "--methods", "some"], "expected umf or all"),
        (["there.mcap", "--methods", "all", "--embedder", "umf"], "a recording has no use for --embedder"),
        (["nowhere.mcap", "--trained", "runs"], "--trained names weights of other methods"),
        (["nowhere.mcap"], "no recording"),
        (["nowhere.yaml"], "cannot read nowhere.yaml"),
        (["nowhere.yaml", "--odometry", "a.tum"], "a list of sequences has no use for --odometry"),
        (["nowhere.yaml", "--methods", "all", "--seed", "0"], "a list of sequences has no use for --seed"),
        (["--worlds", "test", "--rule", "robotcar", "--config", "a"], "simulated worlds have no use for --rule, --con"),
        (["there.mcap", "--quick"], "a recording has no use for --quick"),
        (["nowhere.yaml", "--rule", "kitti"], "expected s3li or robotcar, not 'kitti'"),
    ],
)
def test_wrong_arguments_are_one_clear_line(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.mcap").touch()
    with pytest.raises(UmfError, match=message) as raised:
        run("evaluate", *arguments)
    assert "\n" not in str(raised.value)


def test_a_recording_from_end_to_end(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "a.mcap", traverse(4))
    config = tmp_path / "config.yaml"
    config.write_text(dump_settings(small_settings(tmp_path)))
    figures = tmp_path / "figures.json"
    arguments = ["--embedder", "scan_context", "--config", str(config), "--out", str(tmp_path / "results")]
    output = run("evaluate", str(bag), "--dataset", "simulated", "--json", str(figures), *arguments)
    assert "fused" in output and "0 of them revisits" in " ".join(output.split())
    found = json.loads(figures.read_text())
    assert found["keyframes"] > 3 and found["queries"] == 0 and found["recall1"] is None
    folder = next((tmp_path / "results").iterdir())
    assert (folder / "evaluation.md").is_file() and json.loads((folder / "evaluation.json").read_text()) == found


def write_worlds(folder: Path, **changes: np.ndarray) -> Path:
    """A list of one world of two passes, the second 2 m to the side."""
    folder.mkdir()
    np.savez(folder / "world_00001.npz", **(world_arrays() | changes))
    (folder / "data.yaml").write_text("- worlds: .\n")
    return folder / "data.yaml"


def test_listed_sequences(tmp_path: Path, weights: Path) -> None:
    listing, figures = write_worlds(tmp_path / "data"), tmp_path / "figures.json"
    arguments = ["--weights", str(weights), "--out", str(tmp_path / "results"), "--json", str(figures)]
    output = run("evaluate", str(listing), *arguments)
    assert "world_00001, cloud" in output
    found = json.loads(figures.read_text())
    assert found["recall1_fused_mean"] == found["recall1_image_mean"] == 1.0  # both passes show the same
    assert found["recall1_within_5m_fused_mean"] == 1.0
    report = next((tmp_path / "results").glob("*/evaluation.md")).read_text()
    assert "| world_00001, fused | 6 | 100.0 |" in report and "rule s3li" in report
    turned = np.stack([pose_at(8.0 * (i % 6), 2.0 * (i >= 6), 90.0 * (i >= 6)) for i in range(12)])
    other = write_worlds(tmp_path / "turned", world_T_body=turned)
    with pytest.raises(ConfigError, match="no place is visited twice"):
        run("evaluate", str(other), *arguments)
    assert "100.0" in run("evaluate", str(other), *arguments, "--rule", "robotcar")


def test_a_recording_without_truth_is_refused(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "a.mcap", [entry for entry in traverse(1) if entry[0] not in (TRUTH, ODOMETRY)])
    with pytest.raises(ConfigError, match="--ground-truth"):
        run("evaluate", str(bag), "--out", str(tmp_path))
