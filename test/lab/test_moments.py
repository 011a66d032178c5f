"""Moments of a recording as a person names them."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import make_frame

from umf_ros.core.errors import BagError
from umf_ros.lab.evaluation.place_views import nearest_frames, parse_moment, split_reference

FRAMES = [make_frame(1_625_680_800 + 0.25 * number) for number in range(40)]


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("0", 0.0),
        ("12.5", 12.5),
        ("1625680800123456789", 1_625_680_800_123_456_789),
        ("1625680800.123456789", 1_625_680_800_123_456_789),
        ("1625680800", 1_625_680_800_000_000_000),
    ],
)
def test_stamps_and_seconds_are_told_apart(text: str, moment: int | float) -> None:
    found = parse_moment(text)
    assert found == moment and type(found) is type(moment)


@pytest.mark.parametrize("text", ["soon", "", "-1", "nan", "inf", "2e9", "1_0"])
def test_what_is_no_moment(text: str) -> None:
    with pytest.raises(ValueError, match=r"neither a stamp|before the start"):
        parse_moment(text)


def test_a_reference_is_a_recording_and_a_moment(tmp_path: Path) -> None:
    assert split_reference("a/b.mcap@12.5") == (Path("a/b.mcap"), "12.5")
    assert split_reference("me@home/b.mcap@1") == (Path("me@home/b.mcap"), "1")
    for text in ("a/b.npy", "", "@5", "me@home/b.npy"):
        assert split_reference(text) is None
    (tmp_path / "scan@2.npy").touch()
    assert split_reference(str(tmp_path / "scan@2.npy")) is None


def test_the_nearest_frames_are_found_in_any_order() -> None:
    stamp = FRAMES[10].stamp_ns
    found = nearest_frames(FRAMES, [stamp + 100_000_000, 0.6, 0.0])
    assert [FRAMES.index(one) for one in found] == [10, 2, 0]


def test_no_more_is_read_than_needed() -> None:
    left = iter(FRAMES)
    nearest_frames(left, [1.0])
    assert len(list(left)) > 25


def test_a_moment_off_the_recording_is_refused_alone() -> None:
    near, far = nearest_frames(FRAMES, [1.0, 100.0])
    assert near is FRAMES[4]
    assert isinstance(far, BagError) and "no frame within a second of 100.0; the nearest is at" in str(far)
    with pytest.raises(BagError, match="no frame"):
        nearest_frames([], [1.0])
