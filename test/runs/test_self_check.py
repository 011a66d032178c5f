"""Closures judged by the run itself: by loops with others, and by the overlap of local maps."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from command_line import umf
from graph_worlds import LAP, SETTINGS, two_laps
from graph_worlds import closing as closing_loops

from umf_ros.absolute.reference import AbsoluteReference
from umf_ros.core.config import dump_settings, load_settings
from umf_ros.core.geometry import invert, quantize, transform
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.lab.simulation.pose_graphs import GraphWorld, rover_loops, with_wrong_closures
from umf_ros.pose_graph.sessions import Sessions
from umf_ros.runs.run_file import SCAN_UNIT_M, Picture, RunFile, closure_row, read_table
from umf_ros.runs.self_check import TABLE, SelfCheck, judge
from umf_ros.sensors.decode import OdometrySample


def sessions_of(world: GraphWorld) -> Sessions:
    sessions = Sessions(SETTINGS, AbsoluteReference(SETTINGS))
    for row, pose in enumerate(world.odometry):
        sessions.chains[-1].add(row * 10**9, pose)
    return sessions


def judged(world: GraphWorld, scans: dict[int, np.ndarray] | None = None) -> SelfCheck:
    closures = [world.message(row) for row in range(len(world.closures))]
    return judge(sessions_of(world), closures, scans or {}, SETTINGS)


def test_loops_alone_name_wrong_closures() -> None:
    world = with_wrong_closures(rover_loops(900, 10003), 0.2, "random", 1)
    found, right = judged(world), np.array([one.right for one in world.closures])
    doubted = found.probabilities < 0.5
    assert doubted[~right].mean() > 0.8 and doubted[right].mean() < 0.05
    share, low, high = found.precision
    assert low < right.mean() < high and abs(share - right.mean()) < 0.1
    assert np.isnan(found.overlaps).all() and set(found.doubted) == set(np.flatnonzero(doubted).tolist())


def landscape() -> np.ndarray:
    """(N, 3) points of rough ground about the circle of two laps."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(-30, 60, (60_000, 2)) - (15, 15)
    z = sum(0.3 * np.sin(xy @ rng.normal(0, k, 2) + rng.uniform(0, 6)) for k in (0.5, 0.8, 1.2, 2.0, 2.5))
    return np.column_stack([xy, z])


def with_scans(world: GraphWorld) -> dict[int, np.ndarray]:
    """Scans of 10 m around every third pose."""
    ground, scans = landscape(), {}
    for row in range(0, len(world.truth), 3):
        points = transform(invert(world.truth[row]), ground)
        scans[row * 10**9] = points[np.linalg.norm(points, axis=1) < 10].astype(np.float32)
    return scans


def test_a_lone_wrong_closure_is_named_by_the_overlap_beside_it() -> None:
    right = closing_loops(two_laps(), [(10, 10 + LAP)], noise=0.1)
    wrong = closing_loops(two_laps(), [(10, 10 + LAP)], shift_m=(2.0, -2.0, 0.0))
    scans = with_scans(right)
    good, bad = judged(right, scans), judged(wrong, scans)
    assert good.overlaps[0] > good.beside[0] > 0 and good.probabilities[0] > 0.5 and not good.doubted
    assert bad.overlaps[0] < good.overlaps[0] and bad.doubted == [0] and "overlap" in bad.describe(0)
    # maps that show nothing in common
    apart = judged(right, {stamp: points + np.float32(100 * (stamp > LAP * 10**9)) for stamp, points in scans.items()})
    assert np.isnan(apart.overlaps).all() and not apart.doubted


def test_a_run_without_closures_has_nothing_to_judge() -> None:
    found = judged(two_laps())
    assert found.sentence == "not judged: no closures with odometry"
    assert not found.doubted and np.isnan(found.precision).all()


@pytest.mark.parametrize("live", [False, True])
def test_the_command_prints_precision_and_doubts_and_writes_a_table(tmp_path: Path, live: bool) -> None:
    world = closing_loops(two_laps(), [(k, k + LAP) for k in range(0, 60, 4)], noise=0.1)
    world = closing_loops(world, [(30, 30 + LAP)], shift_m=(4.0, 0.0, 0.0))
    (tmp_path / "config.yaml").write_text(dump_settings(load_settings()))
    with closing(RunFile(tmp_path)) as file:
        if live:  # the back-end exports it at the end
            stamps_ns = np.arange(len(world.odometry)) * 10**9
            write_tum(tmp_path / "trajectory_odometry.tum", Trajectory(stamps_ns, np.stack(list(world.odometry))))
        for row, pose in enumerate(() if live else world.odometry):
            file.append_odometry(OdometrySample(row * 10**9, pose))
        with file.writing():
            file.append("closures", [closure_row(world.message(row), 0.9) for row in range(len(world.closures))])
            for stamp, points in with_scans(world).items():
                file.append_picture(Picture(stamp, b"", 0, 0, quantize(points[:3000], SCAN_UNIT_M)))
    done = umf("judge", tmp_path)
    assert done.status == 0, done.err
    assert "1 of 16 closures doubted; judged from the run itself" in done.out
    assert f"doubted: closure {30 * 10**9} {(30 + LAP) * 10**9}, 100.0 s back" in done.out
    table = read_table(tmp_path / TABLE, lambda row: float(row["probability"]))
    assert len(table) == 16 and table[-1] < 0.5 < min(table[:-1])
