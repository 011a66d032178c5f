"""Every command that the program prints runs as it is printed, from the folder that the user is in."""

from __future__ import annotations

import html
import json
import re
import shlex
from pathlib import Path

import pytest
from command_line import Ended, umf
from recordings import CLOUD, LEFT, ODOMETRY, RIGHT, small_settings, traverse, write_mcap

from umf_ros.core.config import dump_settings
from umf_ros.runs.findings import USELESS

PRINTED = re.compile(r"\bumf (?:why|explain|replay|inspect|report|config) [^\n;<(]+")
GAPS = {"loop__min_time_gap_s": 1.0, "loop__min_travel_m": 0.5, "keyframe__min_translation_m": 0.2}


def printed(text: str) -> list[str]:
    """Commands in an output, without those that a sentence only mentions."""
    return [one.strip(" .") for one in PRINTED.findall(text)]


def run_all(commands: list[str]) -> list[Ended]:
    ended = [umf(*shlex.split(command)[1:]) for command in commands]
    for command, one in zip(commands, ended, strict=True):
        assert one.status in (0, USELESS), f"{command}\n{one.text}"
    return ended


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a blank in its name, which the user is in."""
    folder = tmp_path / "my drives"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def test_commands_of_a_run_without_closures(here: Path) -> None:
    (here / "own.yaml").write_text(dump_settings(small_settings(here, embedding__method="thumbnail", **GAPS)))
    bag = write_mcap(here / "a drive.mcap", [entry for entry in traverse(4.0) if "truth" not in entry[0]])
    told = umf("replay", bag.name, "--config", "own.yaml", "--out", "my results").out
    folder = "my results/latest"
    told += umf("why", folder).out + umf("why", folder, "3.4").out
    page = (here / folder / "report.html").read_text(encoding="utf-8")
    shown = html.unescape(page[: page.index('<script type="application/json"')])
    found = re.search(r'id="scene">(.*?)</script>', page, re.S)
    assert found
    scene = json.loads(found[1])
    commands = printed(told + shown) + [f"{scene['explain']} {' '.join(pair['stamps'])}" for pair in scene["pairs"][:1]]
    assert {shlex.split(one)[1] for one in commands} >= {"why", "explain"}, told
    run_all(list(dict.fromkeys(commands)))


@pytest.mark.parametrize("absent", [(), (CLOUD, RIGHT), (LEFT, RIGHT)], ids=str)
def test_commands_of_an_inspection(absent: tuple[str, ...], here: Path) -> None:
    renamed = {LEFT: "/l/image", RIGHT: "/r/image", CLOUD: "/scans", ODOMETRY: "/wheels"}
    drive = [(renamed[topic], *rest) for topic, *rest in traverse(22.0) if topic in renamed and topic not in absent]
    write_mcap(here / "a drive.mcap", drive)  # type: ignore[arg-type]
    first = umf("inspect", "a drive.mcap")
    (written,) = run_all(printed(first.out)) or [umf("inspect", "a drive.mcap", "--write", "config")]
    commands = printed(written.out)
    is_blind = absent == (CLOUD, RIGHT)
    assert (first.status, written.status, len(commands)) == ((USELESS, USELESS, 0) if is_blind else (0, 0, 1))
    for command in commands:
        assert umf(*shlex.split(command.replace("umf replay", "umf inspect"))[1:]).status == 0
        assert umf(*shlex.split(command)[1:], "--set", "embedding.method=scan_context").status in (0, USELESS)


def test_the_command_that_continues_a_run(here: Path) -> None:
    from umf_ros.runs.findings import conclude, judge, look_first
    from umf_ros.runs.reader import read_run
    from umf_ros.runs.run_file import NAME
    from umf_ros.runs.writer import read_summary, write_summary

    (here / "own.yaml").write_text(dump_settings(small_settings(here, embedding__method="thumbnail", **GAPS)))
    bag = write_mcap(here / "a drive.mcap", traverse(4.0))
    umf("replay", bag.name, "--config", "own.yaml", "--out", "my results")
    folder = (Path("my results") / "latest").resolve().relative_to(here)
    from umf_ros.runs.writer import begin_folder

    begin_folder(folder, bag)  # as if it had been interrupted
    write_summary(folder, read_summary(folder) | {"interrupted": True})
    assert (folder / NAME).exists()
    about = judge(read_run(folder), keep=False)
    findings = look_first(about)
    assert conclude(about, findings).mark != "good" and "did not end; so far: " in umf("judge", folder).out
    (command,) = [one for finding in findings for one in printed(finding.remedy) if "--resume" in one]
    run_all([command])
    assert read_summary(folder)["interrupted"] is False
