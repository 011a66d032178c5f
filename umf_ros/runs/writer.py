"""Write the folder of a run as it goes.

A folder or file that cannot be written raises an `OutputError`.
"""

from __future__ import annotations

import json
import time
from array import array
from collections.abc import Mapping
from contextlib import closing, suppress
from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from umf_ros import __version__
from umf_ros.core.config import Settings, dump_settings, load_settings
from umf_ros.core.errors import UmfError, writing
from umf_ros.core.frames import Frame, Keyframe
from umf_ros.core.geometry import Array, evenly, quantize
from umf_ros.core.io import memory_mb, write_atomically
from umf_ros.core.limits import read_json
from umf_ros.runs.run_file import (
    NAME,
    SCAN_UNIT_M,
    STAGES,
    Picture,
    RunFile,
    candidate_row,
    closure_row,
    inlier_rows,
    pose_numbers,
)
from umf_ros.sensors.sessions import Input
from umf_ros.sensors.synchronizer import InputCounter

if TYPE_CHECKING:
    from umf_ros.detector import Detection
    from umf_ros.fleet.inter_robot_closures import InterRobotClosure


PLACES = "places.sqlite"
"""Place database of an unfinished replay whose settings name none."""
PHOTO_WIDTH, PHOTO_QUALITY, SCAN_POINTS = 320, 60, 3000  # by hand: rocks stay recognisable, at some 30 kB per keyframe


