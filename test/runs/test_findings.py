"""Findings and the verdict: green only when something was found or there was nothing to find."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from finished_runs import BELOW, START_NS, accepted, candidate, closure, examined, stamp, trajectory
from recordings import CLOUD, LEFT, ODOMETRY, RIGHT, traverse, write_mcap

from umf_ros.bags.inputs import Advice, useless_inputs
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import load_settings
from umf_ros.core.trajectory import Trajectory
from umf_ros.pose_graph.closures import ClosureReason, State
from umf_ros.runs.findings import USELESS, conclude, look_first
from umf_ros.runs.truth import JudgedRun
from umf_ros.sensors.motion_check import Disagreement
from umf_ros.sensors.sensor_check import Overlay, SensorReport
from umf_ros.verification import RejectReason


def verdict(about: JudgedRun) -> tuple[str, int, str]:
    found = conclude(about, look_first(about))
    return found.mark, found.exit_code, found.sentence


def test_what_was_found_and_used_is_green(tmp_path: Path) -> None:
    about = examined(tmp_path, [closure(50, 10)], verdict=accepted(), truth=trajectory(), ate=(1.5, 0.25))
    found = "1 true and 0 false loop closures at 1 revisits, the graph used all of them"
    errors = "trajectory error (ATE, rigidly aligned) 1.50 m by odometry, 0.25 m optimised"
    assert verdict(about) == ("good", 0, f"{found}; {errors}.")


def test_without_a_truth_what_was_found_is_green_and_not_called_true(tmp_path: Path) -> None:
    mark, status, sentence = verdict(examined(tmp_path, [closure(50, 10)], verdict=accepted()))
    assert (mark, status) == ("good", 0)
    assert sentence.startswith("1 loop closures; there is no ground truth to judge them by")
    cut = examined(tmp_path, [closure(50, 10)], verdict=accepted(), warnings=["cut.mcap is truncated"])
    assert verdict(cut)[2].startswith("cut.mcap is truncated. 1 loop closures")  # its name stays as it is


@pytest.mark.parametrize("absent", [(LEFT, RIGHT), (CLOUD,), (ODOMETRY,), ()], ids=str)
def test_whatever_was_found_a_silent_input_is_not_green(absent: tuple[str, ...], tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "bag.mcap", [entry for entry in traverse(0.5) if entry[0] not in absent])
    found = examined(tmp_path, [closure(50, 10)], verdict=accepted())
    run = replace(found.run, odometry=None if ODOMETRY in absent else found.run.odometry)
    mark, status, sentence = verdict(replace(found, bag=open_bag(bag), run=run))
    assert (mark, status) == ("warn" if absent else "good", 0)
    assert not absent or sentence.startswith(("No images on", "No scans on", "No odometry on"))


def test_revisits_of_which_none_was_closed_are_not_green(tmp_path: Path) -> None:
    tested = [candidate(50, 10, RejectReason.IMPROBABLE, **BELOW)]
    mark, status, sentence = verdict(examined(tmp_path, candidates=tested, truth=trajectory(), missed=[50]))
    assert (mark, status) == ("bad", USELESS)
    assert sentence.startswith("1 of 1 revisits are missed, 100% of them at the gate 'probability' (at 50.0 s: prob")


def test_nothing_to_find_is_green(tmp_path: Path) -> None:
    tested = [candidate(50, 10, RejectReason.NO_POSE)]
    mark, status, sentence = verdict(examined(tmp_path, candidates=tested, truth=trajectory()))
    assert (mark, status) == ("good", 0) and sentence.startswith("No place was revisited. 0 true and 0 false")


def test_nothing_found_without_a_truth_is_not_green(tmp_path: Path) -> None:
    tested = [candidate(50, 10, RejectReason.IMPROBABLE, **BELOW)]
    mark, status, sentence = verdict(examined(tmp_path, candidates=tested))
    assert (mark, status) == ("warn", 0)
    assert sentence.startswith(
        "None of 1 candidates became a closure; the best (probability below verification.min_probability: 0.60 < 0.9)"
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"frames": 0, "pairs": 0, "keyframes": 0, "keyframe_rows": []}, "None of 0 frames became a keyframe"),
        (
            {"pairs": 0, "inputs": {name: {"received": 9, "used": 9, "dropped": {}} for name in ("left", "cloud")}},
            "None of 90 scans has an image within 0.05 s of it",
        ),
        (  # the cause, and not the clocks
            {
                "pairs": 0,
                "inputs": {
                    "left": {"received": 9, "used": 0, "dropped": {"size": 9}},
                    "cloud": {"received": 9, "used": 9, "dropped": {}},
                },
            },
            "9 of 9 messages of the left images could not be used (size 9)",
        ),
        ({"settings": load_settings(None, loop__min_time_gap_s=600)}, "The gap rules exclude every pair: a match must"),
        (
            {"inputs": {"cloud": {"received": 9, "used": 0, "dropped": {"fields": 9}}}},
            "9 of 9 messages of the scans could not be used (fields 9)",
        ),
    ],
)
def test_inputs_that_can_give_nothing_are_red_and_the_exit_status_says_so(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    mark, status, sentence = verdict(examined(tmp_path, **changes))
    assert (mark, status) == ("bad", USELESS) and sentence.startswith(said), sentence


def test_a_truth_of_another_clock_is_named_and_judges_nothing(tmp_path: Path) -> None:
    whole = trajectory()
    late = Trajectory(whole.stamps_ns + 10**13, whole.poses)
    mark, _, sentence = verdict(examined(tmp_path, [closure(50, 10)], verdict=accepted(), truth=late))
    assert mark == "bad" and sentence.startswith("The ground truth has another clock: it covers none of the 40 key")
    assert "+10000.0 s from start to start" in sentence and "true and" not in sentence


def test_an_offset_of_the_truths_clock_is_named_and_judges_nothing(tmp_path: Path) -> None:
    about = replace(examined(tmp_path, [closure(50, 10)], verdict=accepted(), truth=trajectory()), clock_offset_s=-2.0)
    mark, _, sentence = verdict(replace(about, covered=(0, 40)))
    assert mark == "bad" and sentence.startswith("The ground truth's clock is -2.0 s off that of the odometry")
    assert "true and" not in sentence and "+2.0 s; nothing was judged" in look_first(about)[0].remedy


def test_closures_that_the_graph_did_not_use_are_pending_not_rejected(tmp_path: Path) -> None:
    waiting = accepted(State.PENDING, ClosureReason.NO_ODOMETRY_YET)
    mark, _, sentence = verdict(examined(tmp_path, [closure(50, 10)], verdict=waiting, truth=trajectory()))
    assert mark == "bad" and sentence.startswith("All closures are pending: the graph used none of 1 (its odometry has")
    assert "the graph used none of them (1 pending)" in sentence and "rejected" not in sentence


@pytest.mark.parametrize(
    ("state", "reason", "said", "helps"),
    [
        (
            State.REFUSED,
            ClosureReason.BEFORE_ODOMETRY,
            "the graph refused 1 of 1 closures (no odometry at",
            "must reach",
        ),
        (
            State.REJECTED,
            ClosureReason.CONTRADICTS,
            "the graph rejected 1 of 1 closures (contradicts the",
            "odometry worse",
        ),
    ],
)
def test_closures_without_odometry_are_not_laid_to_its_errors(
    tmp_path: Path, state: State, reason: ClosureReason, said: str, helps: str
) -> None:
    found = look_first(examined(tmp_path, [closure(50, 10)], verdict=accepted(state, reason), truth=trajectory()))
    told = next(one for one in found if one.what.startswith("the graph"))
    assert (
        told.what.startswith(said)
        and helps in told.remedy
        and ("sigma in the median" in told.what) == (state is State.REJECTED)
    )


def test_false_closures_come_with_the_threshold_that_excludes_them(tmp_path: Path) -> None:
    closures = [closure(50, 10, probability=0.99), closure(52, 12, error_m=0.9, probability=0.93)]
    about = examined(tmp_path, closures, verdict=accepted(), truth=trajectory())
    mark, _, sentence = verdict(about)
    assert mark == "bad" and sentence.startswith("1 of 2 closures are false, the worst 0.9 m off")
    assert look_first(about)[0].remedy.startswith("verification.min_probability above 0.930 would have kept 1 true")


def test_causes_come_before_what_they_bring_about(tmp_path: Path) -> None:
    about = examined(
        tmp_path,
        [closure(50, 10, error_m=2)],
        verdict=accepted(),
        truth=trajectory(),
        warnings=["min_intensity 15 is not applied"],
        interrupted=True,
    )
    assert [finding.severity for finding in look_first(about)] == ["warning", "fault", "warning"]


def test_a_run_that_did_not_end_is_not_reported_as_complete(tmp_path: Path) -> None:
    about = examined(tmp_path, [closure(50, 10)], verdict=accepted(), truth=trajectory(), interrupted=True)
    mark, _, sentence = verdict(about)
    assert mark == "warn" and sentence.startswith("The run did not end: results cover the part before. 1 true")


LIDAR = Disagreement(0.0, np.array([0.0, 9.0, 1.0]))
FINE = Disagreement(0.0, np.array([0.5, 1.0, -2.5]))


def laid_over(scale: float) -> Overlay:
    return Overlay(np.array([0.1, 0.2, -0.1]), scale, 0.003, np.array([0.1, 0.001, 0.002]))


@pytest.mark.parametrize(
    ("sensors", "said"),
    [
        (
            SensorReport(right_contrast=0.4),
            "the right images are empty: the median standard deviation of grey values is 0",
        ),
        (SensorReport(left_contrast=5.0), "the left images have little contrast"),
        (SensorReport(returns=120), "scans have 120 returns in the median"),
        (SensorReport(intensity_max=0.0), "all intensities are 0"),
        (SensorReport(overlay=laid_over(1.5)), "stereo depth is 1.5 times that of the LiDAR"),
        (SensorReport(lidar=LIDAR, camera=FINE), "the LiDAR's mounting is off by 9 deg, mostly about y (+9 deg)"),
        (SensorReport(lidar=LIDAR, camera=LIDAR), "the odometry is not that of the body: by the sensors"),
        (SensorReport(forward=np.array([0, 0, 0.9])), "the odometry is not that of the body: it moves along"),
        (SensorReport(lidar=Disagreement(-0.5, None), camera=FINE), "the LiDAR's clock is about +0.5 s off"),
        (
            SensorReport(lidar=Disagreement(0.4, None), camera=Disagreement(0.4, None)),
            "the odometry's clock is about +0.4 s off those of camera and LiDAR",
        ),
    ],
)
def test_what_is_wrong_with_the_sensors_is_said_with_a_number(tmp_path: Path, sensors: SensorReport, said: str) -> None:
    first = look_first(examined(tmp_path, [closure(50, 10)], verdict=accepted(), sensors=sensors))[0]
    assert first.what.startswith(said), first.what
    assert first.remedy


def test_sensors_that_agree_are_not_mentioned(tmp_path: Path) -> None:
    fine = SensorReport(50.0, 50.0, 9000.0, 200.0, laid_over(1.005), FINE, FINE, np.array([0.99, 0.1, 0.0]))
    assert look_first(examined(tmp_path, [closure(50, 10)], verdict=accepted(), sensors=fine)) == []


def test_losses_of_an_input_are_told_with_their_reasons_and_surplus_images_are_none() -> None:
    left = {"received": 100, "used": 40, "dropped": {"surplus": 30, "late": 20, "size": 10}}
    (found,) = useless_inputs({"left": left, "right": {"received": 9, "used": 1, "dropped": {"surplus": 8}}})
    what = "30 of 100 messages of the left images could not be used (late 20, size 10)"
    assert found == Advice("warning", what, "a larger sync.max_wait_s waits longer")


def test_the_keyframes_of_the_helper_start_where_they_say() -> None:
    assert stamp(0) == START_NS


@pytest.mark.parametrize(
    ("biases_px", "std_px", "words"),
    [
        ([0.8] * 6, 0.1, "0.8 px too little disparity"),
        ([-0.6] * 6, 0.1, "0.6 px too much"),
        ([0.1] * 6, 0.01, ""),
        # a single pair does not know it, thirty do
        ([0.6] * 6, 1.0, ""),
        ([1.6, -0.4] * 15, 1.0, "0.6 px too little disparity"),
        ([0.8] * 6, 0.0, ""),  # identical images say nothing
        # they disagree by more than they say
        ([3.6, -2.4] * 15, 0.1, ""),
    ],
)
def test_a_bias_of_the_disparities_is_told(tmp_path: Path, biases_px: list[float], std_px: float, words: str) -> None:
    known = {"pose_inliers": 40.0, "disparity_bias_std_px": std_px, "probability": 0.97}
    tested = [candidate(50 + n, 10 + n, None, **known, disparity_bias_px=px) for n, px in enumerate(biases_px)]
    closures = [closure(50 + n, 10 + n) for n in range(len(biases_px))]
    told = " ".join(one.what for one in look_first(examined(tmp_path, closures, tested)))
    assert ("disparity" in told) == bool(words) and words in told
