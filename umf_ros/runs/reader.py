"""Read the folder of a finished run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.bags.reader import Bag, stamp_span
from umf_ros.bags.trajectories import read_ground_truth, read_tum
from umf_ros.core.config import Settings, load_settings, topics_of
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import LoopClosure, Points
from umf_ros.core.trajectory import Trajectory
from umf_ros.pose_graph.closures import ClosureVerdict
from umf_ros.runs import run_file
from umf_ros.runs.writer import read_summary, write_summary
from umf_ros.verification.hypothesis import Hypothesis

TRUTH = "trajectory_truth.tum"
"""Truth that a run was judged by last."""
CLOCK_SLACK_NS = 5_000_000_000
"""Largest difference of stamps of sensors from the times of recording."""


@dataclass(frozen=True)
class FinishedRun:
    """Files of the nodes or the replay in a run folder, and the truth.

    Attributes:
        folder: of the run.
        summary: contents of `summary.json`.
        settings: those that the run was made with.
        closures: that were published; a closure's number is its place in this list, from 1.
        keyframes: (N,) `stamp_ns`, `session` and `path_length_m`, NaN without odometry, in the order of their stamps.
        candidates: all tested candidates.
        verdicts: final verdicts of the graph on the closures, by stamps of query and match; empty without a graph.
        odometry, optimized: trajectories, or None where they were not written.
        truth: or None.
    """

    folder: Path
    summary: dict[str, Any]
    settings: Settings
    closures: list[LoopClosure]
    keyframes: NDArray[np.void]
    candidates: list[Hypothesis]
    verdicts: dict[run_file.Endpoints, ClosureVerdict]
    odometry: Trajectory | None
    optimized: Trajectory | None
    truth: Trajectory | None

    @property
    def stamps(self) -> Any:
        """(N,) int64 ns of the keyframes."""
        return self.keyframes["stamp_ns"]

    @cached_property
    def descriptors(self) -> Points:
        """(N, D) of the keyframes."""
        found = run_file.read_descriptors(self.folder)
        return np.array([found[stamp] for stamp in self.stamps.tolist()], np.float32)

    @cached_property
    def latencies_ms(self) -> dict[int, float]:
        """Latency of each keyframe in ms, by its stamp."""
        path = self.folder / "latencies.csv"
        return dict(run_file.read_table(path, lambda row: (int(row["stamp_ns"]), float(row["total"]))))


def read_run(folder: Path, bag: Bag | None = None, truth: Trajectory | None = None) -> FinishedRun:
    """Read a run folder.

    Raises:
        UmfError: the folder holds no run, a file is damaged, or the run was made on another recording.
    """
    closures = run_file.read_closures(folder / "closures.csv")
    run = FinishedRun(
        folder=folder,
        summary=read_summary(folder),
        settings=load_settings(folder / "config.yaml"),
        closures=closures,
        keyframes=run_file.read_keyframes(folder / "keyframes.csv"),
        candidates=run_file.read_table(folder / "candidates.csv", run_file.parse_candidate),
        verdicts=run_file.read_verdicts(folder / "graph_verdicts.csv", closures),
        odometry=read_trajectory(folder / "trajectory_odometry.tum"),
        optimized=read_trajectory(folder / "trajectory_optimized.tum"),
        truth=truth,
    )
    if bag is not None:
        _check_recording(run, bag)
    return run


def describe_recording(bag: Bag) -> dict[str, Any]:
    """Return the `recording` entry of a summary: its path, start, end and message counts."""
    return {
        "path": str(bag.path.resolve()),
        "start_ns": bag.start_ns,
        "end_ns": bag.end_ns,
        "messages": {topic: info.count for topic, info in bag.topics.items()},
    }


def remember_recording(folder: Path, bag: Bag, **more: Any) -> None:
    """Write the recording of a run, and further entries, into its summary."""
    write_summary(folder, read_summary(folder) | {"recording": describe_recording(bag)} | more)


def _check_recording(run: FinishedRun, bag: Bag) -> None:
    """Refuse to judge a run by another recording: of another start or other messages, or of another time."""
    if known := run.summary.get("recording"):
        if (known["start_ns"], known["messages"]) != (bag.start_ns, describe_recording(bag)["messages"]):
            raise UmfError(f"{run.folder} was made on another recording, {known['path']}; nothing was written")
        return
    topics = topics_of(run.settings)
    first_ns, last_ns = stamp_span(bag, {topics.cloud, topics.left_image})
    outside = run.stamps[(run.stamps < first_ns - CLOCK_SLACK_NS) | (run.stamps > last_ns + CLOCK_SLACK_NS)]
    if 2 * len(outside) > len(run.stamps):
        raise UmfError(
            f"{run.folder} was made on another recording than {bag.path}: {len(outside)} of {len(run.keyframes)} "
            f"keyframes are outside its time, the first at {outside[0]} ns; nothing was written"
        )


def find_truth(folder: Path, bag: Bag | None, path: Path | None) -> Trajectory | None:
    """Return the truth of a file; without one that which the run was judged by last, else the recording's, or None."""
    kept = read_trajectory(folder / TRUTH) if path is None else None
    return kept or read_ground_truth(bag, path)


def read_trajectory(path: Path) -> Trajectory | None:
    """Return the trajectory of a file; None if there is no file, or nothing in it."""
    return read_tum(path) if path.is_file() and path.stat().st_size else None
