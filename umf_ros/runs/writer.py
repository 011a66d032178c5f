"""Write the folder of a run while it goes."""

from __future__ import annotations

import json
import os
import resource
import time
from array import array
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from umf_ros import __version__
from umf_ros.core.config import Settings, dump_settings, load_settings
from umf_ros.core.errors import OutputError, UmfError, writing
from umf_ros.core.frames import Frame, LoopClosure, Points
from umf_ros.core.io import atomic_write
from umf_ros.detector import Detection
from umf_ros.runs import tables
from umf_ros.sensors.buffers import InputCounter
from umf_ros.sensors.sessions import Input

if TYPE_CHECKING:
    from umf_ros.fleet.inter_robot_closures import InterRobotClosure


def create_run_folder(out: Path, latest: bool = True) -> Path:
    """Make a new folder named after the local time inside `out`.

    Args:
        out: the folder of all runs.
        latest: whether `out/latest` leads to it from now on, as it should for runs, whose report it shows.

    Raises:
        OutputError: `out` cannot be written.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    with writing(f"to {out}"):
        out.mkdir(parents=True, exist_ok=True)
        folder = _make_unique(out, stamp)
        if latest:  # in one step, so that it always leads to a folder
            fresh = out / f".latest-{os.getpid()}"
            fresh.symlink_to(folder.name, target_is_directory=True)
            fresh.replace(out / "latest")
    return folder


def check_writable(out: Path) -> None:
    """Find out before hours of work whether the results will have a place.

    Raises:
        OutputError: `out` cannot be written.
    """
    with writing(f"to {out}"):
        out.mkdir(parents=True, exist_ok=True)
    if not os.access(out, os.W_OK):
        raise OutputError(f"cannot write to {out}: permission denied")


def _make_unique(out: Path, name: str) -> Path:
    for suffix in ["", *(f"_{i}" for i in range(2, 1000))]:
        with suppress(FileExistsError):
            (out / (name + suffix)).mkdir()
            return out / (name + suffix)
    raise OutputError(f"too many runs named {name} in {out}")


def write_atomically(path: Path, text: str) -> None:
    """Write a text file that is never seen half-written.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")


NAME = "descriptors.f16"
_HEAD = np.dtype("<i4")


def _record(dimension: int) -> np.dtype[np.void]:
    return np.dtype([("stamp_ns", "<i8"), ("descriptor", "<f2", (dimension,))])


