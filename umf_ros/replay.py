"""Offline loop detection on a recording, by the same detector as the live node."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from umf_ros.config import Settings
from umf_ros.frames import Frame
from umf_ros.loop_detector import Detection, LoopDetector
from umf_ros.pose_graph.export import write_results
from umf_ros.pose_graph.pose_graph import PoseGraph
from umf_ros.pose_graph.restarts import RestartGuard
from umf_ros.runs.recorder import RunRecorder


class Replay:
    """Feeds frames to the detector and the pose graph and fills a run folder.

    Args:
        folder: run folder.
        settings: all settings.
        detector: made with these settings.
    """

    def __init__(self, folder: Path, settings: Settings, detector: LoopDetector) -> None:
        self._folder = folder
        self._detector = detector
        self._graph = PoseGraph(settings.pose_graph)
        self._recorder = RunRecorder(folder, settings, detector.embedder_name)
        self._guard = RestartGuard()
        self._session = 0
        self._has_odometry = False

    def run(self, frames: Iterable[Frame]) -> Iterator[Detection]:
        """Process frame by frame, yielding what became of each; stop iterating to stop the run.

        Raises:
            OutputError: the disk is full.
        """
        for frame in frames:
            detection = self._detector.process(frame)
            self._recorder.record(frame, detection)
            self._extend_graph(frame, detection)
            yield detection
            if detection.fault is not None:
                raise detection.fault

    def finish(self, drops: Mapping[str, int]) -> bool:
        """Write the summary, and trajectories and graph where there was odometry; returns whether there was."""
        self._recorder.write_summary(drops)
        self._recorder.close()
        self._detector.database.close()
        if self._has_odometry:
            write_results(self._graph, self._folder)
        return self._has_odometry

    def _extend_graph(self, frame: Frame, detection: Detection) -> None:
        if frame.odom_T_body is None:
            return
        self._has_odometry = True
        if frame.session != self._session:
            self._session, self._guard = frame.session, RestartGuard()
            self._graph.begin_session()
        starts_anew, samples = self._guard.take(frame.stamp_ns, frame.odom_T_body)
        if starts_anew:
            self._graph.begin_session()
        for stamp_ns, odom_T_body in samples:
            self._graph.add_odometry(stamp_ns, odom_T_body)
        if detection.closures:
            self._graph.add_closures(detection.closures)
