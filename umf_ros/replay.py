"""Replay of a recording through the same stages as on the rover, mapping or localising in a map."""

from __future__ import annotations

import traceback
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from umf_ros.absolute.measurement import AbsoluteMeasurement
from umf_ros.core.config import Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Frame, LoopClosure
from umf_ros.detector import Detection, LoopDetector
from umf_ros.localizer import Localization, Localizer, open_localizer
from umf_ros.map_poses import hint_of
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import ClosureReason
from umf_ros.runs.writer import RunRecorder, write_summary
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sessions import OdometrySessionSplitter

FAULTS = "faults.log"
WARM_UP = 12
"""Keyframes before an interruption that are processed again: twice the history of the verification."""
FLEET_PATIENCE_S = 30.0
"""Time that a replay waits at its end for a fleet's server; the next run sends the remaining places."""


class Replay:
    """Replay: feeds frames to the detector, odometry and closures to the pose graph, and writes a run folder.

    The graph gets the inputs of the live back-end: every odometry message and every closure. It decides about each
    closure once, in the order of stamps. With settings of mode localization, a `Localizer` takes the place of the
    graph, as live.

    Args:
        folder: run folder.
        settings: all settings.
        detector: made with these settings, or with the database of the run that is resumed.
        resume: continue an earlier replay of the same recording into this folder.

    Attributes:
        faults: frames that were skipped after internal errors; `faults.log` in the folder has the tracebacks.
        counts: of a localising run, as in its summary: `keyframes`, those up to the first known pose (None while there
            is none), those with a known pose, how often a pose was found or another one than before, and closures that
            agreed with the pose or did not.

    Raises:
        UmfError: the map has not been solved, or is damaged.
    """

    def __init__(self, folder: Path, settings: Settings, detector: LoopDetector, resume: bool = False) -> None:
        self._folder = folder
        self._detector = detector
        self._localizer = open_localizer(settings) if settings.localizing else None
        if settings.localizing:
            detector.hint = hint_of(settings)
        self._graph = self._localizer or PoseGraph(settings.pose_graph)
        self._recorder = RunRecorder(folder, settings, detector.embedder_name, resume)
        self._feed = OdometrySessionSplitter(self._graph)
        self.faults = 0
        self.counts: dict[str, Any] = {"keyframes": 0, "keyframes_until_found": None, "located": 0}
        self.counts |= {"relocalised": 0, "agreed": 0, "contradicted": 0}
        self._newest_ns = -1
        self._has_odometry = False
        self._done = len(self._recorder.recorded) if resume else 0
        self._earlier: dict[int, list[LoopClosure]] = defaultdict(list)
        for closure in self._recorder.earlier_closures if resume else ():
            self._earlier[closure.query_stamp_ns].append(closure)

    def run(self, stream: Iterable[Frame | OdometrySample | AbsoluteMeasurement]) -> Iterator[Detection]:
        """Process a recording's stream and yield the result of each frame; stop iterating to stop the run.

        Raises:
            OutputError: the disk is full.
        """
        items: Iterator[Frame | OdometrySample | AbsoluteMeasurement]
        items = self._detector.prefetch(stream, lambda: self._done <= WARM_UP)
        for item in items:
            if isinstance(item, OdometrySample):
                self._has_odometry = True
                self._recorder.append_odometry(item)
                self._feed.take(item.stamp_ns, item.odom_T_body)
                continue
            if isinstance(item, AbsoluteMeasurement):
                self._recorder.append_absolute(item)
                self._graph.add_absolute(item)
                self._graph.update()
                continue
            if self._done > WARM_UP:
                yield self._skip_known(item)
                continue
            detection = self._process(item)
            if detection.keyframe is not None and self._done:
                self._done -= 1
            self._recorder.record(item, detection)
            self._graph.receive(detection.closures)
            if self._localizer is not None and detection.keyframe is not None:
                self._record_pose(self._localizer)
            while (inter_closure := self._detector.next_inter_robot_closure()) is not None:
                self._recorder.record_inter_robot(inter_closure)
            yield detection
            if detection.fault is not None:
                raise detection.fault

    def _process(self, frame: Frame) -> Detection:
        """Return the result of a frame, without a keyframe after an internal error."""
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
        """Report skipped frames, once everything else is written.

        Raises:
            UmfError: frames were skipped after internal errors.
        """
        if self.faults:
            log = self._folder / FAULTS
            raise UmfError(f"{self.faults} frames skipped after internal errors: please report {log}")

    def graph_counts(self) -> dict[str, int]:
        """Decide about the closures so far, and return their number by state; none without odometry."""
        self._graph.prepare(float("inf"))
        verdicts = self._graph.verdict_counts() if self._has_odometry else {}
        return {state.value: count for state, count in verdicts.items()}

    @property
    def newest_pose(self) -> Localization | None:
        """The newest pose in the map; None while it is unknown."""
        return self._localizer.estimate() if self._localizer is not None else None

    def _skip_known(self, frame: Frame) -> Detection:
        """Restore the state after a frame processed before, with its closures."""
        self._recorder.count(frame)
        if self._detector.resume(frame):
            self._done -= 1
            self._graph.receive(self._earlier.get(frame.stamp_ns, []))
        return Detection(frame.stamp_ns)

    def _record_pose(self, localizer: Localizer) -> None:
        """Write the pose of the newest keyframe."""
        counts, found = self.counts, localizer.estimate()
        counts["keyframes"] += 1
        counts["relocalised"] = localizer.relocalised
        counts["agreed"] = localizer.reasons[ClosureReason.AGREES_WITH_POSE]
        counts["contradicted"] = localizer.reasons[ClosureReason.CONTRADICTS_POSE]
        if found is None:
            return
        counts["located"] += 1
        counts["keyframes_until_found"] = counts["keyframes_until_found"] or counts["keyframes"]
        if found.stamp_ns > self._newest_ns:  # else the clock was set back
            self._newest_ns = found.stamp_ns
            self._recorder.record_pose(*found)

    def finish(self, drops: Mapping[str, int]) -> bool:
        """Export the files of the run.

        Returns:
            Whether there is a trajectory, of the graph or in the map.

        Raises:
            OutputError: the folder cannot be written.
        """
        if self._detector.inter_robot is not None:
            for inter_closure in self._detector.inter_robot.finish(FLEET_PATIENCE_S):
                self._recorder.record_inter_robot(inter_closure)
        self._feed.finish()
        has_trajectory = self._has_odometry if self._localizer is None else bool(self.counts["located"])
        if has_trajectory:
            self._graph.write_results(self._folder)
        known = {} if self._localizer is None else {"localization": self.counts}
        write_summary(self._folder, self._recorder.summary(drops) | known)
        self._recorder.close()
        self._detector.close()
        return has_trajectory
