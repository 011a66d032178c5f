"""The pose graph's manners: order of arrival, bad input, sessions, revocation, exports."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from graph_worlds import SETTINGS, accepted, batch_optimum, drive, feed_odometry, right, rms, whole_graph

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, expmap, make_pose, ros_to_gtsam_covariance
from umf_ros.lab.datasets.g2o import read_g2o
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, rover_loops, with_wrong_closures
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import ClosureReason, State
from umf_ros.pose_graph.sessions import Sessions

WORLD = with_wrong_closures(rover_loops(300, 12), 0.3, "groups", 1)


@pytest.fixture(scope="module")
def driven() -> PoseGraph:
    return drive(WORLD)


def test_random_order_of_arrival_gives_the_same_graph(driven: PoseGraph) -> None:
    rng = np.random.default_rng(0)
    graph = PoseGraph(SETTINGS)
    count = len(WORLD.truth)
    for event in rng.permutation(count + len(WORLD.closures)):
        if event < count:
            feed_odometry(graph, WORLD, [int(event)])
        else:
            graph.add_closure(WORLD.message(int(event) - count))
    graph.settle()
    assert accepted(graph) == accepted(driven)
    stamps, poses = graph.trajectory()
    np.testing.assert_array_equal(stamps, driven.trajectory()[0])
    np.testing.assert_allclose(poses, driven.trajectory()[1], atol=1e-6)


def test_dense_odometry_in_random_order_is_thinned_alike() -> None:
    rng = np.random.default_rng(1)
    stamps = np.arange(30_000) * 50_000_000
    angle = stamps / 1e9 * 0.05
    poses = expmap(np.stack([0 * angle, 0 * angle, 0.05 + 0 * angle, 0.5 + 0 * angle, 0 * angle, 0 * angle], axis=1))
    poses[:, :3, 3] = np.stack([10 * np.cos(angle), 10 * np.sin(angle), 0.01 * angle], axis=1)
    graphs = []
    for order in (np.arange(len(stamps)), rng.permutation(len(stamps))):
        graph = PoseGraph(PoseGraphSettings())
        for k in order.tolist():
            graph.add_odometry(int(stamps[k]), poses[k])
        graph.settle()
        graphs.append(graph)
    np.testing.assert_array_equal(graphs[0].trajectory()[0], graphs[1].trajectory()[0])
    np.testing.assert_array_equal(graphs[0].trajectory()[1], graphs[1].trajectory()[1])
    assert len(graphs[0].trajectory()[0]) <= len(stamps) / 10


def test_duplicates_change_nothing(driven: PoseGraph) -> None:
    graph = PoseGraph(SETTINGS)
    for _ in range(2):
        feed_odometry(graph, WORLD, range(len(WORLD.truth)))
    for row in range(len(WORLD.closures)):
        graph.add_closure(WORLD.message(row))
        assert graph.add_closure(WORLD.message(row)) == []
    graph.settle()
    assert accepted(graph) == accepted(driven)
    assert graph.counts["closure twice"] == len(WORLD.closures)
    assert len(graph.closures()) == len(WORLD.closures)


def broken(**changes: object) -> LoopClosure:
    return replace(WORLD.message(0), **changes)


@pytest.mark.parametrize(
    ("closure", "reason"),
    [
        (broken(match_T_query=np.full((4, 4), np.nan)), "not finite"),
        (broken(match_T_query=make_pose(2 * np.eye(3), np.zeros(3))), "not orthonormal"),
        (broken(match_T_query=np.eye(3)), "4x4"),
        (broken(match_T_query=make_pose(np.eye(3), [1e5, 0, 0])), "absurd translation"),
        (broken(covariance=np.zeros((6, 6))), "not positive definite"),
        (broken(covariance=np.diag([1.0, 1, 1, 1, 1, -1])), "not positive definite"),
        (broken(covariance=np.diag([1e-7] * 3 + [1e6] * 3)), "not positive definite"),
        (broken(covariance=1e308 * np.eye(6)), "absurd covariance"),
        (broken(covariance=1e-30 * np.eye(6)), "absurd covariance"),
        (broken(covariance=np.triu(np.ones((6, 6)))), "not symmetric"),
        (broken(covariance=np.full((6, 6), np.inf)), "not finite"),
        (broken(query_stamp_ns=WORLD.message(0).match_stamp_ns), "itself"),
    ],
)
def test_a_bad_closure_is_refused_and_counted(closure: LoopClosure, reason: str) -> None:
    graph = PoseGraph(SETTINGS)
    feed_odometry(graph, WORLD, range(len(WORLD.truth)))
    (verdict,) = graph.add_closure(closure)
    assert verdict.state is State.REFUSED and reason in verdict.reason
    assert [count for name, count in graph.counts.items() if "closure refused" in name] == [1]
    assert len(graph.trajectory()[0]) == len(WORLD.truth)


@pytest.mark.parametrize("pose", [np.full((4, 4), np.nan), make_pose(-np.eye(3), np.zeros(3)), np.eye(3)])
def test_bad_odometry_is_refused_and_counted(pose: Array) -> None:
    graph = PoseGraph(SETTINGS)
    assert not graph.add_odometry(1, pose)
    assert graph.add_odometry(2, np.eye(4))
    assert sum(graph.counts.values()) == 2 and graph.counts["odometry"] == 1
    assert not graph.add_odometry(3, np.eye(4), covariance=-np.eye(6))


def test_a_closure_waits_for_its_odometry() -> None:
    graph = PoseGraph(SETTINGS)
    closure = WORLD.closures[0]
    feed_odometry(graph, WORLD, range(closure.second))
    assert [v.state for v in graph.add_closure(WORLD.message(0))] == [State.PENDING]
    assert graph.update() == []
    feed_odometry(graph, WORLD, [closure.second])
    assert [v.state for v in graph.update()] != []
    assert [v.reason for v in graph.closures()] != [ClosureReason.NO_ODOMETRY_YET]


def test_a_closure_between_unknown_keyframes_times_out() -> None:
    graph = PoseGraph(SETTINGS)
    feed_odometry(graph, WORLD, range(100))
    graph.add_closure(replace(WORLD.message(0), match_stamp_ns=-5 * PERIOD_NS, query_stamp_ns=50 * PERIOD_NS))
    feed_odometry(graph, WORLD, range(100, 140))
    (verdict,) = graph.update()
    assert verdict.state is State.REFUSED and "no odometry" in verdict.reason


@pytest.mark.parametrize("shift_s", [-500, 10**6])
def test_a_closure_between_unknown_keyframes_times_out_by_the_new_clock(shift_s: int) -> None:
    """It was set back, or forward: neither counts as waiting."""
    graph = PoseGraph(SETTINGS)
    feed_odometry(graph, WORLD, range(100))
    unknown = replace(WORLD.message(0), match_stamp_ns=10 * PERIOD_NS, query_stamp_ns=3 * 10**6 * PERIOD_NS)
    graph.add_closure(unknown)
    graph.begin_session()
    states = []
    for k in range(140):
        graph.add_odometry((k + shift_s) * PERIOD_NS, WORLD.odometry[k])
        states += [verdict.state for verdict in graph.update()]
        assert k > SETTINGS.max_pending_s / 2 or not states
    assert states == [State.REFUSED]


def test_a_closure_between_odometry_stamps_is_interpolated() -> None:
    world = rover_loops(300, 12)
    graph = PoseGraph(SETTINGS.model_copy(update={"max_gap_s": 2.5}))
    feed_odometry(graph, world, (k for k in range(300) if k % 2 == 0))
    for row in range(len(world.closures)):
        graph.add_closure(world.message(row))
    graph.settle()
    assert len(accepted(graph)) > 0.5 * len(world.closures)


def test_revoking_by_hand_lasts_and_says_so(driven: PoseGraph) -> None:
    graph = drive(WORLD)
    first, second = sorted(accepted(graph))[0]
    (verdict,) = graph.decide_by_hand(first * PERIOD_NS, second * PERIOD_NS, State.REJECTED)
    assert verdict.state is State.REJECTED and "by hand" in verdict.reason
    graph.settle()
    assert accepted(graph) == accepted(driven) - {(first, second)}
    with pytest.raises(GraphError, match="no closure between"):
        graph.decide_by_hand(1, 2, State.REJECTED)


def test_a_correction_larger_than_allowed_is_refused() -> None:
    world = rover_loops(300, 12)
    graph = drive(world, SETTINGS.model_copy(update={"max_correction_m": 1e-3}))
    assert not accepted(graph)
    assert any("moves the pose by" in verdict.reason for verdict in graph.closures())


def test_a_failing_optimiser_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = PoseGraph(SETTINGS)
    feed_odometry(graph, WORLD, range(len(WORLD.truth)))

    def fail(*_: object) -> None:
        raise GraphError("indeterminate")

    with monkeypatch.context() as patch:
        patch.setattr(Sessions, "solve", fail)
        for row in range(len(WORLD.closures)):
            graph.add_closure(WORLD.message(row))
        assert graph.counts["optimiser: indeterminate"] > 0
        assert len(graph.trajectory()[0]) == len(WORLD.truth)
    graph.settle()
    assert accepted(graph) == right(WORLD)


def test_two_sessions_are_joined_by_their_closures() -> None:
    world = rover_loops(400, 13)
    cut = 200
    gauge = expmap(np.array([[0.1, 0, 2.0, 30, -20, 5]]))[0]
    odometry = world.odometry.copy()
    odometry[cut:] = gauge @ odometry[cut:]
    world = replace(world, odometry=odometry, chains=(0, cut))
    graph = PoseGraph(SETTINGS)
    feed_odometry(graph, world, range(cut))
    graph.begin_session()
    feed_odometry(graph, world, range(cut, 400))
    assert len(graph.trajectory()[0]) == cut
    for row in range(len(world.closures)):
        graph.add_closure(world.message(row))
    graph.settle()
    assert accepted(graph) == right(world)
    stamps, poses = graph.trajectory()
    assert len(stamps) == 400
    assert rms(poses, world.truth) < 3.0
    np.testing.assert_allclose(graph.map_T_odom() @ odometry[-1], poses[-1], atol=1e-9)


def test_the_newest_pose_has_the_marginal_of_the_full_graph() -> None:
    world = rover_loops(300, 12)
    graph = drive(world)
    poses = graph.trajectory()[1]
    full, values = whole_graph(world, poses, poses[0])
    expected = gtsam.Marginals(full, values).marginalCovariance(len(poses) - 1)
    found = ros_to_gtsam_covariance(graph.covariance(), poses[-1])
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=1e-5)


def test_results_can_be_read_back(driven: PoseGraph, tmp_path: Path) -> None:
    driven.write_results(tmp_path)
    content = read_g2o(tmp_path / "graph.g2o")
    stamps, poses = driven.trajectory()
    assert len(content.edges) == len(stamps) - 1 + len(accepted(driven))
    np.testing.assert_allclose(np.stack(list(content.poses.values())), poses, atol=1e-8)
    table = (tmp_path / "graph.csv").read_text().splitlines()
    assert table[0] == "id,session,stamp_ns" and table[3] == f"2,0,{stamps[2]}"
    lines = (tmp_path / "trajectory_optimized.tum").read_text().splitlines()
    assert len(lines) == len(stamps)
    values = lines[7].split()
    assert values[0] == "7.000000000" and all(len(value.split(".")[1]) == 9 for value in values)
    np.testing.assert_allclose([float(value) for value in values[1:4]], poses[7, :3, 3], atol=1e-9)
    verdicts = (tmp_path / "graph_verdicts.csv").read_text().splitlines()
    assert len(verdicts) == 1 + len(WORLD.closures)


def test_an_empty_graph_answers_everything(tmp_path: Path) -> None:
    graph = PoseGraph()
    assert graph.settle() == [] and graph.update() == []
    assert len(graph.trajectory()[0]) == len(graph.trajectory(optimized=False)[0]) == 0
    np.testing.assert_array_equal(graph.map_T_odom(), np.eye(4))
    np.testing.assert_array_equal(graph.covariance(), np.zeros((6, 6)))
    graph.write_results(tmp_path)
    assert (tmp_path / "trajectory_optimized.tum").read_text() == ""


def test_outlier_free_optimum_is_what_the_drive_ends_with(driven: PoseGraph) -> None:
    assert accepted(driven) == right(WORLD)
    assert rms(driven.trajectory()[1], batch_optimum(WORLD)) < 1e-3


def test_a_settled_graph_is_settled_again_only_after_new_input() -> None:
    world = rover_loops(300, 12)
    graph = drive(world)
    settled, seconds = graph.trajectory()[1], []
    for _ in range(2):
        before = time.process_time()
        assert graph.settle() == []
        seconds.append(time.process_time() - before)
        np.testing.assert_allclose(graph.trajectory()[1][: len(settled)], settled, atol=1e-9)
        graph.add_odometry(10**15, world.odometry[-1])
    assert seconds[0] < 0.1 * seconds[1]
