"""Consistency of absolute measurements over time: chains, headings and errors of the mounting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.absolute.consistency import (
    STRETCH_M,
    MeasuredPath,
    Track,
    body_offset,
    find_heading,
    longest_chain,
    position_drift,
    supported,
    turned,
)
from umf_ros.absolute.measurement import AbsoluteMeasurement, Aid
from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.frames import State
from umf_ros.core.odometry_noise import OdometryNoise

DRIFT = position_drift(OdometryNoise.stated(PoseGraphSettings()), np.arange(2000.0))


def series(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values that drift, their variances, and where they are along the path."""
    rng = np.random.default_rng(seed)
    values = np.cumsum(rng.normal(0, 0.1, (count, 3)), axis=0) + rng.normal(0, 0.4, (count, 3))
    return values, np.full((count, 3), 0.16), 10.0 * np.arange(count)


@pytest.mark.parametrize("jump", [5.0, 20.0, 50.0])
def test_jumps_are_not_on_the_chain(jump: float) -> None:
    values, variances, path_m = series(60, 1)
    wrong = np.zeros(60, bool)
    for start, direction in ((5, [1, 0, 0]), (22, [0, -0.7, 0.7]), (40, [-1, 0, 0])):
        wrong[start : start + 3] = True
        values[start : start + 3] += jump * np.array(direction)
    members = longest_chain(values, variances, path_m, DRIFT)
    assert not members[wrong].any() and members[~wrong].mean() > 0.95


def test_the_longer_part_wins_after_a_jump() -> None:
    values, variances, path_m = series(40, 2)
    values[:10] += 30.0
    members = longest_chain(values, variances, path_m, DRIFT)
    assert not members[:10].any() and members[10:].all()


def test_beyond_an_outage_a_few_do_not_suffice() -> None:
    values, variances, path_m = series(30, 3)
    path_m[20:] += 500.0  # anything fits across so much odometry
    members = longest_chain(values, variances, path_m, DRIFT)
    firm = supported(members, variances, path_m, DRIFT)
    assert members.all() and firm.all()
    few = slice(0, 23)
    assert supported(members[few], variances[few], path_m[few], DRIFT)[:20].all()
    assert not supported(members[few], variances[few], path_m[few], DRIFT)[20:].any()


def test_the_heading_of_a_map_is_found_among_jumps() -> None:
    rng = np.random.default_rng(4)
    mapped = np.column_stack([10.0 * np.arange(12), 8 * np.sin(np.arange(12) / 3), np.zeros(12)])
    measured = turned(mapped, 2.0) + np.array([500.0, -80.0, 12.0]) + rng.normal(0, 0.3, (12, 3))
    measured[4:7] += [0.0, 25.0, 5.0]
    found = find_heading(measured, mapped, np.full((12, 3), 0.1), 10.0 * np.arange(12), DRIFT)
    assert found == pytest.approx(2.0, abs=0.03)


def test_no_heading_without_a_way_that_agrees() -> None:
    rng = np.random.default_rng(5)
    mapped, variances = np.column_stack([10.0 * np.arange(12), np.zeros((12, 2))]), np.full((12, 3), 0.1)
    assert find_heading(rng.uniform(-80, 80, (12, 3)), mapped, variances, 10.0 * np.arange(12), DRIFT) is None
    assert find_heading(mapped[:3], mapped[:3], variances[:3], 10.0 * np.arange(3), DRIFT) is None


@pytest.mark.parametrize("true", [[0.0, 0.0, 0.0], [1.5, -0.8, 0.0]])
def test_an_error_that_turns_with_the_body_is_told_from_drift(true: list[float]) -> None:
    values, variances, path_m = series(100, 6)
    headings = 0.6 * np.sin(np.arange(100) / 2) + np.arange(100) / 16
    rotations = Rotation.from_euler("z", headings[:, None]).as_matrix()
    offset, covariance = body_offset(values + rotations @ np.array(true), variances, rotations, path_m, DRIFT)
    sigma = np.sqrt(np.diag(covariance))[:2]
    assert np.allclose(offset[:2], true[:2], atol=0.3) and (sigma < 0.5).all()
    straight = np.tile(np.eye(3), (100, 1, 1))
    assert np.sqrt(body_offset(values, variances, straight, path_m, DRIFT)[1][0, 0]) > 100


