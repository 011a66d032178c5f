"""The worlds the promises are tested on are what they say."""

from __future__ import annotations

import numpy as np
import pytest

from umf_ros.core.geometry import invert, logmap
from umf_ros.lab.simulation.pose_graphs import (
    WORLDS,
    GraphWorld,
    Kind,
    rover_loops,
    short_revisit,
    with_bias,
    with_lone_end,
    with_wrong_closures,
)


def off_by(world: GraphWorld, right: bool) -> np.ndarray:
    """Metres by which closures miss the truth."""
    chosen = [closure for closure in world.closures if closure.right is right]
    misses = [invert(world.truth[c.first] @ c.pose) @ world.truth[c.second] for c in chosen]
    return np.linalg.norm(np.array(misses)[:, :3, 3], axis=1)


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_worlds_have_drift_and_right_closures(name: str) -> None:
    world = WORLDS[name](400, 5)
    assert len(world.truth) == len(world.odometry) == 400
    np.testing.assert_array_equal(world.odometry[0], world.truth[0])
    assert np.linalg.norm(world.odometry[-1][:3, 3] - world.truth[-1][:3, 3]) > 0.3
    assert len(world.closures) >= 10 and off_by(world, True).max() < 0.5
    assert all(closure.second - closure.first > 40 for closure in world.closures)


@pytest.mark.parametrize("kind", ["random", "groups", "near"])
@pytest.mark.parametrize("share", [0.1, 0.5])
def test_wrong_closures_are_wrong_and_as_many_as_wanted(kind: Kind, share: float) -> None:
    world = with_wrong_closures(WORLDS["sphere"](600, 3), share, kind, 1)
    wrong = off_by(world, False)
    assert len(wrong) / len(world.closures) == pytest.approx(share, abs=0.01)
    assert wrong.min() > 3.0 or kind != "near"
    assert wrong.max() < 20.0 if kind == "near" else wrong.min() > 5.0


def test_no_pair_of_poses_is_closed_twice() -> None:
    world = with_wrong_closures(WORLDS["sphere"](600, 3), 0.5, "near", 1)
    pairs = [(closure.first, closure.second) for closure in world.closures]
    assert len(set(pairs)) == len(pairs)
    assert [pair[1] for pair in pairs] == sorted(pair[1] for pair in pairs)


def test_groups_agree_with_each_other() -> None:
    world = with_wrong_closures(rover_loops(400, 3), 0.3, "groups", 1)
    wrong = [closure for closure in world.closures if not closure.right]
    shifts = np.stack([world.truth[c.first] @ c.pose @ invert(world.truth[c.second]) for c in wrong])
    following = [k for k in range(1, len(wrong)) if wrong[k].second == wrong[k - 1].second + 1]
    alike = [np.abs(shifts[k] - shifts[k - 1]).max() < 3.0 for k in following]
    assert len(following) > len(wrong) / 2 and np.mean(alike) > 0.8


def test_a_seed_is_a_world() -> None:
    one, same, other = (with_wrong_closures(rover_loops(300, seed), 0.3, "near", 2) for seed in (7, 7, 8))
    np.testing.assert_array_equal(one.odometry, same.odometry)
    assert [c.second for c in one.closures] == [c.second for c in same.closures]
    assert not np.array_equal(one.odometry, other.odometry)


def test_messages_carry_the_stamps_and_the_stated_noise() -> None:
    world = rover_loops(300, 7)
    closure, message = world.closures[3], world.message(3)
    assert (message.match_stamp_ns, message.query_stamp_ns) == (closure.first * 10**9, closure.second * 10**9)
    np.testing.assert_array_equal(message.match_T_query, closure.pose)
    assert np.trace(message.covariance) == pytest.approx(np.trace(closure.covariance), rel=1e-6)
    assert world.step_covariance(0) is None and world.step_covariance(1) is not None


def test_a_bias_is_the_same_in_every_metre_and_not_stated() -> None:
    world, twist = rover_loops(300, 7), np.array([0, 0, 0.002, 0.01, 0, 0])
    biased = with_bias(world, twist)
    np.testing.assert_array_equal(biased.odometry[0], world.odometry[0])
    np.testing.assert_array_equal(biased.step_covariances, world.step_covariances)
    steps, wrong = (invert(w.odometry[:-1]) @ w.odometry[1:] for w in (world, biased))
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
    np.testing.assert_allclose(logmap(invert(steps) @ wrong), lengths[:, None] * twist, atol=1e-9)


def test_a_lone_end_leaves_one_closure_in_the_second_half() -> None:
    world = rover_loops(400, 7)
    lone = with_lone_end(world)
    assert [closure.second for closure in lone.closures if closure.second >= 200] == [world.closures[-1].second]
    assert len(lone.closures) == 1 + sum(closure.second < 200 for closure in world.closures) > 1


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_short_revisit_closes_one_place_after_a_loop(seed: int) -> None:
    world = short_revisit(seed)
    lengths = np.linalg.norm(np.diff(world.truth[:, :3, 3], axis=0), axis=1)
    assert 30 < lengths.sum() < 80 and 5 < len(world.closures) < 30
    assert all(closure.right for closure in world.closures) and off_by(world, True).max() < 0.5
    first, second = (np.array([getattr(one, end) for one in world.closures]) for end in ("first", "second"))
    assert np.linalg.norm(world.truth[first, :3, 3] - world.truth[second, :3, 3], axis=1).max() < 2
    drift = np.linalg.norm(world.odometry[-1][:3, 3] - world.truth[-1][:3, 3])
    assert 0.1 < drift < 10
