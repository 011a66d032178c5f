"""Every test of a hypothesis, at the true pose and beside it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from measurements import GOOD, GOOD_VIEWS

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe, ScanMotion
from umf_ros.lab.simulation.scenes import landscape, pose_at, take, without_scan
from umf_ros.verification import Hypothesis, Verifier
from umf_ros.verification.constants import BLUR_M
from umf_ros.verification.hypothesis import IMAGE, SCAN, kind_of
from umf_ros.verification.measurement import MEASUREMENTS

GROUND = landscape(20)
HERE, THERE = pose_at(GROUND, -14.0, 1.2, 6.0, 2.0), pose_at(GROUND, -15.0, 0.0, 0.0)
QUERY, MATCH = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
OTHER = take(landscape(99), pose_at(landscape(99), -15.0, 0.0, 0.0), 20.0)
CANDIDATE = ("similarity", "inliers_image", "inliers_cloud")


def most_probable(query: Keyframe, match: Keyframe) -> Hypothesis:
    """The most probable hypothesis about a pair."""
    examined = Verifier(Verification()).examine(query, [(Candidate(0, match.stamp_ns, 0.7), match)])
    return max(examined, key=lambda one: one.probability or 0.0)


def measured(query: Keyframe, match: Keyframe) -> dict[str, float]:
    return most_probable(query, match).measurements


def test_the_kind_follows_from_what_was_measured() -> None:
    assert kind_of({name: GOOD[name] for name in CANDIDATE}) == kind_of({}) == ""
    assert (kind_of(GOOD), kind_of(GOOD_VIEWS)) == (SCAN, IMAGE)


def test_every_name_says_what_it_is() -> None:
    assert all(len(meaning.split()) >= 3 for meaning in MEASUREMENTS.values())


NOT_HERE = {"upright_counterparts", "unexplained", "lead", "narrow", "repetition"}
"""Where nothing stands, in no passage, without odometry, of a single hypothesis."""


@pytest.mark.parametrize(("query", "expected"), [(QUERY, GOOD), (without_scan(QUERY), GOOD_VIEWS)])
def test_a_hypothesis_has_every_measurement_of_its_kind_and_each_is_documented(
    query: Keyframe, expected: dict[str, float]
) -> None:
    found = most_probable(query, MATCH)
    assert set(expected) - NOT_HERE <= set(found.measurements) <= set(MEASUREMENTS)
    assert found.kind == kind_of(expected)
    assert not any(math.isnan(value) for value in found.measurements.values())
    assert found.numbers == found.measurements | {"probability": found.probability}


def test_a_candidate_without_a_pose_has_the_measurements_of_the_candidate_alone() -> None:
    found = Hypothesis.of(QUERY, Candidate(0, MATCH.stamp_ns, 0.7), MATCH)
    assert found.numbers == {"similarity": 0.7} and found.kind == ""


def test_a_pair_of_scans_is_measured_completely() -> None:
    found = measured(QUERY, MATCH)
    assert kind_of(found) == SCAN and found["similarity"] == 0.7
    assert found["residual_m"] < found["residual_p90_m"] < 0.1 < 0.8 < found["overlap"]
    assert found["noise_m"] > BLUR_M  # the motion during these scans is not removed
    still = [replace(one, motion=ScanMotion.none(len(one.points))) for one in (QUERY, MATCH)]
    steady = measured(*still)
    assert steady["residual_m"] < steady["noise_m"] < found["residual_p90_m"]
    assert found["points"] > 500
    assert found["terrain_score"] > 18  # a correlation of .7
    assert found["position_std_m"] < 0.1 and found["heading_std_deg"] < 0.5
    assert found["support"] == 0


def test_without_a_scan_the_views_are_measured() -> None:
    found = measured(without_scan(QUERY), MATCH)
    assert kind_of(found) == IMAGE
    assert found["pose_inliers"] >= 15 and found["spread"] > 0.05
    assert found["residual_m"] < 0.5 and 0.3 < found["overlap"] <= 1
    assert found["two_way_m"] < 0.5 and 0.5 < found["residual_sigmas"] < 3
    assert abs(found["disparity_bias_px"]) < 3 * found["disparity_bias_std_px"]


def test_another_place_measures_worse() -> None:
    right, wrong = measured(QUERY, MATCH), measured(QUERY, OTHER)
    assert wrong["residual_m"] > 2 * right["residual_m"] and wrong["terrain_score"] < 0.7 * right["terrain_score"]
    assert wrong["overlap"] < right["overlap"] and wrong["position_std_m"] > right["position_std_m"]
    assert wrong["rival_far"] < right["rival_far"] and wrong["rival_near"] < right["rival_near"]
    assert wrong["overlap"] < right["overlap"]  # the most probable wrong pose contradicts nothing


def test_motion_that_was_not_removed_from_either_scan_widens_the_noise() -> None:
    still = [replace(one, motion=ScanMotion.none(len(one.points))) for one in (QUERY, MATCH)]
    noise_m = measured(*still)["noise_m"]
    for pair in ((QUERY, still[1]), (still[0], MATCH)):
        assert measured(*pair)["noise_m"] == pytest.approx(np.hypot(noise_m, BLUR_M), rel=1e-6)
