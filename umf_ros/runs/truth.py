"""A run held against the ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.config import Loop
from umf_ros.frames import LoopClosure
from umf_ros.geometry import Array, invert, make_pose, transform
from umf_ros.runs.loops import JudgedClosure, count_revisits, judge
from umf_ros.runs.tables import read_table
from umf_ros.trajectory import Trajectory

Endpoints = tuple[int, int]
"""Stamps in ns of a closure's query and match."""


@dataclass(frozen=True, slots=True)
class JudgedRun:
    """What the truth says of a run.

    Attributes:
        closures: one per closure whose endpoints the truth covers.
        revisits: keyframes that saw an earlier place again.
        ate_odometry_m: error of the odometry, or None without odometry.
        ate_optimized_m: error of the optimised trajectory, or None.
    """

    closures: list[JudgedClosure] = field(default_factory=list)
    revisits: int = 0
    ate_odometry_m: float | None = None
    ate_optimized_m: float | None = None

    def summary(self) -> dict[str, Any]:
        """The `ground_truth` entry of `summary.json`."""
        true = sum(judged.is_true for judged in self.closures)
        return {
            "closures_true": true,
            "closures_false": len(self.closures) - true,
            "revisits": self.revisits,
            "ate_odometry_m": _rounded(self.ate_odometry_m),
            "ate_optimized_m": _rounded(self.ate_optimized_m),
        }

    def by_endpoints(self) -> dict[Endpoints, JudgedClosure]:
        """The judged closures, to be found by the stamps of query and match."""
        return {endpoints(judged.closure): judged for judged in self.closures}


def endpoints(closure: LoopClosure) -> Endpoints:
    """Stamps in ns of the closure's query and match: what tells it from every other of a run."""
    return closure.query_stamp_ns, closure.match_stamp_ns


def judge_run(
    folder: Path,
    truth: Trajectory,
    closures: list[LoopClosure],
    rules: Loop,
    odometry: Trajectory | None,
    optimized: Trajectory | None,
) -> JudgedRun:
    """Hold closures, odometry and optimised trajectory of a run folder against the truth."""
    stamps, travelled = _read_keyframes(folder / "keyframes.csv")
    poses, known = truth.at(stamps)
    return JudgedRun(
        closures=_judge_closures(closures, truth),
        revisits=count_revisits(stamps[known], poses[known], travelled[known], rules, truth.has_orientation),
        ate_odometry_m=trajectory_error(odometry, truth),
        ate_optimized_m=trajectory_error(optimized, truth),
    )


def trajectory_error(estimate: Trajectory | None, truth: Trajectory) -> float | None:
    """ATE in metres where the truth covers the estimate; None when it covers fewer than three poses."""
    if estimate is None:
        return None
    poses, known = truth.at(estimate.stamps_ns)
    if np.count_nonzero(known) < 3:
        return None
    return absolute_trajectory_error(estimate.poses[known, :3, 3], poses[known, :3, 3])


def absolute_trajectory_error(estimate: Array, truth: Array) -> float:
    """Root mean square distance in metres of (N, 3) positions after rigid alignment [Sturm 2012]."""
    aligned = transform(align_rigidly(estimate, truth), estimate)
    return float(np.sqrt(np.mean(np.sum((aligned - truth) ** 2, axis=1))))


def positions_in_truth(trajectory: Trajectory, truth: Trajectory | None) -> Array:
    """Positions (N, 3) in metres, to be drawn in the frame of the truth.

    They are joined to the truth at the first pose that it covers, or laid best over a truth without headings.
    Without a truth, or one that covers fewer than three poses, they stay in the frame of the trajectory.
    """
    positions: Array = trajectory.poses[:, :3, 3]
    if truth is None:
        return positions
    poses, known = truth.at(trajectory.stamps_ns)
    if np.count_nonzero(known) < 3:
        return positions
    if not truth.has_orientation:
        return transform(align_rigidly(positions[known], poses[known, :3, 3]), positions)
    first = int(np.flatnonzero(known)[0])
    return transform(poses[first] @ invert(trajectory.poses[first]), positions)


def align_rigidly(estimate: Array, truth: Array) -> Array:
    """Pose `truth_T_estimate` that brings two (N, 3) point sets together best [Horn 1987].

    Raises:
        ValueError: fewer than three points, or sets of different size.
    """
    if estimate.shape != truth.shape or len(estimate) < 3:
        raise ValueError(f"cannot align {len(estimate)} positions with {len(truth)}")
    centre_estimate, centre_truth = estimate.mean(axis=0), truth.mean(axis=0)
    u, _, vt = np.linalg.svd((truth - centre_truth).T @ (estimate - centre_estimate))
    mirror = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    rotation = u @ mirror @ vt
    return make_pose(rotation, centre_truth - rotation @ centre_estimate)


def _judge_closures(closures: list[LoopClosure], truth: Trajectory) -> list[JudgedClosure]:
    if not closures:
        return []
    queries, query_known = truth.at(np.array([closure.query_stamp_ns for closure in closures], np.int64))
    matches, match_known = truth.at(np.array([closure.match_stamp_ns for closure in closures], np.int64))
    return [
        judge(closure, queries[i], matches[i], truth.has_orientation)
        for i, closure in enumerate(closures)
        if query_known[i] and match_known[i]
    ]


def _read_keyframes(path: Path) -> tuple[np.ndarray, np.ndarray]:
    rows = read_table(path, lambda row: (int(row["stamp_ns"]), float(row["travelled_m"])))
    return np.array([stamp for stamp, _ in rows], np.int64), np.array([metres for _, metres in rows], float)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
