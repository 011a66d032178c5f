"""`umf explain`: why two moments of a recording are, or are not, the same place."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import Ended, only_line, umf
from recordings import LEFT, ODOMETRY, START_NS, image, small_settings, traverse, write_mcap

from umf_ros.core.config import dump_settings
from umf_ros.core.frames import Image
from umf_ros.verification.measurement import MEASUREMENTS


def probability(ended: Ended) -> float:
    found = re.search(r"probability ([\d.]+)", ended.out)
    return float(found[1]) if found else 0.0


@pytest.fixture(scope="module")
def loop_again(mini_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Ended, Path]:
    """The rover is at the same place of its loop 12 s later."""
    picture = tmp_path_factory.mktemp("explained") / "again.png"
    return umf("explain", mini_bag, "12.5", "2.2", "--out", picture), picture


def test_the_same_place_is_accepted_and_its_numbers_are_told(loop_again: tuple[Ended, Path]) -> None:
    ended, picture = loop_again
    assert ended.status == 0, ended.text
    assert "accepted" in ended.out and probability(ended) > 0.9, ended.out
    numbers = re.findall(r"^  (\w+) +(\S+) +(\S.*)$", ended.out, re.M)
    assert len(numbers) > 3 and all(float(value) >= 0 and MEASUREMENTS[name] == text for name, value, text in numbers)
    assert f"wrote {picture}" in ended.out


def test_the_picture_shows_both_views_and_scans(loop_again: tuple[Ended, Path]) -> None:
    _, picture = loop_again
    drawn = cv2.imread(str(picture))
    assert drawn.shape == (1100, 1500, 3)
    blue, green, red = np.moveaxis(drawn.astype(int), 2, 0)
    assert ((green > red + 60) & (green > blue + 60)).sum() > 50  # lines between the images
    assert ((red > blue + 100) & (red > green + 50)).sum() > 50  # the scan of the query
    assert ((blue > red + 100) & (blue > green + 50)).sum() > 50  # that of the match


@pytest.fixture
def small(tmp_path: Path) -> tuple[Path, list[str | Path]]:
    """A small recording, and the options for it: no network, a calibration of its own."""
    config = tmp_path / "config.yaml"
    config.write_text(dump_settings(small_settings(tmp_path)))
    bag = write_mcap(tmp_path / "small.mcap", traverse(4.0))
    return bag, ["--config", config, "--embedder", "thumbnail", "--out", tmp_path / "explained.png"]


def test_moments_are_seconds_from_the_start_or_stamps(small: tuple[Path, list[str | Path]], tmp_path: Path) -> None:
    bag, options = small
    # the scans are keyed 0.1 s after their stamp, one every 0.21 s
    later, earlier = START_NS + 100_000_000 + 15 * 212_765_957, START_NS + 100_000_000
    by_stamp = umf("explain", bag, str(later), str(earlier), *options)
    drawn: Image = cv2.imread(str(tmp_path / "explained.png"))
    by_seconds = umf("explain", bag, "3.2", "0", *options)
    assert by_stamp.status == by_seconds.status == 0, by_stamp.text
    assert by_stamp.out == by_seconds.out and "rejected" in by_stamp.out
    assert (cv2.imread(str(tmp_path / "explained.png")) == drawn).all()


@pytest.mark.parametrize(
    ("moments", "message"),
    [
        (["99", "1"], "no frame within a second of 99.0; the nearest is at"),
        (["1", "1625680700000000000"], "no frame within a second of 1625680700000000000; the nearest is at"),
    ],
)
def test_a_moment_that_was_not_recorded_is_named(
    small: tuple[Path, list[str | Path]], tmp_path: Path, moments: list[str], message: str
) -> None:
    bag, options = small
    assert message in only_line(umf("explain", bag, *moments, *options))
    assert not (tmp_path / "explained.png").exists()


def test_a_picture_that_cannot_be_written_is_one_line(small: tuple[Path, list[str | Path]], tmp_path: Path) -> None:
    bag, options = small
    target = tmp_path / "nowhere" / "explained.png"
    assert f"cannot write {target}" in only_line(umf("explain", bag, "3", "1", *options[:-1], target))


def test_a_picture_has_the_name_that_was_given(small: tuple[Path, list[str | Path]], tmp_path: Path) -> None:
    bag, options = small
    assert umf("explain", bag, "3", "1", *options[:-1], tmp_path / "picture").status == 0
    assert (tmp_path / "picture").read_bytes().startswith(b"\x89PNG")
    refused = umf("explain", bag, "3", "1", *options[:-1], tmp_path / "picture.odd")
    assert "picture.odd: Format 'odd'" in only_line(refused)


def test_a_recording_whose_images_are_all_refused_is_one_line(tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(dump_settings(small_settings(tmp_path)))
    wrong = [(LEFT, START_NS + i, image(START_NS + i, np.zeros((4, 4), np.uint8))) for i in range(3)]
    bag = write_mcap(tmp_path / "wrong.mcap", wrong)
    line = only_line(umf("explain", bag, "0", "0", "--config", config, "--embedder", "thumbnail"))
    assert line == "the recording has no frame with an image or a scan"


def test_a_recording_without_sensors_is_one_line(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "odometry.mcap", [entry for entry in traverse(1.0) if entry[0] == ODOMETRY])
    assert "no topic of a known data set" in only_line(umf("explain", bag, "0", "0"))