def measured_path(count: int) -> tuple[list[AbsoluteMeasurement], np.ndarray, MeasuredPath]:
    """Fixes 2 m apart on a winding path, every seventh hundred metres shifted by a reflection; all of it, cut off."""
    rng, along = np.random.default_rng(0), 2.0 * np.arange(2500)
    turn = 0.6 * np.sin(along / 40)
    poses = np.tile(np.eye(4), (len(along), 1, 1))
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = (
        np.cos(turn),
        -np.sin(turn),
        np.sin(turn),
        np.cos(turn),
    )
    poses[:, :2, 3] = np.cumsum(2.0 * poses[:, :2, 0], axis=0)
    lies = along // 100 % 7 == 3
    values = poses[:, :3, 3] + 0.3 * rng.normal(size=(len(along), 3)) + np.outer(lies, [12.0, -9.0, 0.0])
    fixes = [
        AbsoluteMeasurement(Aid.GNSS, 10**9 * k, value, 0.09 * np.eye(3), np.zeros(3)) for k, value in enumerate(values)
    ]
    finished = int(along[count - 1] // STRETCH_M)

    def at_middle(cell: int) -> tuple[int, np.ndarray]:
        row = min(int((cell + 0.5) * STRETCH_M / 2), len(along) - 1)
        return 10**9 * row, poses[row]

    return fixes[:count], lies[:count], MeasuredPath(poses[:count], poses[:count], along[:count], finished, at_middle)


def test_what_is_decided_on_the_way_is_what_is_decided_at_once() -> None:
    on_the_way = Track(Aid.GNSS, OdometryNoise.stated(PoseGraphSettings()))
    known = 0
    for count in range(250, 2501, 250):
        fixes, _, path = measured_path(count)
        on_the_way.add(fixes[known:])
        known = count
        on_the_way.judge(on_the_way.values, path, in_world=True)
    fixes, lies, path = measured_path(2500)
    at_once = Track(Aid.GNSS, OdometryNoise.stated(PoseGraphSettings()))
    at_once.add(fixes)
    at_once.judge(at_once.values, path, in_world=True)
    states = [np.array([one.state is State.ACCEPTED for one in track.verdicts()]) for track in (on_the_way, at_once)]
    assert not states[0][lies].any() and states[0][~lies].mean() > 0.9
    assert (states[0] == states[1]).all() and on_the_way.factors.keys() == at_once.factors.keys()


def test_a_late_measurement_has_all_decided_again() -> None:
    track = Track(Aid.GNSS, OdometryNoise.stated(PoseGraphSettings()))
    fixes, lies, path = measured_path(1500)
    track.add(fixes[:700] + fixes[710:])
    rows = np.r_[:700, 710:1500]
    short = MeasuredPath(path.odometry[rows], path.poses[rows], path.travel[rows], path.finished, path.at_middle)
    track.judge(track.values, short, in_world=True)
    track.add(fixes[700:710])
    track.judge(track.values, path, in_world=True)
    accepted = np.array([one.state is State.ACCEPTED for one in track.verdicts()])
    assert len(accepted) == 1500 and accepted[700:710][~lies[700:710]].all() and not accepted[lies].any()


@pytest.mark.parametrize(("ahead_m", "is_right"), [(0.0, True), (1.8, False)])
def test_an_antenna_is_judged_by_its_two_axes_in_the_plane(ahead_m: float, is_right: bool) -> None:
    # 1.8 m is 14.3 here as squared Mahalanobis distance: beyond the gate of two axes, within that of three
    track = Track(Aid.GNSS, OdometryNoise.stated(PoseGraphSettings()))
    fixes, _, path = measured_path(500)
    track.add([replace(one, lever=np.array([ahead_m, 0.0, 0.0])) for one in fixes])
    track.judge(track.values, path, in_world=True)
    assert (track.mounting is None) is is_right
    assert any(one.state is State.ACCEPTED for one in track.verdicts()) is is_right
