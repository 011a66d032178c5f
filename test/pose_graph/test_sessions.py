"""Several drives in one map: joined by closures, each in its own gauge until then."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from graph_worlds import (
    LAP,
    SETTINGS,
    accepted,
    batch_optimum,
    chain_of,
    closing,
    feed_odometry,
    lap_pairs,
    rms,
    two_laps,
)

from umf_ros.core.geometry import Array, expmap, invert
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import State
from umf_ros.pose_graph.odometry import CorrectedPath
from umf_ros.pose_graph.solver import between

GAUGE = expmap(np.array([[0.05, -0.1, 2.5, 40, -25, 3]]))[0]


def cut_in_two(world: GraphWorld) -> GraphWorld:
    """The second lap as a session of its own, its odometry in another frame."""
    odometry = world.odometry.copy()
    odometry[LAP:] = GAUGE @ odometry[LAP:]
    return replace(world, odometry=odometry, chains=(0, LAP))


def drive(world: GraphWorld, closures: bool = True) -> PoseGraph:
    graph = PoseGraph(SETTINGS)
    for start, end in zip(world.chains, [*world.chains[1:], len(world.truth)], strict=True):
        if start:
            graph.begin_session()
        feed_odometry(graph, world, range(start, end))
    for row in range(len(world.closures) if closures else 0):
        graph.add_closure(world.message(row))
    return graph


def in_map(graph: PoseGraph) -> Array:
    stamps, poses = graph.trajectory()
    order = np.argsort(stamps)
    return poses[order]


def test_a_session_stays_out_of_the_map_until_a_closure_joins_it() -> None:
    world = cut_in_two(closing(two_laps(), lap_pairs(0, 15, 30, 45)))
    graph = drive(world, closures=False)
    assert len(graph.trajectory()[0]) == LAP
    np.testing.assert_allclose(graph.map_T_odom(), np.eye(4), atol=1e-9)
    for row in range(4):
        graph.add_closure(world.message(row))
    graph.settle()
    assert accepted(graph) == {(k, k + LAP) for k in (0, 15, 30, 45)}
    assert rms(in_map(graph), world.truth) < 1.0
    np.testing.assert_allclose(graph.map_T_odom(), invert(GAUGE), atol=1.0)


def test_wrong_closures_alone_may_not_join_sessions_live() -> None:
    world = cut_in_two(closing(two_laps(), lap_pairs(0, 2, 4, 6), (8.0, 0, 0)))
    graph = drive(world)
    assert not accepted(graph) and len(graph.trajectory()[0]) == LAP


def test_wrong_closures_between_sessions_are_told_from_right_ones() -> None:
    world = closing(two_laps(), lap_pairs(*range(0, 90, 10)))
    world = closing(world, [(k + 30, k + LAP) for k in range(2, 9)], (6.0, 6.0, 0))
    world = cut_in_two(replace(world, closures=sorted(world.closures, key=lambda c: c.second)))
    graph = drive(world)
    graph.settle()
    assert accepted(graph) == {(c.first, c.second) for c in world.closures if c.right}


SILENCE_NS = 30 * PERIOD_NS


def drive_with_silence(world: GraphWorld, moved: Array) -> PoseGraph:
    """The second lap after 30 s of silence, its odometry moved meanwhile by (4, 4) in the axes of the body."""

    def stamp(k: int) -> int:
        return k * PERIOD_NS + (SILENCE_NS if k >= LAP else 0)

    graph, odometry = PoseGraph(SETTINGS), world.odometry.copy()
    odometry[LAP:] = odometry[LAP] @ moved @ invert(odometry[LAP]) @ odometry[LAP:]
    for k, pose in enumerate(odometry):
        graph.add_odometry(stamp(k), pose)
    for row, closure in enumerate(world.closures):
        told = world.message(row)
        graph.add_closure(replace(told, match_stamp_ns=stamp(closure.first), query_stamp_ns=stamp(closure.second)))
    graph.settle()
    return graph


@pytest.mark.parametrize("moved", [(0, 0, 0, 0, 0, 0), (0, 0, np.pi / 2, 0, 0, 0), (0, 0, -1.0, 25, -10, 0)])
def test_odometry_that_jumped_during_a_silence_is_corrected_by_closures(moved: tuple[float, ...]) -> None:
    world = closing(two_laps(), lap_pairs(0, 15, 30, 45))
    graph = drive_with_silence(world, expmap(np.array([moved]))[0])
    assert len(accepted(graph)) == 4 and len(graph.session_spans()) == 1
    stamps = np.arange(len(world.truth)) * PERIOD_NS + SILENCE_NS * (np.arange(len(world.truth)) >= LAP)
    poses, known = graph.poses_at(stamps)
    assert known.all() and rms(poses, world.truth) < 1.0


def test_wrong_closures_of_one_place_are_not_accepted_across_a_silence() -> None:
    world = closing(two_laps(), lap_pairs(0, 2, 4, 6), (8.0, 0, 0))
    assert not accepted(drive_with_silence(world, np.eye(4)))


def test_odometry_and_trajectory_have_the_same_poses() -> None:
    world = cut_in_two(closing(two_laps(), lap_pairs(0, 15, 30, 45)))
    for graph, count in ((drive(world, closures=False), LAP), (drive(world), 2 * LAP)):
        graph.settle()
        np.testing.assert_array_equal(graph.trajectory(optimized=False)[0], graph.trajectory()[0])
        assert len(graph.trajectory(optimized=False)[0]) == count


def test_three_sessions_in_a_row_join_through_the_middle_one() -> None:
    world = closing(two_laps(), lap_pairs(0, 12, 24, 36, 50, 62, 74, 86))
    odometry = world.odometry.copy()
    for start, gauge in ((LAP, GAUGE), (LAP + 50, GAUGE @ GAUGE)):
        odometry[start:] = gauge @ world.odometry[start:]
    world = replace(world, odometry=odometry, chains=(0, LAP, LAP + 50))
    graph = drive(world)
    graph.settle()
    assert len(accepted(graph)) == 8
    assert rms(in_map(graph), world.truth) < 1.0


def test_joining_later_sessions_first_keeps_the_gauge_of_the_first() -> None:
    # the second half of the second lap is tied to its first half before any of both is tied to the first lap
    world = closing(two_laps(), lap_pairs(0, 15, 30, 45, 60))
    graph = drive(cut_in_two(world))
    graph.settle()
    np.testing.assert_allclose(in_map(graph)[0], world.odometry[0], atol=1e-5)


def test_a_clock_that_starts_again_belongs_to_the_newest_session() -> None:
    world = closing(two_laps(), lap_pairs(0, 15, 30, 45))
    graph = PoseGraph(SETTINGS)
    feed_odometry(graph, world, range(2 * LAP))
    for row in range(4):
        graph.add_closure(world.message(row))
    graph.settle()
    before = in_map(graph)
    graph.begin_session()
    for k in range(50):
        graph.add_odometry(k * PERIOD_NS, GAUGE @ world.odometry[k])
    assert len(graph.trajectory()[0]) == 2 * LAP
    np.testing.assert_allclose(in_map(graph), before, atol=1e-9)
    closure = closing(two_laps(), [(3, 40)]).message(0)
    graph.add_closure(replace(closure, match_T_query=invert(world.odometry[3]) @ world.odometry[40]))
    graph.settle()
    # both stamps exist in both sessions: the newest one that knows the query is meant
    assert graph.verdict_counts()[State.ACCEPTED] == 5
    assert len(graph.trajectory()[0]) == 2 * LAP


@pytest.mark.parametrize("late", [range(20, 40), range(120, 140)])
def test_odometry_that_comes_late_moves_no_gauge_and_loses_no_closure(late: range) -> None:
    world = closing(two_laps(), lap_pairs(0, 15, 50, 70))
    settings = SETTINGS.model_copy(update={"max_gap_s": 30.0})
    graph = PoseGraph(settings)
    feed_odometry(graph, world, (k for k in range(200) if k not in late))
    for row in range(4):
        graph.add_closure(world.message(row))
    before = accepted(graph)
    feed_odometry(graph, world, late)
    assert len(graph.trajectory()[0]) == 200
    assert accepted(graph) == before
    assert graph.counts["odometry out of order"] == 1
    graph.settle()
    in_order = PoseGraph(settings)
    feed_odometry(in_order, world, range(200))
    for row in range(4):
        in_order.add_closure(world.message(row))
    in_order.settle()
    np.testing.assert_allclose(graph.trajectory()[1], in_order.trajectory()[1], atol=1e-6)


DRIFTING = two_laps(3)
ODOMETRY = chain_of(DRIFTING)
STAMPS = np.arange(200) * PERIOD_NS


def moved(pose: Array, turn_deg: float, *metres: float) -> Array:
    return pose @ expmap(np.array([[0, 0, np.deg2rad(turn_deg), *metres]]))[0]


def path_through(rows: list[int], poses: list[Array]) -> CorrectedPath:
    stamps = np.array(rows) * PERIOD_NS
    return CorrectedPath(ODOMETRY.at(stamps), np.stack(poses))


def full_optimum(rows: list[int], poses: list[Array], last: int) -> Array:
    """Levenberg-Marquardt over every pose with the given ones held."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(last + 1):
        values.insert(k, gtsam.Pose3(DRIFTING.odometry[k]))
        if k:
            step = invert(DRIFTING.odometry[k - 1]) @ DRIFTING.odometry[k]
            graph.add(between(k - 1, k, step, DRIFTING.step_covariances[k]))
    for row, pose in zip(rows, poses, strict=True):
        graph.add(gtsam.PriorFactorPose3(row, gtsam.Pose3(pose), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.stack([result.atPose3(k).matrix() for k in range(last + 1)])


def test_unsolved_it_is_the_odometry() -> None:
    found = path_through([0], [DRIFTING.odometry[0]]).at(ODOMETRY.at(STAMPS))
    np.testing.assert_allclose(found, DRIFTING.odometry, atol=1e-9)


def test_at_the_solved_stamps_it_is_the_solution() -> None:
    rows = [0, 60, 150]
    poses = [moved(DRIFTING.odometry[k], 0.02 * k, 0.01 * k, 0.0, 0.0) for k in rows]
    np.testing.assert_allclose(path_through(rows, poses).at(ODOMETRY.at(np.array(rows) * PERIOD_NS)), poses, atol=1e-9)


def test_beyond_the_last_solved_pose_it_follows_the_odometry() -> None:
    poses = [DRIFTING.odometry[0], moved(DRIFTING.odometry[60], 5.0, 1.0, 2.0, 0.0)]
    found = path_through([0, 60], poses).at(ODOMETRY.at(STAMPS[60:]))
    np.testing.assert_allclose(
        invert(found[:1]) @ found, invert(DRIFTING.odometry[60:61]) @ DRIFTING.odometry[60:], atol=1e-9
    )


@pytest.mark.parametrize(("turn_deg", "metres"), [(0.0, 0.3), (1.0, 0.0), (-1.5, -0.5)])
def test_between_it_is_close_to_the_optimum_of_the_full_graph(turn_deg: float, metres: float) -> None:
    poses = [DRIFTING.odometry[0], moved(DRIFTING.odometry[80], turn_deg, metres, 0.0, 0.1)]
    found = path_through([0, 80], poses).at(ODOMETRY.at(STAMPS[:81]))
    correction = rms(found, DRIFTING.odometry[:81])
    assert rms(found, full_optimum([0, 80], poses, 80)) < 0.05 * correction


def kilometre(seed: int) -> GraphWorld:
    """Once round a circle of a kilometre with strong drift, and closures of its only revisit."""
    count, turn = 1012, np.array([0, 0, 2 * np.pi / 1000, 1.0, 0, 0])
    errors = np.random.default_rng(seed).normal(0, [*np.deg2rad([1, 1, 4]), 0.02, 0.02, 0.02], (count - 1, 6))
    odometry = [np.eye(4)]
    for step in expmap(turn[None]) @ expmap(errors):
        odometry.append(odometry[-1] @ step)
    covariances = np.tile(np.diag([np.deg2rad(5)] * 3 + [0.1] * 3) ** 2, (count, 1, 1))
    world = GraphWorld(expmap(np.arange(count)[:, None] * turn), np.stack(odometry), covariances, [])
    return closing(world, [*((5, 995 + k) for k in range(5)), *((k, k + 1000) for k in range(5, 12))], noise=1.0)


def test_strong_drift_is_closed_by_all_closures_of_the_only_revisit() -> None:
    """No single correction describes the path between: its rotation is off by radians."""
    world = kilometre(6)
    graph = drive(world)
    graph.settle()
    assert accepted(graph) == {(c.first, c.second) for c in world.closures}


@pytest.mark.parametrize(
    ("probability", "state"), [(np.nan, State.PENDING), (0.7, State.PENDING), (0.97, State.ACCEPTED)]
)
def test_where_the_map_says_nothing_the_front_end_decides(probability: float, state: State) -> None:
    world = kilometre(4)
    graph = drive(world, closures=False)
    for row in range(len(world.closures)):
        graph.add_closure(replace(world.message(row), probability=probability))
    graph.settle()
    assert {verdict.state for verdict in graph.closures()} == {state}


def test_the_end_of_a_mission_is_the_optimum_of_the_full_graph() -> None:
    world = closing(two_laps(3), lap_pairs(0, 15, 30, 45), noise=1.0)
    graph = drive(world)
    exact, live = batch_optimum(world), rms(in_map(graph), batch_optimum(world))
    graph.settle()
    assert rms(in_map(graph), exact) < 1e-6 < live


def test_keyframes_beside_the_endpoints_of_closures_leave_it_solvable() -> None:
    """The odometry between stamps a few nanoseconds apart is hardly more than rounding errors."""
    world = closing(two_laps(3), lap_pairs(0, 15, 30, 45, 60, 75), noise=1.0)
    far = world.odometry.copy()
    far[:, :3, 3] += [3e3, 0, 0]
    graph = drive(replace(world, odometry=far), closures=False)
    for row in range(6):
        message = world.message(row)
        graph.add_closure(replace(message, query_stamp_ns=message.query_stamp_ns + 200))
    graph.settle()
    assert len(accepted(graph)) == 6 and not any("optimiser" in name for name in graph.counts)


def test_stamps_between_messages_are_between_their_poses() -> None:
    current = path_through([0], [DRIFTING.odometry[0]])
    half = current.at(ODOMETRY.at(np.array([10 * PERIOD_NS, 21 * PERIOD_NS // 2, 11 * PERIOD_NS])))
    np.testing.assert_allclose(half[1, :3, 3], (half[0, :3, 3] + half[2, :3, 3]) / 2, atol=1e-9)
