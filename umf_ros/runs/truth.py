"""A run held against the ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.config import Loop
from umf_ros.frames import LoopClosure
from umf_ros.runs.loops import Judgement, count_revisits, judge
from umf_ros.runs.tables import read_table
from umf_ros.runs.trajectory_error import absolute_trajectory_error
from umf_ros.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class Judged:
    """What the truth says of a run.

    Attributes:
        judgements: one per closure whose ends the truth covers.
        revisits: keyframes that saw an earlier place again.
        ate_odometry_m: error of the odometry, or None without odometry.
        ate_optimized_m: error of the optimised trajectory, or None.
    """

    judgements: list[Judgement] = field(default_factory=list)
    revisits: int = 0
    ate_odometry_m: float | None = None
    ate_optimized_m: float | None = None

    def summary(self) -> dict[str, Any]:
        """The `ground_truth` entry of `summary.json`."""
        true = sum(judgement.is_true for judgement in self.judgements)
        return {
            "closures_true": true,
            "closures_false": len(self.judgements) - true,
            "revisits": self.revisits,
            "ate_odometry_m": _rounded(self.ate_odometry_m),
            "ate_optimized_m": _rounded(self.ate_optimized_m),
        }


def judge_run(
    folder: Path,
    truth: Trajectory,
    closures: list[LoopClosure],
    rules: Loop,
    odometry: Trajectory | None,
    optimized: Trajectory | None,
) -> Judged:
    """Hold closures, odometry and optimised trajectory of a run folder against the truth."""
    stamps, travelled = _read_keyframes(folder / "keyframes.csv")
    poses, known = truth.at(stamps)
    return Judged(
        judgements=_judge_closures(closures, truth),
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


def _judge_closures(closures: list[LoopClosure], truth: Trajectory) -> list[Judgement]:
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
