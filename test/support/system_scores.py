"""Runs of whole systems, held against the truth of their drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Loop
from umf_ros.core.geometry import Array, relative, rotation_angle
from umf_ros.core.trajectory import Trajectory
from umf_ros.runs.truth import find_revisits

WINDOW_M = 25.0


TRUE_M, TRUE_DEG = 3.0, 15.0


OURS: dict[str, dict[str, Any]] = {
    "fused": {},
    "lidar": {"topics": {"left_image": "/none/left", "right_image": ""}},
    "camera": {"topics": {"cloud": "/none/cloud"}},
}


SETTINGS: dict[str, tuple[str, dict[str, Any]]] = {
    "kiss_slam": ("kiss_slam", {"splitting_distance": 100.0}),
    "kiss_slam_tuned": ("kiss_slam", {"splitting_distance": 10.0}),
    "map_closures": ("map_closures", {"window_m": 100.0}),
    "map_closures_tuned": ("map_closures", {"window_m": 10.0, "density_map_resolution": 0.25, "inliers_threshold": 3}),
    "kiss_matcher": ("kiss_matcher", {"voxel_m": 0.3, "inliers": 5}),
    "kiss_matcher_tuned": ("kiss_matcher", {"voxel_m": 0.5, "inliers": 8}),
}
"""Peer and settings; the tuned ones are the best of a few on validation drives, never on test drives."""


@dataclass(frozen=True)
class FoundClosure:
    """A closure between two windows of a drive, stamps in ns.

    Attributes:
        query, match: stamps of the poses that it relates.
        query_window: first and last stamp that its query stands for.
        match_T_query: the edge.
    """

    query: int
    match: int
    query_window: tuple[int, int]
    match_T_query: Array


@dataclass(frozen=True)
class SystemRun:
    """Results of one system.

    Attributes:
        closures: found.
        cpu_s: of all threads.
        memory_mb: peak.
        ate_m: error of its trajectory; None where it makes none.
    """

    closures: Sequence[FoundClosure]
    cpu_s: float
    memory_mb: float
    ate_m: float | None = None


@dataclass(frozen=True)
class SystemScores:
    """A run held against the truth; shares are of windows that saw a place again."""

    true: int
    false: int
    same_heading: float
    any_heading: float
    error_m: float
    ate_m: float | None
    cpu_ms: float
    memory_mb: float


@dataclass(frozen=True)
class Drive:
    """A recording's scans and truth.

    Attributes:
        bag: the recording.
        scans: how many there are.
        truth: poses.
        stamps: (K,) ns of a keyframe every half metre.
        same, again: (K,) bool, whether each saw an earlier place, in the same heading or in any.
        window: (K,) which 25 m it belongs to.
        files: for the peers.
    """

    bag: Path
    scans: int
    truth: Trajectory
    stamps: NDArray[np.int64]
    same: NDArray[np.bool_]
    again: NDArray[np.bool_]
    window: NDArray[np.int64]
    files: Path = field(default_factory=Path)


def judge(run: SystemRun, drive: Drive) -> SystemScores:
    """Hold a run against the truth of its drive."""
    errors, closed = [], np.zeros(len(drive.stamps), bool)
    for closure in run.closures:
        poses, known = drive.truth.at(np.array([closure.match, closure.query]))
        if not known.all():
            continue
        error = np.linalg.inv(relative(poses[0], poses[1])) @ closure.match_T_query
        metres, degrees = float(np.linalg.norm(error[:3, 3])), float(np.degrees(rotation_angle(error)))
        errors.append(metres)
        if metres <= TRUE_M and degrees <= TRUE_DEG:
            first, last = closure.query_window
            closed |= (drive.stamps >= first) & (drive.stamps <= last)
            closed[np.abs(drive.stamps - closure.query).argmin()] = True
        else:
            errors[-1] = float("nan")
    true = int(np.isfinite(errors).sum())
    same, again = (share_of_windows(seen, closed, drive.window) for seen in (drive.same, drive.again))
    error_m = float(np.nanmedian(errors)) if true else float("nan")
    cpu_ms = 1e3 * run.cpu_s / drive.scans
    return SystemScores(true, len(errors) - true, same, again, error_m, run.ate_m, cpu_ms, run.memory_mb)


def share_of_windows(seen: NDArray[np.bool_], closed: NDArray[np.bool_], window: NDArray[np.int64]) -> float:
    """Share of the windows with a keyframe that saw its place again, of which some keyframe is closed."""
    wanted = np.unique(window[seen])
    return float(np.isin(wanted, window[closed]).mean()) if len(wanted) else float("nan")


def drive_of(
    bag: Path, truth: Trajectory, scans: NDArray[np.int64], odom_T_body: Array, loop: Loop, files: Path
) -> Drive:
    steps = np.linalg.norm(np.diff(odom_T_body[:, :3, 3], axis=0), axis=1)
    path_length = np.concatenate([[0], np.cumsum(steps)])
    kept = np.unique(np.searchsorted(path_length, np.arange(0, path_length[-1], 0.5)).clip(max=len(scans) - 1))
    poses, known = truth.at(scans[kept])
    kept, poses = kept[known], poses[known]
    same, again = (find_revisits(scans[kept], poses, path_length[kept], loop, view) for view in (True, False))
    window = (path_length[kept] // WINDOW_M).astype(int)
    return Drive(bag, len(scans), truth, scans[kept], same, again, window, files)
