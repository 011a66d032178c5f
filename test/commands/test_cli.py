"""The command line as a whole: help, versions, and what a user can get wrong."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from command_line import only_line, umf

from umf_ros import __version__, cli
from umf_ros.commands import doctor as checks
from umf_ros.core.errors import either
from umf_ros.core.resources import dataset_names

GROUPS = {
    "bench": ["places"],
    "fleet": ["setup", "add"],
    "graph": ["optimize", "plot"],
    "map": ["make", "edit", "grow", "export"],
    "places": ["list", "delete"],
}
COMMANDS = [name for name in cli.COMMANDS if name not in GROUPS]


@pytest.fixture(autouse=True)
def somewhere_empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Commands run where nothing is, so that whatever they leave is seen."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def left_behind(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_sessions_of_a_map_are_not_deleted_behind_its_back(tmp_path: Path) -> None:
    """It lists them: no command could open it any more."""
    (tmp_path / "map.json").write_text("{}")
    (tmp_path / "places.sqlite").touch()
    ended = umf("places", "delete", tmp_path / "places.sqlite", "--session", "0", "--yes")
    assert "is of a map" in only_line(ended)


def test_help_lists_every_command_with_one_line() -> None:
    ended = umf("--help")
    assert ended.status == 0
    for name in [*COMMANDS, *GROUPS]:
        (line,) = [line for line in ended.out.splitlines() if line.startswith(f"│ {name} ")]
        assert len(line.strip("│ ").removeprefix(name).strip()) > 10


@pytest.mark.parametrize("command", ["replay", "explain", "evaluate"])
def test_help_names_the_data_sets(command: str) -> None:
    names = dataset_names()
    assert {"simulated", "s3li-etna", "s3li-vulcano"} <= set(names)
    assert f"{either(['auto', *names])}." in umf(command, "--help").text


@pytest.mark.parametrize("words", [[name] for name in COMMANDS] + [[g, c] for g, cs in GROUPS.items() for c in cs])
def test_every_command_explains_itself_and_its_options(words: list[str]) -> None:
    ended = umf(*words, "--help")
    assert ended.status == 0 and ended.err == ""
    assert f"Usage: umf {' '.join(words)} " in ended.text and len(ended.text) > 150
    assert umf(*words, "-h").out == ended.out


@pytest.mark.parametrize("words", [["replay"], ["evaluate"], ["map", "make"]])
def test_paragraphs_of_the_help_fill_their_lines(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    prose = umf(*words, "--help").out.partition("╭")[0].splitlines()
    for line, after in pairwise(line.strip() for line in prose):
        assert not line or not after or len(f"{line} {after.split()[0]}") > 78, line


def test_without_a_command_the_help_is_shown() -> None:
    ended = umf()
    assert ended.status == 2 and "Usage: umf" in ended.text and "replay" in ended.text


def test_the_version_is_the_package_s() -> None:
    assert umf("--version").out == f"umf_ros {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["repaly"], "repaly"),
        (["--verbose"], "--verbose"),
        (["replay"], "missing argument 'bag'"),
        (["replay", "a.mcap", "b.mcap"], "b.mcap"),
        (["replay", "a.mcap", "--confg", "x.yaml"], "--config"),  # the nearest option is offered
        (["replay", "a.mcap", "--min-probability", "2"], "'--min-probability'"),
        (["replay", "a.mcap", "--min-probability", "high"], "'--min-probability'"),
        (["demo", "--seed", "-1"], "'--seed'"),
        (["demo", "--seed", "one"], "'--seed'"),
        (["demo", "--rate", "0"], "'--rate'"),
        (["demo", "--duration", "5"], "'--duration'"),
        (["play", "a.mcap", "--rate", "-1"], "'--rate'"),
        (["simulate", "a.mcap", "--workers", "0"], "'--workers'"),
        (["evaluate", "--worlds", "test", "--seed", "-3"], "'--seed'"),
        (["explain", "a.mcap", "1"], "missing argument 'match'"),
        (["explain", "a.mcap", "soon", "1"], "'soon' is neither a stamp in ns nor seconds"),
        (["explain", "a.mcap", "5", "--", "-1"], "'-1' is before the start"),
        (["explain", "a.mcap", "nan", "1"], "'nan' is neither a stamp in ns nor seconds"),
        (["why", "results", "-5"], "-5 is before the start"),
        (["export"], "missing argument 'out'"),
    ],
)
def test_wrong_usage_is_status_2_and_names_the_fault(somewhere_empty: Path, arguments: list[str], word: str) -> None:
    ended = umf(*arguments)
    assert ended.status == 2
    assert word in ended.text.lower() and "Traceback" not in ended.text
    assert ended.out == "" and left_behind(somewhere_empty) == []


NO_BAG = "there is no recording nowhere.mcap"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["demo", "--bag", "nowhere.mcap"], NO_BAG),
        (["doctor", "--dry-run"], "the checks of the machine have no use for --dry-run"),
        (["demo", "--out", "/proc/results"], "cannot write to /proc/results"),
        (["replay", "nowhere.mcap"], NO_BAG),
        (["play", "nowhere.mcap", "--rate", "2"], NO_BAG),
        (["report", "nowhere", "nowhere.mcap"], NO_BAG),
        (["evaluate", "nowhere.mcap"], NO_BAG),
        (["explain", "nowhere.mcap", "1", "0"], NO_BAG),
        (["simulate"], "say where to write: OUT.mcap, --shards DIR or --contact-sheet OUT.png"),
        (["simulate", "a.mcap", "--scale", "0.1", "--ray", "local"], "a drive has no use for --ray, --scale"),
        (["simulate", "s3li-twin", "--out", "a", "--family", "moon"], "a twin of S3LI has no use for --family"),
        (["simulate", "--shards", "a", "--truth", "--seed", "3"], "a folder of worlds has no use for --seed, --truth"),
        (["simulate", "--shards", "a", "--sequences", "etna", "--ray", "local"], "sequences has no use for --ray"),
        (["simulate", "a.mcap", "--contact-sheet", "a.png"], "a contact sheet has no use for OUT.mcap"),
        (["demo", "--bag", "nowhere.mcap", "--duration", "20"], "a recording has no use for --duration"),
        (["sensors", "nowhere.mcap", "--seed", "2"], "a recording has no use for --seed"),
        (["replay", "nowhere.mcap", "--mode", "mapping", "--map", "a"], "a mapping run has no use for --map"),
        (["train", "--recipe", "umf_scene", "--steps", "3"], "a recipe has no use for --steps"),
        (["train", "a", "--method", "dbow2", "--resume"], "a vocabulary has no use for --resume"),
        (["export", "net.xml", "--calibration", "a"], "a model of float32 has no use for --calibration"),
        (["map", "edit", "a", "--accept", "1", "2", "--reject", "1", "2"], "given for the same closure"),
        (["simulate", "drive.bag"], "cannot write drive.bag: the name must end in .mcap"),
        (["simulate", "drive.mcap", "--preset", "olympus"], "unknown preset 'olympus'"),
        (["sensors", "nowhere.mcap"], NO_BAG),
        (["places", "delete", "nowhere.sqlite", "--session", "1"], "there is no place database nowhere.sqlite"),
        (["evaluate", "--worlds", "test", "--methods", "some"], "--methods: expected umf or all, not 'some'"),
        (["export", "/proc/version/net.xml"], "cannot write to /proc/version"),
        (["export", "net.onnx"], "net.onnx: OpenVINO's files end in .xml"),
        (["export", "net.xml", "--weights", "nowhere.safetensors"], "nowhere.safetensors"),
        (["graph", "optimize", "nowhere.g2o"], "nowhere.g2o"),
        (["graph", "plot", "nowhere.g2o"], "nowhere.g2o"),
        (["replay", "x" * 5000], "xxx: File name too long"),
        (["graph", "optimize", "x" * 5000], "File name too long"),
        (["places", "list", "x" * 5000], "File name too long"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(
    somewhere_empty: Path, arguments: list[str], message: str
) -> None:
    assert message in only_line(umf(*arguments))
    assert [name for name in left_behind(somewhere_empty) if name != "results"] == []


def test_a_name_that_is_not_utf8_is_one_line(somewhere_empty: Path) -> None:
    name = os.fsdecode(b"m\xfcll.mcap")
    (somewhere_empty / "drives").mkdir()
    (somewhere_empty / "drives" / name).touch()
    for arguments in (["replay", name], ["replay", "drive.mcap", "--out", name], ["map", "drives", "--out", "map"]):
        assert "m\\udcfcll.mcap' is not UTF-8; rename it" in only_line(umf(*arguments))


def test_an_exported_network_can_be_read_by_its_runtime(somewhere_empty: Path) -> None:
    from umf_ros.embedding.runtimes import openvino_core

    ended = umf("export", "net.xml")
    assert ended.status == 0 and left_behind(somewhere_empty) == ["net.bin", "net.xml"]
    assert ended.out.startswith("net.xml: ") and "MB of weights" in ended.out
    model = openvino_core().read_model("net.xml")
    assert next(port.get_any_name() for port in model.inputs) == "image"
    assert f"{len(model.inputs)} inputs, {len(model.outputs)} outputs" in ended.out


def test_ctrl_c_is_status_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted() -> list[object]:
        raise KeyboardInterrupt

    monkeypatch.setattr(checks, "checks", interrupted)
    ended = umf("doctor")
    assert ended.status == 130 and "Traceback" not in ended.text


def test_a_reader_that_goes_away_is_no_traceback() -> None:
    command = f"{sys.executable} -m umf_ros.cli evaluate --help | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120, check=False)
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr


def test_advice_keeps_its_brackets(monkeypatch: pytest.MonkeyPatch) -> None:
    finding = checks.Finding("ROS 2 Python", False, "[Errno 2] not there", "pip install 'ros-rclpy[fastrtps]==7.1.6'")
    monkeypatch.setattr(checks, "checks", lambda: [("ROS 2 Python", lambda: finding)])
    ended = umf("doctor")
    assert ended.status == 1
    assert "pip install 'ros-rclpy[fastrtps]==7.1.6'" in ended.out and "[Errno 2] not there" in ended.out
