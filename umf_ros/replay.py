"""Offline loop detection on a recording, by the same detector as the live node."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from umf_ros.config import Settings
from umf_ros.frames import Frame
from umf_ros.loop_detector import Detection, LoopDetector
from umf_ros.pose_graph.pose_graph import PoseGraph
from umf_ros.runs.recorder import RunRecorder
from umf_ros.sensors.messages import OdometrySample
from umf_ros.sensors.odometry_feed import OdometryFeed


class Replay:
    """Feeds frames to the detector, odometry and closures to the pose graph, and fills a run folder.

    The graph gets what the live back-end gets: every message of the odometry, and one closure after the other.

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
        self._feed = OdometryFeed(self._graph)
        self._has_odometry = False

    def run(self, stream: Iterable[Frame | OdometrySample]) -> Iterator[Detection]:
        """Process a recording's stream, yielding what became of each frame; stop iterating to stop the run.

        Raises:
            OutputError: the disk is full.
        """
        for item in stream:
            if isinstance(item, OdometrySample):
                self._has_odometry = True
                self._feed.take(item.stamp_ns, item.odom_T_body)
                continue
            detection = self._detector.process(item)
            self._recorder.record(item, detection)
            for closure in detection.closures:
                self._graph.add_closure(closure)
            yield detection
            if detection.fault is not None:
                raise detection.fault

    def graph_counts(self) -> dict[str, int]:
        """How many closures the graph has in which state so far; none without odometry."""
        counts = self._graph.verdict_counts() if self._has_odometry else {}
        return {state.value: count for state, count in counts.items()}

    def finish(self, drops: Mapping[str, int]) -> bool:
        """Write the summary, and trajectories and graph where there was odometry; returns whether there was."""
        self._recorder.write_summary(drops)
        self._recorder.close()
        self._detector.database.close()
        if self._has_odometry:
            self._graph.write_results(self._folder)
        return self._has_odometry
