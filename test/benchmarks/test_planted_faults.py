"""The script that plants faults: each is planted where it says, and its report names it."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.accuracy import planted_faults
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import load_settings

QUICK = {"embedding": {"method": "thumbnail"}, "loop": {"min_time_gap_s": 8.0}, "verification": {"refine_best": 1}}


def test_there_are_ten_and_none() -> None:
    names = [fault.name for fault in planted_faults.faults(load_settings(None))]
    assert names[0] == "none" and len(set(names)) == 11


@pytest.mark.parametrize("name", ["gap rules", "no cloud"])
def test_a_planted_fault_is_named_first(mini_bag: Path, tmp_path: Path, name: str) -> None:
    ((fault, _, sentence),) = planted_faults.first_sentences(mini_bag, tmp_path, QUICK, name)
    assert all(word.lower() in sentence.lower() for word in fault.words), sentence


def test_what_is_planted_is_in_the_recording(mini_bag: Path, tmp_path: Path) -> None:
    late = next(fault for fault in planted_faults.faults(load_settings(None)) if fault.name == "clock offset")
    bag = open_bag(mini_bag)
    planted_faults.plant(late, bag, {}, tmp_path)
    stamps = [
        [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, _, m in one.messages(["/bf_lidar/points_raw"])]
        for one in (bag, open_bag(tmp_path / "planted.mcap"))
    ]
    assert {after - before for before, after in zip(*stamps, strict=True)} == {500_000_000}


def test_the_first_sentence_is_read_from_the_page() -> None:
    page = 'x <p class="verdict bad">A &amp; B are 1.5 m off. 3 closures.</p> y'
    assert planted_faults.first_sentence(page) == "A & B are 1.5 m off"


def test_a_clock_that_is_off_is_measured_and_a_good_recording_says_nothing(
    mini_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = planted_faults.measured_offset(open_bag(mini_bag), "lidar", 0.5)
    assert found == pytest.approx(0.5, abs=0.1)
    assert planted_faults.print_findings(mini_bag), capsys.readouterr().out
