"""How whole systems are judged: on a drive there and back again, with closures made by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.accuracy.system_peers import Scans, found
from benchmarks.accuracy.systems import OURS, SETTINGS, FoundClosure, SystemRun, drive_of, judge
from umf_ros.core.config import Loop
from umf_ros.core.geometry import make_pose, relative
from umf_ros.core.trajectory import Trajectory

SECOND = 10**9
LAP = 100


def poses() -> np.ndarray:
    """Two laps of a square of 25 m, one metre and one second apart."""
    along = np.arange(2 * LAP) % LAP
    corner = np.array([[0, 0], [25, 0], [25, 25], [0, 25], [0, 0]], float)
    side, way = along // 25, (along % 25)[:, None] / 25
    place = corner[side] * (1 - way) + corner[side + 1] * way
    turns = side * np.pi / 2
    rotation = [[[np.cos(t), -np.sin(t), 0], [np.sin(t), np.cos(t), 0], [0, 0, 1]] for t in turns]
    return np.stack([make_pose(r, [*p, 0]) for r, p in zip(rotation, place, strict=True)])


STAMPS = np.arange(2 * LAP) * SECOND
TRUTH = Trajectory(STAMPS, poses())


def drive():  # type: ignore[no-untyped-def]
    return drive_of(Path("a.mcap"), TRUTH, STAMPS, poses(), Loop(), Path())


def closure(query: int, match: int, shift_m: float = 0.0, window: tuple[int, int] | None = None) -> FoundClosure:
    edge = relative(poses()[match], poses()[query]) @ make_pose(np.eye(3), [shift_m, 0, 0])
    first, last = window or (query, query)
    return FoundClosure(query * SECOND, match * SECOND, (first * SECOND, last * SECOND), edge)


def scores(*closures: FoundClosure):  # type: ignore[no-untyped-def]
    return judge(SystemRun(closures, cpu_s=4.0, memory_mb=100.0), drive())


def test_closures_are_true_within_the_coarse_limits() -> None:
    judged = scores(closure(110, 10), closure(130, 30, shift_m=1.0), closure(150, 50, shift_m=4.0), closure(170, 20))
    assert (judged.true, judged.false) == (4 - 1, 1)  # an edge far off in place may be right; its shift is not
    assert judged.error_m == pytest.approx(0.0, abs=1e-6)
    assert judged.cpu_ms == pytest.approx(20.0) and judged.ate_m is None


def test_a_window_counts_once_whoever_closed_it() -> None:
    one, many = scores(closure(110, 10)), scores(*(closure(row, row - LAP) for row in range(105, 120)))
    assert one.any_heading == many.any_heading
    wide = scores(closure(150, 50, window=(105, 195)))
    assert wide.any_heading > 3 * one.any_heading
    assert scores().any_heading == 0.0 and np.isnan(scores().error_m)


def test_a_false_closure_closes_nothing() -> None:
    assert scores(closure(150, 50, shift_m=9.0, window=(105, 195))).any_heading == 0.0


def test_peers_get_windows_of_the_drive(tmp_path: Path) -> None:
    points = np.ones((2 * LAP * 3, 3), np.float32)
    np.savez(tmp_path / "a.npz", points=points, first=np.arange(0, 601, 3), stamps=STAMPS, odom_T_body=poses())
    scans = Scans(tmp_path / "a.npz")
    windows = list(scans.windows(50.0))
    assert [len(rows) for rows in windows] == [50, 50, 50, 50] or sum(map(len, windows)) == 2 * LAP
    assert windows[0].stop == windows[1].start
    placed = scans.local_map(range(0, 3), every=1)  # one metre apart, seen from the middle one
    np.testing.assert_allclose(sorted(set(placed[:, 0].round(6))), [0, 1, 2])
    told = found(scans, windows[1], windows[0], np.eye(4))
    assert told["query_window"] == [int(STAMPS[windows[1][0]]), int(STAMPS[windows[1][-1]])]


def test_every_system_has_settings_of_its_own() -> None:
    assert {"fused", "lidar", "camera"} == set(OURS)
    peers = {peer for peer, _ in SETTINGS.values()}
    assert {f"{peer}_tuned" for peer in peers} | peers == set(SETTINGS)
