"""Odometry that restarts, jumps or is silent in the middle of a drive: sessions, accepted closures and path.

    python benchmarks/robustness/odometry_restarts.py DEMO.mcap [...]                     # closures of one replay
    python benchmarks/robustness/odometry_restarts.py DEMO.mcap --replay --gaps 0.5 10    # one replay for each case

The odometry is silent for a gap in the middle of the drive and continues as the case says. Prints for each case and gap
the number of sessions, the right closures that the graph accepted of all whose keyframes have odometry, wrong ones
accepted, and the trajectory error (ATE, of the largest part of the map) in m; the first row is the undisturbed drive.
A jump or a turn that the speed of the rover explains after a silence may stay in its session: closures correct it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import Bag, open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.commands.recordings import open_recording
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, make_pose
from umf_ros.core.trajectory import Trajectory
from umf_ros.lab.program import replay
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import ClosureReason, State
from umf_ros.runs.run_file import read_closures
from umf_ros.runs.truth import absolute_trajectory_error, judge_closures
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sessions import OdometrySessionSplitter

GAPS_S = (0.0, 0.5, 2.0, 5.0, 10.0, 30.0)
Move = Callable[[Array, Array], Array]
"""From the first pose after the gap and the poses (N, 4, 4) from there to the poses as they are reported."""


def _restart(first: Array, poses: Array) -> Array:
    return np.linalg.inv(first) @ poses


def _turned(first: Array, poses: Array) -> Array:
    turn = make_pose(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0, 0, 0])
    return first @ turn @ np.linalg.inv(first) @ poses


def _jump(_: Array, poses: Array) -> Array:
    return make_pose(np.eye(3), [30, 0, 0]) @ poses


CASES: dict[str, tuple[tuple[float, ...], Move]] = {
    "carried on": ((0.5,), lambda _, poses: poses),
    "restart at the origin": ((0.5,), _restart),
    "two restarts": ((0.35, 0.65), _restart),
    "jump of 30 m": ((0.5,), _jump),
    "turned by 90 deg in place": ((0.5,), _turned),
}
"""Moments as shares of the drive, and what happens then."""
EXPLAINED_S = 5.0
"""Silence from which on the speed of a rover may explain a jump or a turn."""


def right_sessions(odometry: Trajectory, case: str, gap_s: float) -> tuple[int, ...]:
    """Return the numbers of sessions that are right; a restart without odometry after it begins none."""
    moments, move = CASES[case]
    first, last = odometry.stamps_ns[[0, -1]].tolist()
    begun = np.searchsorted(first + np.array(moments) * (last - first), disturbed(odometry, case, gap_s).stamps_ns)
    count = 1 if case == "carried on" else len(np.unique(begun))
    return (count,) if move is _restart or gap_s < EXPLAINED_S else (1, count)


def disturbed(odometry: Trajectory, case: str, gap_s: float) -> Trajectory:
    """Return the odometry of a case."""
    moments, move = CASES[case]
    stamps, poses, keep = odometry.stamps_ns, odometry.poses.copy(), np.ones(len(odometry), bool)
    for share in moments:
        begin_ns = int(stamps[0] + share * (stamps[-1] - stamps[0]))
        end_ns = begin_ns + round(gap_s * 1e9)
        keep &= (stamps <= begin_ns) | (stamps > end_ns)
        rows = stamps > end_ns
        if not rows.any():
            break
        poses[rows] = move(poses[rows][0], poses[rows])
    return Trajectory(stamps[keep], poses[keep])


def replayed(path: Path, odometry: Trajectory | None, folder: Path) -> list[LoopClosure]:
    """Return the closures that a replay with this odometry finds, or with the recording's own."""
    recording, settings = open_recording(path, None)
    replay(recording, settings, folder, odometry)
    return read_closures(folder / "closures.csv")


