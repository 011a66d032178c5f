"""`umf why` on a run folder, as a user runs it."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import only_line, umf
from recordings import START_NS, small_settings, traverse, write_mcap

from umf_ros.core.config import dump_settings


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A replay of a drive without a loop, with gaps so short that everything is a candidate."""
    folder = tmp_path_factory.mktemp("why")
    gaps = {"loop__min_time_gap_s": 1.0, "loop__min_travel_m": 0.5, "keyframe__min_translation_m": 0.2}
    (folder / "config.yaml").write_text(dump_settings(small_settings(folder, **gaps)))
    bag = write_mcap(folder / "small.mcap", traverse(4.0))
    options = ["--config", folder / "config.yaml", "--embedder", "thumbnail", "--out", folder / "out"]
    ended = umf("replay", bag, *options)
    assert (folder / "out" / "latest" / "report.html").is_file(), ended.text
    return folder / "out" / "latest"


def test_it_names_the_gate_and_lists_what_was_returned(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")  # no cell is cut
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    ended = umf("why", run, "3.5")
    assert ended.status == 0, ended.text
    lines = ended.out.splitlines()
    assert lines[0].startswith("keyframe ") and lines[0].endswith(" ns")
    assert lines[1].split(":")[0] in ("pose", "selection", "probability", "objection", "retrieval", "found")
    assert "would accept it: " in ended.out and "m by the truth" in ended.out
    assert f"umf explain {run} {lines[0].split()[-2]} " in ended.out
    assert {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()} == before


def test_a_moment_is_a_stamp_or_seconds(run: Path) -> None:
    by_seconds = umf("why", run, "0.2").out
    assert "gap rules: the gap rules allow no match" in by_seconds
    assert umf("why", run, str(START_NS + 300_000_000)).out == by_seconds


def test_what_is_wrong_is_one_line(run: Path, tmp_path: Path) -> None:
    for command in ("why", "judge", "report"):
        assert only_line(umf(command, "nowhere")) == "there is no run nowhere"
        assert only_line(umf(command, tmp_path)) == f"{tmp_path} holds no finished run: summary.json is missing"
        assert only_line(umf(command, run.parent)).endswith(f"holds runs and is none; did you mean {run}?")
        assert only_line(umf(command, bag := run.parents[1] / "small.mcap")).endswith(f"umf replay {bag} makes one")
    for moment in ("500", str(START_NS - 2 * 10**9)):
        line = only_line(umf("why", run, moment))
        assert line.startswith(
            f"{moment} is outside of {run}: its keyframes are at 0 to 3.4 s, {START_NS + 100_000_000} "
        )
    ended = umf("why", run, "soon")
    assert ended.status == 2 and "'soon' is neither a stamp in ns nor seconds from the start" in ended.text
