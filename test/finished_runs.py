"""Runs as tests need them: finished ones, made of numbers."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.config import Settings, load_settings
from umf_ros.core.frames import Candidate, LoopClosure
from umf_ros.core.geometry import Array, make_pose, relative
from umf_ros.core.io import write_table
from umf_ros.core.trajectory import Trajectory
from umf_ros.pose_graph.closures import ClosureReason, ClosureVerdict, State
from umf_ros.runs.reader import FinishedRun
from umf_ros.runs.run_file import COLUMNS, KEYFRAME, NAME, RunFile
from umf_ros.runs.truth import JudgedRun, judge_closures
from umf_ros.sensors.sensor_check import SensorReport
from umf_ros.verification import Hypothesis, RejectReason

START_NS = 1_600_000_000 * 10**9
LAP_S = 40
SUMMARY: dict[str, Any] = {
    "frames": 90,
    "pairs": 80,
    "keyframes": 40,
    "queries": 20,
    "closures_published": 5,
    "closures_rejected": 4,
    "ground_truth": None,
    "latency_ms": {stage: {"p50": p50} for stage, p50 in (("embed", 30), ("query", 1), ("verify", 9), ("total", 40))},
    "drops": {"image": 1, "worker": 0},
    "realtime_factor": 2.0,
    "peak_rss_mb": 512.4,
    "version": "1.2.3",
    "weights": "umf_light",
    "seed": 11,
}
BELOW = {
    "similarity": 0.8,
    "noise_m": 0.02,
    "residual_m": 0.02,
    "residual_p90_m": 0.05,
    "overlap": 0.9,
    "points": 900.0,
    "terrain_score": 5.0,
    "common": 0.7,
    "contradiction": 0.0,
    "rival_near": 0.1,
    "rival_far": 0.2,
    "position_std_m": 0.1,
    "heading_std_deg": 1.0,
    "probability": 0.6,
}


def stamp(second: float) -> int:
    return START_NS + round(second * 1e9)


def at(second: float) -> Array:
    """1 m/s along x for 40 s, then the same again: the rover was carried back."""
    return make_pose(np.eye(3), [second % LAP_S, 0.0, 0.0])


def trajectory(first: int = 0, last: int = 80) -> Trajectory:
    seconds = np.arange(first, last)
    return Trajectory(np.array([stamp(second) for second in seconds], np.int64), np.stack([at(s) for s in seconds]))


def closure(query_s: float, match_s: float, error_m: float = 0.0, probability: float = 0.97) -> LoopClosure:
    pose = relative(at(match_s), at(query_s)) @ make_pose(np.eye(3), [0, error_m, 0])
    return LoopClosure(stamp(query_s), stamp(match_s), pose, np.eye(6) * 0.01, probability)


def candidate(
    query_s: float, match_s: float, reason: RejectReason | None, looks: float = 0.8, detail: str = "", **numbers: float
) -> Hypothesis:
    """A hypothesis as a run keeps it; accepted without a reason."""
    probability = numbers.pop("probability", None)
    if reason is RejectReason.IMPROBABLE and probability is not None:
        detail = f"{probability:.2f} < 0.9"
    measurements = {"similarity": looks} | numbers
    place = Candidate(-1, stamp(match_s), looks)
    return Hypothesis(stamp(query_s), place, measurements, reason, detail, probability=probability)


def accepted(state: State = State.ACCEPTED, reason: ClosureReason = ClosureReason.AGREES) -> ClosureVerdict:
    return ClosureVerdict(closure(50, 10), state, reason, 2.0, 0.1)


def examined(
    folder: Path,
    closures: list[LoopClosure] | None = None,
    candidates: list[Hypothesis] | None = None,
    verdict: ClosureVerdict | None = None,
    truth: Trajectory | None = None,
    settings: Settings | None = None,
    sensors: SensorReport | None = None,
    missed: list[float] | None = None,
    keyframe_rows: list[tuple[int, int, float]] | None = None,
    ate: tuple[float, float] | None = None,
    **summary: Any,
) -> JudgedRun:
    """A run with a keyframe every two seconds, closures that all have one verdict of the graph, and a truth or none."""
    closures = closures or []
    rows = keyframe_rows
    if rows is None:
        rows = [(stamp(second), 0, float(second)) for second in range(0, 80, 2)]
    if not (folder / NAME).exists():
        with closing(RunFile(folder)) as file, file.writing():
            for number, row in enumerate(rows):
                file.append_descriptor(row[0], np.eye(64)[number % 64])
    write_table(folder / "latencies.csv", COLUMNS["latencies"], [(row[0], 30, 1, 9, 0, 40) for row in rows])
    run = FinishedRun(
        folder=folder,
        summary={**SUMMARY, **summary},
        settings=settings or load_settings(None),
        closures=closures,
        keyframes=np.array(rows, KEYFRAME),
        candidates=candidates or [],
        verdicts={(one.query_stamp_ns, one.match_stamp_ns): verdict for one in closures} if verdict else {},
        odometry=trajectory(),
        optimized=trajectory(),
        truth=truth,
    )
    if truth is None:
        return JudgedRun(run, sensors=sensors or SensorReport())
    by_stamp = {stamp(second): at(second) for second in range(80)}
    poses = [np.array([by_stamp[one.endpoints[end]] for one in closures]) for end in (0, 1)]
    return JudgedRun(
        run,
        closures=judge_closures(closures, *poses),
        revisits=(again := len(closures) + len(missed or [])),
        any_heading=(again, len(closures)),
        covered=(int(truth.at(run.stamps)[1].sum()), len(rows)),
        missed=[stamp(second) for second in missed or []],
        ate_odometry_m=ate and ate[0],
        ate_optimized_m=ate and ate[1],
        sensors=sensors or SensorReport(),
    )
