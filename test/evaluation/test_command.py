from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
from recordings import ODOMETRY, TRUTH, small_settings, traverse, write_mcap
from typer.testing import CliRunner

from umf_ros.commands import evaluate, pretrain
from umf_ros.config import dump_settings
from umf_ros.errors import ConfigError, UmfError

app = typer.Typer()
app.command("evaluate")(evaluate.command)
app.add_typer(pretrain.app, name="pretrain")


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
        (["--worlds", "test", "--methods", "some"], "expected umf or all"),
        (["nowhere.mcap"], "no recording"),
    ],
)
def test_wrong_arguments_are_one_clear_line(arguments: list[str], message: str) -> None:
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
    folder = tmp_path / "results" / "latest"
    assert (folder / "evaluation.md").is_file() and json.loads((folder / "evaluation.json").read_text()) == found


def test_a_recording_without_truth_is_refused(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "a.mcap", [entry for entry in traverse(1) if entry[0] not in (TRUTH, ODOMETRY)])
    with pytest.raises(ConfigError, match="--ground-truth"):
        run("evaluate", str(bag), "--out", str(tmp_path))


def test_pretraining_says_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="mask_ratio"):
        run("pretrain", "image", str(tmp_path), "--mask-ratio", "1.2")
    with pytest.raises(ConfigError, match="no worlds"):
        run("pretrain", "lidar", str(tmp_path), "--out", str(tmp_path / "run"))