def begin_folder(folder: Path, bag: Path) -> Path:
    """Make `folder`, if it is missing, the one of an unfinished replay of `bag`, and return it."""
    with writing(f"to {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    _note(folder, bag=str(bag.resolve()), finished=False)
    return folder


def is_unfinished(folder: Path, bag: Path) -> bool:
    """Return whether `folder` holds an unfinished replay of `bag`."""
    facts: dict[str, Any] = {}
    with suppress(UmfError), closing(RunFile(folder, read_only=True)) as file:
        facts = file.facts()
    return facts.get("bag") == str(bag.resolve()) and not facts.get("finished")


def is_of(folder: Path, settings: Settings) -> bool:
    """Return whether a replay was started with these settings; one that was killed before its first row has none."""
    path = folder / "config.yaml"
    return not path.exists() or load_settings(path) == settings


def unfinished_folder(out: Path, bag: Path, settings: Settings) -> Path | None:
    """Find the newest folder inside `out` of an unfinished replay of `bag`; None where there is none.

    A replay that was started with other settings raises an `UmfError`.
    """
    unfinished = [path.parent for path in sorted(out.glob(f"*/{NAME}"), reverse=True) if not path.parent.is_symlink()]
    for path in unfinished:
        if not is_unfinished(path, bag):
            continue
        if not is_of(path, settings):
            raise UmfError(f"{path} was started with other settings; leave out --resume, or pass the same options")
        (path / "summary.json").unlink(missing_ok=True)  # of a run interrupted by Ctrl-C
        return path
    return None


def with_places(settings: Settings, folder: Path) -> Settings:
    """Return the settings, with a place database in the folder of a replay if they name none."""
    places = settings.database.path or str(folder / PLACES)
    return settings.model_copy(update={"database": settings.database.model_copy(update={"path": places})})


def finish_folder(folder: Path) -> None:
    """Mark a replay as finished, and delete its place database."""
    for path in folder.glob(f"{PLACES}*"):
        path.unlink(missing_ok=True)
    _note(folder, finished=True)


def _note(folder: Path, **values: Any) -> None:
    with closing(RunFile(folder)) as file, file.writing():
        file.note(**values)


class RunRecorder(RunFile):
    """Writer of a run: `config.yaml` at once, `run.sqlite` keyframe by keyframe, CSV tables and `summary.json` last.

    A folder of an earlier process is continued: rows and counts of both are kept, and a stored
    keyframe, as of a recording that is played again, is not written twice.

    Args:
        folder: an existing, writable folder.
        settings: the effective settings.
        weights: name of the network's weights, for the summary.
        resume: all frames of the recording are processed and counted again.

    Attributes:
        recorded: stamps and sessions of the keyframes in the folder.
        earlier_closures: closures that an earlier process wrote.

    Raises:
        UmfError: another process writes the folder, or its file is damaged.
    """

    def __init__(self, folder: Path, settings: Settings, weights: str, resume: bool = False) -> None:
        self._settings, self._weights = settings, weights
        write_atomically(folder / "config.yaml", dump_settings(settings))
        super().__init__(folder)
        self.recorded = {(int(row[0]), int(row[1])) for row in self.rows("keyframes")}
        self.earlier_closures = self.closures()
        self._pairs = {closure.endpoints for closure in self.earlier_closures}
        latencies = self.rows("latencies")
        self._latency = {
            stage: array("f", (value for row in latencies if not isnan(value := float(row[place]))))
            for place, stage in enumerate(STAGES, 1)
        }
        self._counts = self._earlier_counts(resume)
        self._started = time.monotonic()
        self._recorded_ns = 0
        self._last_stamp_ns: int | None = None

    def record(self, frame: Frame, detection: Detection) -> None:
        """Write the results of one frame in one transaction."""
        self.count(frame)
        if self._last_stamp_ns is not None:
            self._recorded_ns += max(0, frame.stamp_ns - self._last_stamp_ns)
        self._last_stamp_ns = frame.stamp_ns
        keyframe = detection.keyframe
        if keyframe is None or (keyframe.stamp_ns, keyframe.session) in self.recorded:
            return
        stamp_ns = keyframe.stamp_ns
        accepted = [one for one in detection.verdicts if one.closure]
        new = [one for one in accepted if one.endpoints not in self._pairs]
        times = [f"{detection.latency_ms.get(stage, nan):.1f}" for stage in STAGES]
        closures = [closure_row(one.closure, one.candidate.similarity) for one in new if one.closure]
        with self.writing():
            self.append("keyframes", [[stamp_ns, keyframe.session, f"{keyframe.path_length_m:.4f}"]])
            self.append("latencies", [[stamp_ns, *times]])
            self.append_descriptor(stamp_ns, keyframe.embedding.descriptor)
            self.append_picture(picture_of(frame, keyframe))
            self.append("candidates", [candidate_row(one) for one in detection.verdicts])
            self.append("closures", closures)
            self.append("inliers", [row for one in new for row in inlier_rows(one)])
            self.note(**self._facts())
        self._counts["keyframes"] += 1
        self._counts["queries"] += bool(detection.verdicts)
        self._counts["closures_rejected"] += len(detection.verdicts) - len(accepted)
        self._counts["closures_published"] += len(new)
        self._pairs.update(one.endpoints for one in new)
        self.recorded.add((stamp_ns, keyframe.session))
        for stage, milliseconds in detection.latency_ms.items():
            self._latency[stage].append(milliseconds)

    def record_inter_robot(self, inter_closure: InterRobotClosure) -> None:
        """Write the closures with another rover of a fleet."""
        rows = [[inter_closure.robot, *closure_row(one, nan)] for one in inter_closure.closures]
        with self.writing():
            self.append("closures_between", rows)

    def record_pose(self, stamp_ns: int, map_T_body: Array, covariance: Array, probability: float) -> None:
        """Write a pose in the map to `localization.csv`; its covariance (6, 6) is in ROS order."""
        numbers = *pose_numbers(map_T_body, covariance), probability
        with self.writing():
            self.append("localization", [[stamp_ns, *(f"{number:.6g}" for number in numbers)]])

    def count(self, frame: Frame) -> None:
        """Count a frame, including frames processed before."""
        self._counts["frames"] += 1
        self._counts["pairs"] += frame.left is not None and frame.points is not None

    def summary(self, drops: Mapping[str, int]) -> dict[str, Any]:
        """Return the contents of `summary.json`; `ground_truth` is filled in by the report."""
        elapsed_s = time.monotonic() - self._started
        return {
            **self._counts,
            "ground_truth": None,
            "latency_ms": {stage: _percentiles(values) for stage, values in self._latency.items()},
            "drops": dict(drops),
            "realtime_factor": round(self._recorded_ns * 1e-9 / max(elapsed_s, 1e-9), 3),
            "peak_rss_mb": round(memory_mb(peak=True), 1),
            "seed": self._settings.verification.seed,
            "version": __version__,
            "weights": self._weights,
        }

    def write_summary(self, drops: Mapping[str, int]) -> None:
        """Write `summary.json`; may be called again as the run goes on."""
        write_summary(self._folder, self.summary(drops))

    def close(self) -> None:
        """Export the CSV tables, and close the file."""
        try:
            self.export(self._settings.localizing)
            with self.writing():
                self.note(**(self._facts() | {"exported": True}))
        finally:
            super().close()

    def _facts(self) -> dict[str, Any]:
        """Return the facts about a run that `umf report` reads from the file of a killed process."""
        counts = {name: self._counts[name] for name in ("frames", "pairs")}
        return counts | {"weights": self._weights, "exported": False}

    def _earlier_counts(self, resume: bool) -> dict[str, int]:
        """Count the rows in the file; all frames of a resumed recording are counted again."""
        facts = self.facts() if not resume else {}
        candidates = self.rows("candidates")
        return {
            "frames": int(facts.get("frames", 0)),
            "pairs": int(facts.get("pairs", 0)),
            "keyframes": len(self.recorded),
            "queries": len({row[0] for row in candidates}),
            "closures_published": len(self.earlier_closures),
            "closures_rejected": sum(row[3] != "accepted" for row in candidates),
        }


def picture_of(frame: Frame, keyframe: Keyframe) -> Picture:
    """Reduce the left image and the scan of a keyframe to the size in the report."""
    points = keyframe.points[evenly(len(keyframe.points), SCAN_POINTS)]
    scan = quantize(points, SCAN_UNIT_M)
    if frame.left is None:
        return Picture(frame.stamp_ns, b"", 0, 0, scan)
    height, width = frame.left.shape
    size = min(width, PHOTO_WIDTH), max(1, round(height * min(1.0, PHOTO_WIDTH / width)))
    reduced = cv2.resize(frame.left, size, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", reduced, [cv2.IMWRITE_JPEG_QUALITY, PHOTO_QUALITY])
    return Picture(frame.stamp_ns, jpeg.tobytes(), width, height, scan)


def count_drops(counters: Mapping[Input, InputCounter], worker: int = 0) -> dict[str, int]:
    """Return the `drops` entry of the summary: messages lost for a reason that should not happen, by input."""
    lost = {name: counters[name].lost for name in ("cloud", "odometry")}
    return {"image": counters["left"].lost + counters["right"].lost, **lost, "worker": worker}


def write_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Write `summary.json` in one step."""
    write_atomically(folder / "summary.json", json.dumps(summary, indent=2) + "\n")


def read_summary(folder: Path) -> dict[str, Any]:
    """Read the folder's `summary.json`; raise an `UmfError` if it is missing or not from a run."""
    path = folder / "summary.json"
    if not path.is_file():
        raise UmfError(f"{folder} holds no finished run: summary.json is missing")
    try:
        content = read_json(path)
    except ValueError:
        content = None
    if not isinstance(content, dict) or "closures_published" not in content:
        raise UmfError(f"{path} is not a summary of a run")
    return content


def _percentiles(values: array[float]) -> dict[str, float | None]:
    if not values:
        return {"p50": None, "p95": None, "max": None}
    copied = values[:]  # numpy would lock the array itself, and another thread appends to it
    p50, p95 = np.percentile(copied, [50, 95])
    return {"p50": round(float(p50), 3), "p95": round(float(p95), 3), "max": round(max(copied), 3)}