def graph_of(odometry: Trajectory, closures: list[LoopClosure]) -> tuple[PoseGraph, int]:
    """Return the settled graph and its number of sessions."""
    graph = PoseGraph()
    splitter, waiting = OdometrySessionSplitter(graph), sorted(closures, key=lambda one: one.query_stamp_ns)
    for stamp_ns, pose in zip(odometry.stamps_ns.tolist(), odometry.poses, strict=True):
        splitter.take(stamp_ns, pose)
        while waiting and waiting[0].query_stamp_ns <= stamp_ns:
            graph.add_closure(waiting.pop(0))
    splitter.finish()
    graph.add_closures(waiting)
    graph.settle()
    return graph, len(graph.session_spans())


def row_of(graph: PoseGraph, closures: list[LoopClosure], truth: Trajectory) -> tuple[int, int, int, float]:
    """Return right closures accepted, right ones, wrong ones accepted, and the trajectory error (ATE) in m."""
    matches, queries = (truth.at(np.array(stamps))[0] for stamps in zip(*(one.pair for one in closures), strict=True))
    judged = judge_closures(closures, queries, matches).is_true
    without = (ClosureReason.NO_ODOMETRY_YET, ClosureReason.NO_ODOMETRY, ClosureReason.BEFORE_ODOMETRY)
    placed = {one.closure.pair for one in graph.closures() if one.reason not in without}
    right = placed & {one.pair for one, is_true in zip(closures, judged, strict=True) if is_true}
    accepted = {one.closure.pair for one in graph.closures() if one.state is State.ACCEPTED}
    estimate, known = graph.poses_at(truth.stamps_ns)
    error_m = absolute_trajectory_error(estimate[known, :3, 3], truth.poses[known, :3, 3])
    return len(accepted & right), len(right), len(accepted - right), error_m


def odometry_of(bag: Bag, path: Path) -> Trajectory:
    """Return the odometry of a recording."""
    settings = open_recording(path, None)[1]
    reader = FrameReader(bag, settings)
    found = Trajectory.rising(
        (one.stamp_ns, one.odom_T_body) for one in reader.stream() if isinstance(one, OdometrySample)
    )
    assert found is not None
    return found


def main() -> None:
    """Print a table for each recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", nargs="+", type=Path)
    parser.add_argument("--gaps", nargs="+", type=float, default=list(GAPS_S), help="silence of the odometry, s")
    parser.add_argument("--replay", action="store_true", help="replay each case instead of the graph alone")
    parser.add_argument("--only", default="", help="cases whose names contain this")
    given = parser.parse_args()
    for path in given.bags:
        bag = open_bag(path)
        truth, odometry = read_ground_truth(bag), odometry_of(bag, path)
        assert truth is not None, "the recording has no ground truth"
        with TemporaryDirectory() as folder:
            closures = replayed(path, None, Path(folder))
        graph, sessions = graph_of(odometry, closures)
        print(f"{path.name}: undisturbed: {_words(sessions, (1,), row_of(graph, closures, truth))}", flush=True)
        for case in CASES:
            for gap_s in given.gaps if given.only in case else ():
                changed, found = disturbed(odometry, case, gap_s), closures
                if given.replay:
                    with TemporaryDirectory() as folder:
                        found = replayed(path, changed, Path(folder))
                graph, sessions = graph_of(changed, found)
                told = _words(sessions, right_sessions(odometry, case, gap_s), row_of(graph, found, truth))
                print(f"{path.name}: {case}, {gap_s:g} s: {told}", flush=True)


def _words(sessions: int, expected: tuple[int, ...], row: tuple[int, int, int, float]) -> str:
    accepted, right, wrong, error_m = row
    told = f"{sessions} sessions" + ("" if sessions in expected else f" (NOT {expected[-1]})")
    return f"{told}, {accepted} of {right} right closures accepted, {wrong} wrong, ATE {error_m:.2f} m"


if __name__ == "__main__":
    main()
