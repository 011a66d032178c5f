"""Offline loop detection on a recording, by the same detector as the live node."""

from __future__ import annotations

import traceback
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from umf_ros.core.config import Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Frame, LoopClosure
from umf_ros.detector import Detection, LoopDetector
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.runs.writer import RunRecorder
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sessions import OdometrySessionSplitter

FAULTS = "faults.log"
WARM_UP = 12
"""So many of the last keyframes before an interruption are looked at again: twice what verification remembers."""
FLEET_PATIENCE_S = 30.0
"""So long a replay waits at its end until a fleet's server has its places; what it then has not is pushed next time."""


class Replay:
    """Feeds frames to the detector, odometry and closures to the pose graph, and fills a run folder.

    The graph gets what the live back-end gets: every message of the odometry, and one closure after the other.

    Args:
        folder: run folder.
        settings: all settings.
        detector: made with these settings, or over the store of the run that is resumed.
        resume: go on where an earlier replay of the same recording into this folder was cut off.

    Attributes:
        faults: frames that were passed over for a fault of the program; `faults.log` in the folder says which.
    """

    def __init__(self, folder: Path, settings: Settings, detector: LoopDetector, resume: bool = False) -> None:
        self._folder = folder
        self._detector = detector
        self._graph = PoseGraph(settings.pose_graph)
        self._recorder = RunRecorder(folder, settings, detector.embedder_name, resume)
        self._feed = OdometrySessionSplitter(self._graph)
        self.faults = 0
        self._has_odometry = False
        self._done = len(self._recorder.recorded) if resume else 0
        self._earlier: dict[int, list[LoopClosure]] = defaultdict(list)
        for closure in self._recorder.earlier_closures() if resume else ():
            self._earlier[closure.query_stamp_ns].append(closure)

    def run(self, stream: Iterable[Frame | OdometrySample]) -> Iterator[Detection]:
        """Process a recording's stream, yielding what became of each frame; stop iterating to stop the run.

        Raises:
            OutputError: the disk is full.
        """
        for item in self._detector.prefetch(stream, lambda: self._done <= WARM_UP):
            if isinstance(item, OdometrySample):
                self._has_odometry = True
                self._feed.take(item.stamp_ns, item.odom_T_body)
                continue
            if self._done > WARM_UP:
                yield self._pass_over(item)
                continue
            detection = self._process(item)
            if detection.keyframe is not None and self._done:
                self._done -= 1
            self._recorder.record(item, detection)
            for closure in detection.closures:
                self._graph.add_closure(closure)
            while (inter_closure := self._detector.meet()) is not None:
                self._recorder.record_encounter(inter_closure)
            yield detection
            if detection.fault is not None:
                raise detection.fault

    def _process(self, frame: Frame) -> Detection:
        """What became of a frame: hours of a recording are not given up for one that we cannot deal with."""
        try:
            return self._detector.process(frame)
        except UmfError:
            raise
        except Exception:
            self.faults += 1
            with (self._folder / FAULTS).open("a", encoding="utf-8") as file:
                file.write(f"frame {frame.stamp_ns}\n{traceback.format_exc()}\n")
            return Detection(frame.stamp_ns)

    def raise_if_frames_failed(self) -> None:
        """Say at the end, when everything else is written, that frames were passed over.

        Raises:
            UmfError: some were.
        """
        if self.faults:
            log = self._folder / FAULTS
            raise UmfError(f"{self.faults} frames were passed over for a fault of ours: please report {log}")

    def graph_counts(self) -> dict[str, int]:
        """How many closures the graph has in which state so far; none without odometry."""
        counts = self._graph.verdict_counts() if self._has_odometry else {}
        return {state.value: count for state, count in counts.items()}

    def _pass_over(self, frame: Frame) -> Detection:
        """Take note of a frame that was dealt with before, and of its closures."""
        self._recorder.count(frame)
        if self._detector.resume(frame):
            self._done -= 1
            for closure in self._earlier.get(frame.stamp_ns, ()):
                self._graph.add_closure(closure)
        return Detection(frame.stamp_ns)

    def finish(self, drops: Mapping[str, int]) -> bool:
        """Write the summary, and trajectories and graph where there was odometry; returns whether there was."""
        if self._detector.inter_robot is not None:
            for inter_closure in self._detector.inter_robot.rest(FLEET_PATIENCE_S):
                self._recorder.record_encounter(inter_closure)
        self._recorder.write_summary(drops)
        self._recorder.close()
        self._detector.close()
        if self._has_odometry:
            self._graph.write_results(self._folder)
        return self._has_odometry
