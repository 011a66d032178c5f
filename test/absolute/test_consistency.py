"""Consistency of absolute measurements over time: chains, headings and errors of the mounting."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.absolute.consistency import body_offset, find_heading, longest_chain, position_drift, supported, turned
from umf_ros.core.config import PoseGraphSettings
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