class DescriptorFile:
    """Appends stamps and descriptors in half precision behind one number, their dimension.

    What an earlier process left stays, less a last record that was not finished.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        with writing(self._path):
            self._file: BinaryIO = self._path.open("ab", buffering=0)
            size = self._path.stat().st_size
            if size >= _HEAD.itemsize:
                step = _record(int(np.fromfile(self._path, _HEAD, 1)[0])).itemsize
                self._file.truncate(size - (size - _HEAD.itemsize) % step)
            self._empty = size < _HEAD.itemsize

    def append(self, stamp_ns: int, descriptor: Points) -> None:
        """Write the descriptor (D,) of one keyframe."""
        with writing(self._path):
            if self._empty:
                self._file.truncate(0)
                self._file.write(np.array(len(descriptor), _HEAD).tobytes())
                self._empty = False
            self._file.write(np.array((stamp_ns, descriptor), _record(len(descriptor))).tobytes())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def all_descriptors(folder: Path) -> Points:
    """Descriptors (N, D) float32 of all keyframes of a run, in order.

    Raises:
        UmfError: it has none.
    """
    rows = _read(folder)
    if rows is None or not len(rows):
        raise UmfError(f"{folder} holds no descriptors of keyframes")
    return rows["descriptor"].astype(np.float32)


def read_descriptors(folder: Path, stamps_ns: Sequence[int]) -> Points | None:
    """Descriptors (N, D) float32 of keyframes by their stamps; None where one has none, as of an older version."""
    rows = _read(folder)
    if rows is None or not stamps_ns:
        return None
    place = {int(stamp): row for row, stamp in enumerate(rows["stamp_ns"])}
    if any(stamp not in place for stamp in stamps_ns):
        return None
    return rows["descriptor"][[place[stamp] for stamp in stamps_ns]].astype(np.float32)


def _read(folder: Path) -> NDArray[np.void] | None:
    path = folder / NAME
    content = path.read_bytes() if path.is_file() else b""
    if len(content) < _HEAD.itemsize:
        return None
    kind = _record(int(np.frombuffer(content, _HEAD, 1)[0]))
    return np.frombuffer(content, kind, (len(content) - _HEAD.itemsize) // kind.itemsize, _HEAD.itemsize)


PLACES = "places.sqlite"
"""Where a replay without a store of its own keeps its places until it is finished."""
_RUN = "run.json"


class ReplayFolder:
    """The folder of a replay, new or that of one that was cut off.

    Args:
        path: the folder.
        settings: of the run.
        resumed: whether an earlier process has begun it.
    """

    def __init__(self, path: Path, settings: Settings, resumed: bool = False) -> None:
        self.path = path
        self.resumed = resumed
        self._settings = settings

    @classmethod
    def create(cls, out: Path, bag: Path, settings: Settings) -> ReplayFolder:
        """Make a new folder inside `out` for a replay of `bag`.

        Raises:
            OutputError: it cannot be written.
        """
        folder = cls(create_run_folder(out), settings)
        write_atomically(folder.path / _RUN, json.dumps({"bag": str(bag.resolve()), "finished": False}) + "\n")
        return folder

    @classmethod
    def resume(cls, out: Path, bag: Path, settings: Settings) -> ReplayFolder:
        """The newest folder inside `out` of a replay of `bag` that was not finished; a new one where there is none.

        Raises:
            UmfError: it was begun with other settings.
            OutputError: a new one cannot be written.
        """
        begun = [path.parent for path in sorted(out.glob(f"*/{_RUN}"), reverse=True) if not path.parent.is_symlink()]
        for path in begun:
            about = _resumption_read(path / _RUN)
            if about.get("bag") != str(bag.resolve()) or about.get("finished") is not False:
                continue
            # cut off before its settings were written: nothing is in it
            if (path / "config.yaml").exists() and load_settings(path / "config.yaml") != settings:
                raise UmfError(f"{path} was begun with other settings; leave out --resume, or give the same options")
            (path / "summary.json").unlink(missing_ok=True)  # of a run that was interrupted by Ctrl-C
            return cls(path, settings, resumed=True)
        return cls.create(out, bag, settings)

    @property
    def working_settings(self) -> Settings:
        """The settings, with a store of places in the folder where they name none."""
        database = self._settings.database
        if database.path:
            return self._settings
        update = {"database": database.model_copy(update={"path": str(self.path / PLACES)})}
        return self._settings.model_copy(update=update)

    def finish(self) -> None:
        """The run has come to its end: it needs no places any more.

        Raises:
            OutputError: the folder cannot be written.
        """
        for path in self.path.glob(f"{PLACES}*"):
            path.unlink(missing_ok=True)
        about = _resumption_read(self.path / _RUN) | {"finished": True}
        write_atomically(self.path / _RUN, json.dumps(about) + "\n")


def _resumption_read(path: Path) -> dict[str, object]:
    with suppress(OSError, ValueError):
        about = json.loads(path.read_text(encoding="utf-8"))
        return about if isinstance(about, dict) else {}
    return {}


COUNTS = ("frames", "pairs", "keyframes", "queries", "closures_published", "closures_rejected")
STAGES = tables.STAGES


class RunRecorder:
    """Fills a run folder: `config.yaml` at once, tables row by row, `summary.json` on `write_summary`.

    What an earlier process left in the folder is never cut short: tables are appended to, counts go on. A keyframe
    that is there already, as when a recording is played again, is not written twice.

    Args:
        folder: an existing, writable folder.
        settings: the effective settings.
        weights: name of the network's weights, for the summary.
        resume: what was not finished of a recording is done again: rows of a keyframe that is not there whole go.

    Attributes:
        recorded: stamps and sessions of the keyframes in the folder.

    Raises:
        OutputError: the folder cannot be written.
    """

    def __init__(self, folder: Path, settings: Settings, weights: str, resume: bool = False) -> None:
        self.folder = folder
        self._settings = settings
        self._weights = weights
        write_atomically(folder / "config.yaml", dump_settings(settings))
        self._keyframes = tables.CsvTable(folder / "keyframes.csv", tables.KEYFRAMES)
        self._latencies = tables.CsvTable(folder / "latencies.csv", tables.LATENCIES)
        self._descriptors = DescriptorFile(folder)
        self.recorded = {(int(row["stamp_ns"]), int(row["session"])) for row in self._keyframes.rows}
        whole = {row["stamp_ns"] for row in self._keyframes.rows}

        def table(name: str, columns: list[str]) -> tables.CsvTable:
            keep = (lambda row: row["query_stamp_ns"] in whole) if resume else None
            return tables.CsvTable(folder / f"{name}.csv", columns, keep)

        self._closures = table("closures", tables.CLOSURES)
        self._candidates = table("candidates", tables.CANDIDATES)
        self._inliers = table("inliers", tables.INLIERS)
        self._between: tables.CsvTable | None = None
        self._pairs = {(int(row["query_stamp_ns"]), int(row["match_stamp_ns"])) for row in self._closures.rows}
        self._latency = {stage: array("f") for stage in STAGES}
        self._counts = self._earlier_counts(resume)
        self._started = time.monotonic()
        self._recorded_ns = 0
        self._last_stamp_ns: int | None = None

    def record(self, frame: Frame, detection: Detection) -> None:
        """Write down what became of one frame."""
        self.count(frame)
        if self._last_stamp_ns is not None:
            self._recorded_ns += max(0, frame.stamp_ns - self._last_stamp_ns)
        self._last_stamp_ns = frame.stamp_ns
        keyframe = detection.keyframe
        if keyframe is None or (keyframe.stamp_ns, keyframe.session) in self.recorded:
            return
        self._counts["keyframes"] += 1
        self._counts["queries"] += bool(detection.verdicts)
        times = [f"{detection.latency_ms.get(stage, nan):.1f}" for stage in STAGES]
        self._latencies.append([[keyframe.stamp_ns, *times]])
        self._descriptors.append(keyframe.stamp_ns, keyframe.embedding.descriptor)
        self._candidates.append([tables.candidate_row(keyframe.stamp_ns, verdict) for verdict in detection.verdicts])
        for verdict in detection.verdicts:
            if verdict.closure is None:
                self._counts["closures_rejected"] += 1
                continue
            pair = keyframe.stamp_ns, verdict.candidate.stamp_ns
            if pair in self._pairs:
                continue
            self._pairs.add(pair)
            self._counts["closures_published"] += 1
            self._closures.append([tables.closure_row(verdict.closure, verdict.candidate.similarity)])
            self._inliers.append(tables.inlier_rows(keyframe.stamp_ns, verdict))
        # last: a keyframe that is there is there with all that was found for it
        self._keyframes.append([[keyframe.stamp_ns, keyframe.session, f"{keyframe.path_length_m:.4f}"]])
        self.recorded.add((keyframe.stamp_ns, keyframe.session))
        for stage, milliseconds in detection.latency_ms.items():
            self._latency[stage].append(milliseconds)

    def record_encounter(self, inter_closure: InterRobotClosure) -> None:
        """Write down the closures with another rover of a fleet."""
        if not inter_closure.closures:
            return
        if self._between is None:
            self._between = tables.CsvTable(self.folder / "closures_between.csv", tables.CLOSURES_BETWEEN)
        rows = [[inter_closure.robot, *tables.closure_row(closure, float("nan"))] for closure in inter_closure.closures]
        self._between.append(rows)

    def count(self, frame: Frame) -> None:
        """Count a frame, also one that was dealt with before."""
        self._counts["frames"] += 1
        self._counts["pairs"] += frame.left is not None and frame.points is not None

    def earlier_closures(self) -> list[LoopClosure]:
        """The closures that were in the folder before."""
        return [tables.parse_closure(row) for row in self._closures.rows]

    def summary(self, drops: Mapping[str, int]) -> dict[str, Any]:
        """What `summary.json` holds; `ground_truth` is filled in by the report."""
        elapsed_s = time.monotonic() - self._started
        return {
            **self._counts,
            "ground_truth": None,
            "latency_ms": {stage: _percentiles(values) for stage, values in self._latency.items()},
            "drops": dict(drops),
            "realtime_factor": round(self._recorded_ns * 1e-9 / max(elapsed_s, 1e-9), 3),
            "peak_rss_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
            "seed": self._settings.verification.seed,
            "version": __version__,
            "weights": self._weights,
        }

    def write_summary(self, drops: Mapping[str, int]) -> None:
        """Write `summary.json`; may be called again as the run goes on."""
        write_summary(self.folder, self.summary(drops))

    def close(self) -> None:
        """Close the tables."""
        for table in (self._closures, self._candidates, self._keyframes, self._latencies, self._inliers):
            table.close()
        if self._between is not None:
            self._between.close()
        self._descriptors.close()

    def _earlier_counts(self, resume: bool) -> dict[str, int]:
        """Counts of what the folder holds; of a recording that is resumed, all frames come by again."""
        counts = dict.fromkeys(COUNTS, 0)
        if not resume and (self.folder / "summary.json").exists():
            with suppress(UmfError):
                earlier = read_summary(self.folder)
                counts |= {name: int(earlier[name]) for name in ("frames", "pairs") if name in earlier}
        counts["keyframes"] = len(self.recorded)
        counts["queries"] = len({row["query_stamp_ns"] for row in self._candidates.rows})
        counts["closures_published"] = len(self._closures.rows)
        counts["closures_rejected"] = len(self._candidates.rows) - len(self._closures.rows)
        return counts


def count_drops(counters: Mapping[Input, InputCounter], worker: int = 0) -> dict[str, int]:
    """The `drops` entry of the summary: messages lost for a reason that should not happen, by input."""
    lost = {name: counters[name].lost for name in ("cloud", "odometry")}
    return {"image": counters["left"].lost + counters["right"].lost, **lost, "worker": worker}


def write_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Write `summary.json` in one step."""
    write_atomically(folder / "summary.json", json.dumps(summary, indent=2) + "\n")


def read_summary(folder: Path) -> dict[str, Any]:
    """Read the folder's `summary.json`.

    Raises:
        UmfError: it is missing, or not what a run writes.
    """
    path = folder / "summary.json"
    if not path.is_file():
        raise UmfError(f"{folder} holds no finished run: summary.json is missing")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        content = None
    if not isinstance(content, dict) or "closures_published" not in content:
        raise UmfError(f"{path} is not the summary of a run")
    return content


def _percentiles(values: array[float]) -> dict[str, float | None]:
    if not values:
        return {"p50": None, "p95": None, "max": None}
    copied = values[:]  # numpy would lock the array itself, and another thread appends to it
    p50, p95 = np.percentile(copied, [50, 95])
    return {"p50": round(float(p50), 3), "p95": round(float(p95), 3), "max": round(max(copied), 3)}
