"""Odometry logs and chains: sorted, thinned, with the noise of the way."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from graph_worlds import SETTINGS

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array, adjoint, expmap, invert, propagate, relative
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, rover_loops
from umf_ros.pose_graph.odometry import OdometryChain, drift_between

WORLD = rover_loops(300, 12)


def line(count: int) -> Array:
    return expmap(np.stack([np.array([0, 0, 0, 0.1 * k, 0, 0]) for k in range(count)]))


def test_a_chain_sorts_drops_duplicates_and_keeps_the_first() -> None:
    chain, poses = OdometryChain(SETTINGS), line(6)
    for k in (3, 1, 5):
        chain.add(k, poses[k])
    assert not chain.update() and chain.span == (1, 5)
    chain.add(3, poses[0])
    assert not chain.update()
    chain.add(2, poses[2])
    assert chain.update() and not chain.update()
    np.testing.assert_array_equal(chain.poses_at(np.array([1, 2, 3, 5])), poses[[1, 2, 3, 5]])
    np.testing.assert_allclose(chain.poses_at(np.array([4]))[0, 0, 3], 0.4)


def test_a_chain_knows_where_it_can_be_trusted() -> None:
    chain, poses = OdometryChain(SETTINGS.model_copy(update={"max_gap_s": 10e-9})), line(6)
    assert not chain.covers(np.zeros(1, np.int64)).any()
    for k in (0, 10, 40):
        chain.add(k, poses[0])
    chain.update()
    known = chain.covers(np.array([-1, 0, 5, 10, 25, 40, 41]))
    assert known.tolist() == [False, True, True, True, False, True, False]


def test_noise_between_two_stamps_is_that_of_the_steps_between() -> None:
    chain = OdometryChain(SETTINGS)
    for k in range(60):
        chain.add(k * PERIOD_NS, WORLD.odometry[k], WORLD.step_covariance(k))
    chain.update()
    points = chain.at(np.array([20, 50]) * PERIOD_NS)
    noise, back = np.diff(points["noise"], axis=0), adjoint(invert(points["pose"][1:]))
    expected = np.zeros((6, 6))
    for k in range(21, 51):
        carry = gtsam.Pose3(relative(WORLD.odometry[50], WORLD.odometry[k])).AdjointMap()
        expected += carry @ WORLD.step_covariances[k] @ carry.T
    np.testing.assert_allclose(propagate(back, noise)[0], expected, rtol=1e-9, atol=1e-15)


def test_the_model_grows_with_the_way_not_with_the_messages() -> None:
    ends = []
    for period in (20_000_000, 100_000_000):
        chain = OdometryChain(PoseGraphSettings())
        for stamp in range(0, 60_000_000_001, period):
            chain.add(stamp, expmap(np.array([[0, 0, 0, 0.5 * stamp / 1e9, 0, 0]]))[0])
        chain.update()
        end = np.array([60_000_000_000])
        ends.append(chain.at(end)["noise"][0])
        assert len(chain.stamps) == pytest.approx(30 / 0.25, abs=2)
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.02, atol=1e-12)
    assert np.sqrt(ends[0][3, 3]) == pytest.approx(PoseGraphSettings().odometry_sigma_m * np.sqrt(30), rel=0.05)


def test_standing_still_adds_no_keyframes() -> None:
    chain = OdometryChain(PoseGraphSettings())
    for k in range(2000):
        chain.add(k * 50_000_000, np.eye(4))
    chain.update()
    assert len(chain.stamps) == 1


def driven_chain(poses: Array, period_ns: int = 50_000_000) -> OdometryChain:
    chain = OdometryChain(PoseGraphSettings())
    for k, pose in enumerate(poses):
        chain.add(k * period_ns, pose)
        chain.update()
    return chain


def end_sigmas(chain: OdometryChain) -> Array:
    """(6,) standard deviations of the last pose relative to the first by the noise, constant errors left out."""
    assert chain.span is not None
    point = chain.at(np.array([chain.span[1]]))
    return np.sqrt(np.diagonal(propagate(adjoint(invert(point["pose"])), point["noise"])[0]))


@pytest.mark.parametrize("jump", [(0, 0, 0, 1.0, 0, 0), (0, 0, 0, 0, 1.9, 0), (0, 0, 0.5, 0, 0, 0)])
def test_a_step_that_jumps_is_as_uncertain_as_it_is_too_long(jump: tuple[float, ...]) -> None:
    poses = line(200)
    smooth = end_sigmas(driven_chain(poses))
    poses[120:] = poses[119] @ expmap(np.array([jump]))[0] @ invert(poses[119]) @ poses[120:]
    jumped = end_sigmas(driven_chain(poses))
    angle, distance = np.linalg.norm(jump[:3]), np.linalg.norm(jump[3:])
    assert jumped[2] == pytest.approx(np.hypot(smooth[2], angle), rel=0.05)
    # a turn moves the end of the 8 m after it to the side
    assert jumped[4] == pytest.approx(np.hypot(smooth[4], distance + 8 * angle), rel=0.1)


@pytest.mark.parametrize("silence_s", [0.5, 10.0, 600.0])
def test_a_step_over_a_silence_is_as_uncertain_as_the_recent_speed_allows(silence_s: float) -> None:
    chain, poses = OdometryChain(PoseGraphSettings()), line(200)  # 2 m/s
    stamps = np.arange(200) * 50_000_000 + np.where(np.arange(200) >= 100, round(silence_s * 1e9), 0)
    smooth = end_sigmas(driven_chain(poses[:100]))
    for end in (100, 200):
        chain.extend(stamps[end - 100 : end], poses[end - 100 : end])
        chain.update()
        if end == 100:
            np.testing.assert_allclose(end_sigmas(chain), smooth)
    # until 2 s the motion is limited by accelerations, from a minute on it is told by the reset of the session
    free_s = min(silence_s + 0.05, 60.0)
    points = chain.at(stamps[[0, 99, 100]])
    before, over = (np.sqrt(np.diagonal(noise)) for noise in np.diff(points["noise"], axis=0))
    np.testing.assert_allclose(before[:4], smooth[:4], rtol=0.05)
    assert over[2] == pytest.approx(min(0.3 * free_s * min(free_s / 2, 1.0), np.pi), rel=0.1)
    assert over[3] == pytest.approx(2.0 * free_s * min(free_s / 2, 1.0), rel=0.1)
    assert np.diff(points["part"]).tolist() == [0, silence_s > 2.0]


def test_starts_stops_and_turns_of_a_rover_are_no_jumps() -> None:
    speed = np.concatenate([np.zeros(40), np.full(40, 2.0), np.zeros(40), np.full(40, -1.5)]) * 0.05
    rate = np.concatenate([np.zeros(60), np.full(30, 1.5), np.full(70, -1.0)]) * 0.05
    poses = [np.eye(4)]
    for forward, turn in zip(speed, rate, strict=True):
        poses.append(poses[-1] @ expmap(np.array([[0, 0, turn, forward, 0, 0]]))[0])
    sigmas = end_sigmas(driven_chain(np.array(poses)))
    assert sigmas[2] < 0.1 and sigmas[3:].max() < 0.3


def test_constant_errors_add_up_and_cancel_on_the_way_back() -> None:
    out = np.array([[0, 0, 0, 0.1, 0, 0]])
    poses = [np.eye(4)]
    for k in range(400):
        poses.append(poses[-1] @ expmap(out if k < 200 else -out)[0])
    chain = driven_chain(np.array(poses))
    points = chain.at(np.array([0, 200, 400]) * 50_000_000)
    far, back = (np.sqrt(np.diagonal(drift_between(points[0], points[k]))) for k in (1, 2))
    assert far[3] == pytest.approx(0.03 * 20, rel=0.02) and far[2] == pytest.approx(np.deg2rad(0.2 * 20), rel=0.02)
    assert back[3] == pytest.approx(0, abs=0.02)
