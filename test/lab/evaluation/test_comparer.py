"""Pairs are judged alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import CALIBRATION

from umf_ros.baselines.handcrafted import ThumbnailEmbedder
from umf_ros.core.config import Verification
from umf_ros.core.geometry import make_pose
from umf_ros.lab.evaluation.comparison import NO_CALIBRATION, NO_DEPTH, Comparer, judge, similarity_of
from umf_ros.lab.evaluation.place_views import PlaceView, ViewReader
from umf_ros.lab.scan_files import SensorFileError
from umf_ros.lab.simulation.scenes import landscape, pose_at, take, without_image
from umf_ros.verification import Verifier

GROUND = landscape(20)
MATCH, QUERY = (without_image(take(GROUND, pose_at(GROUND, x, 0.0, 0.0), 10.0)) for x in (-15.0, -14.0))


def comparer(calibration: Path | None = None) -> Comparer:
    return Comparer(ViewReader(ThumbnailEmbedder(), calibration), Verification())


@pytest.fixture
def here(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    np.save(tmp_path / "match.npy", MATCH.points)
    np.save(tmp_path / "query.npy", QUERY.points)
    for name in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), rng.integers(0, 255, (48, 64), np.uint8))
    (tmp_path / "calibration.yaml").write_text(CALIBRATION)
    return tmp_path


def test_a_pair_does_not_depend_on_where_and_when_it_was_taken() -> None:
    """Stamps, odometry and what was judged before are no part of the question."""
    verifier = Verifier(Verification())
    alone = judge(verifier, MATCH, QUERY)
    far = make_pose(np.eye(3), [500.0, 0.0, 0.0])
    elsewhere = replace(QUERY, stamp_ns=3, odom_T_body=far, path_length_m=500.0, session=2)
    told_otherwise = judge(verifier, replace(MATCH, odom_T_body=np.eye(4), path_length_m=1.0), elsewhere)
    np.testing.assert_equal(alone.numbers, told_otherwise.numbers)
    assert alone.reason == told_otherwise.reason
    assert alone.candidate.similarity == pytest.approx(similarity_of(MATCH, QUERY))


def test_scans_are_verified_and_timed(here: Path) -> None:
    found = comparer().compare(PlaceView(str(here / "match.npy")), PlaceView(str(here / "query.npy")))
    assert found["reason"] not in ("", NO_DEPTH, NO_CALIBRATION)
    assert found["accepted"] == (found["reason"] == "accepted") == (found["x"] is not None)
    assert found["milliseconds"] > 0


def test_images_without_a_calibration_say_why_they_have_no_pose(here: Path) -> None:
    image, scan = PlaceView("", str(here / "left.png")), PlaceView(str(here / "match.npy"))
    for pair in ((image, image), (scan, image), (image, scan)):
        found = comparer().compare(*pair)
        assert (found["reason"], found["accepted"], found["probability"]) == (NO_CALIBRATION, 0, None)
    assert comparer().compare(image, image)["similarity"] == pytest.approx(1)


def test_one_image_says_that_its_depth_is_missing(here: Path) -> None:
    image = PlaceView("", str(here / "left.png"))
    assert comparer(here / "calibration.yaml").compare(image, image)["reason"] == NO_DEPTH


def test_it_says_which_of_the_two_cannot_be_read(here: Path) -> None:
    good, bad = PlaceView(str(here / "match.npy")), PlaceView(str(here / "nowhere.npy"))
    with pytest.raises(SensorFileError, match=r"^match: cannot read"):
        comparer().compare(bad, good)
    with pytest.raises(SensorFileError, match=r"^query: cannot read"):
        comparer().compare(good, bad)
