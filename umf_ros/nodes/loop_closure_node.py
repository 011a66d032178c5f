"""The live front-end: sensor topics in, loop closures out."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool
from visualization_msgs.msg import MarkerArray

from umf_ros.core import watchdog
from umf_ros.core.config import FrameIds, Settings, topics_of
from umf_ros.core.errors import ConfigError, OutputError, UmfError, one_line
from umf_ros.core.frames import Frame, Keyframe, LoopClosure, State
from umf_ros.core.geometry import Array, rotation_angle
from umf_ros.core.io import memory_mb
from umf_ros.detector import WITHHELD, Detection, LoopDetector, make_detector_embedder
from umf_ros.map_poses import InitialPose, MapPoses, PoseHint
from umf_ros.nodes import conversions as messages
from umf_ros.nodes.base_node import BaseNode
from umf_ros.nodes.conversions import CLOSURES_QOS, LATCHED_QOS, MAX_LINES, SCAN_FIELDS
from umf_ros.nodes.diagnostics import ERROR, OK, TOO_SLOW, WARN, status
from umf_ros.nodes.process import Worker, leave, run
from umf_ros.nodes.scan_odometry import LOST, SCANS, start_engine
from umf_ros.runs.run_file import as_stored
from umf_ros.runs.writer import RunRecorder, count_drops, with_places
from umf_ros.sensors.calibration import calibration_of
from umf_ros.sensors.router import MessageRouter, wanted_inputs
from umf_ros.sensors.scan_odometry import MAX_LOST
from umf_ros.sensors.synchronizer import Synchronizer
from umf_ros.verification import Hypothesis

if TYPE_CHECKING:
    from umf_ros.fleet.inter_robot_closures import InterRobotClosure

# messages between the executor and the intake: about five seconds of stereo at 30 Hz
INTAKE_QUEUE = 400
DECODE_S = 0.5
"""Longest time at the end for waiting messages, and as long again for the one in hand."""
RESUME = "played again into a node with the same results_dir and database.path, they continue the run"
SCAN_DEPTH = 50
UNPLACED = {"transforms", "camera_info", "size"}
"""Reasons why a message is dropped where the calibration is missing or another one."""
MESSAGE_TYPES = {"cloud": PointCloud2, "odometry": Odometry}
MESSAGE_TYPES |= dict.fromkeys(("left_image", "right_image"), Image)
MESSAGE_TYPES |= dict.fromkeys(("left_info", "right_info"), CameraInfo)


class LoopClosureNode(BaseNode):
    """Front-end node: detects loop closures from sensor topics in a thread of its own and publishes them.

    Executor callbacks only enqueue. One thread decodes and synchronises, another embeds and verifies;
    when the latter is too slow, the oldest frames are dropped and counted.
    """

    def __init__(self) -> None:
        super().__init__("loop_closure_node", "folder for closures and summary; empty: none")

    def _open(self) -> None:
        settings, warn = self._settings, self.get_logger().warning
        if settings.grows_map:
            if not self._results:
                raise ConfigError("localization.update needs results_dir, where the rover's places are kept")
            settings = with_places(settings, Path(self._results))
        embedder = make_detector_embedder(settings)
        calibration, topics = calibration_of(settings), topics_of(settings)
        self._detector = LoopDetector(settings, embedder)
        self._opening.callback(self._detector.close)
        self._synchronizer = Synchronizer(settings.sync, calibration, wanted_inputs(topics), warn)
        self._body_frames = self._subscribe_transforms(calibration if settings.uses_transforms else None)
        self._router = MessageRouter(self._synchronizer, topics, warn, frames=self._body_frames)
        self._recorder = RunRecorder(Path(self._results), settings, embedder.name) if self._results else None
        if self._recorder is not None:
            self._opening.callback(self._recorder.close)
        self._publisher = ClosurePublisher(self, settings.frames)
        self._publisher.publish_closures([] if self._recorder is None else self._recorder.earlier_closures)
        self._lock = threading.Lock()
        self._paused = self._ends_session = False
        self._wanted: Settings | None = None
        self._hint: Callable[[Keyframe], dict[int, Array]] | None = None
        self._follow_initial_pose(self._expect)
        self._closures = self._between = 0
        self._last: Detection | None = None
        self._worker: Worker[Frame] = Worker(self._detect, self._report_fault, settings.worker.queue_size)
        self._writer: Worker[None] = Worker(lambda _: self._write_summary(), self._report_fault, 1)
        self._decoder: Worker[tuple[str, Any]] = Worker(self._take, self._report_fault, INTAKE_QUEUE)
        self._engine: Worker[Any] | None = None
        self._engine_counts = Counter[str]()
        if settings.odometry.engine:
            rig = calibration, self._body_frames
            self._engine, self._engine_counts = start_engine(self, settings, *rig, self._report_fault)
        for name, topic in topics.model_dump().items():
            if topic:
                take = partial(self._enqueue, topic)
                qos = messages.sensor_qos(settings.qos)
                self._subscribe(name, MESSAGE_TYPES[name], self._own_topic(name, topics), take, qos)
        self._saver: Worker[Callable[[], None]] = Worker(lambda step: step(), self._report_fault, 1)
        self._offer(self._saver, "~/save", lambda _: self._grow() if settings.grows_map else self._save())
        self._offer(None, "~/reset", self._reset)
        self._offer(None, "~/pause", self._pause, SetBool)

    def _finish(self) -> None:
        """Finish the frames that wait, as far as there is time, and write the results."""
        self._saver.close(timeout_s=watchdog.PATIENT_S)
        last, dropped = self._last, self._worker.dropped + self._decoder.dropped
        if self._engine is not None:
            self._engine.close(timeout_s=DECODE_S)
        self._decoder.close(timeout_s=DECODE_S)
        for frame in self._synchronizer.flush():
            self._worker.submit(frame)
        self._worker.close(timeout_s=self._settings.worker.finish_s)
        if left := self._worker.dropped + self._decoder.dropped - dropped:
            since = f"after stamp {last.frame_stamp_ns * 1e-9:.3f} s" if last else "from the first one on"
            self.get_logger().warning(f"{left} waiting messages and frames were not processed: {since}; {RESUME}")
        self._writer.close()
        self._publisher.wait_for_subscribers()
        try:
            self._write_summary()
            if self._recorder is not None:
                self._recorder.close()
        finally:
            self._detector.close()
        if self._settings.grows_map:
            self.get_logger().info(self._grow())

    def _grow(self) -> str:
        """Add what was seen to the map, in a process of its own.

        In this one, GTSAM would hold the interpreter lock while it solves a large map. The process has its own session:
        it finishes the map also where Ctrl-C or `ros2 launch` ends the node meanwhile.
        """
        command = [sys.executable, "-m", "umf_ros.cli", "map", "grow", self._settings.map, self._results]
        done = subprocess.run(command, capture_output=True, text=True, check=False, start_new_session=True)
        if done.returncode:
            raise OutputError(f"{self._settings.map} stays as it was: {one_line(UmfError(done.stderr))}")
        return " ".join(done.stdout.split())

    def _retune(self, settings: Settings) -> None:
        self._wanted = settings  # the executor must not wait for the current keyframe

    def _enqueue(self, topic: str, message: Any) -> None:
        if self._engine is not None and topic == topics_of(self._settings).cloud:
            self._engine.submit(message)
        if not self._paused:
            self._decoder.submit((topic, message))

    def _expect(self, known: MapPoses, initial: InitialPose) -> None:
        """Verify an initial pose with the next keyframes."""
        self.get_logger().info(f"initial pose {initial}: verified like a closure, and searched if it is wrong")
        self._hint = PoseHint(known.places, initial).near

    def _take(self, item: tuple[str, Any]) -> None:
        self._router.take(*item)
        for frame in self._synchronizer.pop():
            self._worker.submit(frame)

    def _detect(self, frame: Frame) -> None:
        with self._lock:
            wanted, self._wanted = self._wanted, None
            if wanted is not None:
                self._detector.retune(wanted)
            if self._hint is not None:
                self._detector.hint, self._hint = self._hint, None
            if self._ends_session:
                self._ends_session = False
                self._detector.end_session()
            detection = self._detector.process(frame, lambda found: self._publisher.publish_closures(found.closures))
            # before the database drops them
            matches = {v.candidate.stamp_ns: self._detector.database[v.candidate.index] for v in detection.verdicts}
        self._last = detection
        self._publisher.odom = self._body_frames.odom
        self._publisher.announce(detection, matches)
        for closure in detection.closures:
            self._closures += 1
            self.get_logger().info(describe(self._closures, closure))
        if detection.fault is not None:
            self._report_fault(detection.fault)
        if self._recorder is not None:
            self._recorder.record(frame, detection)
        with self._lock:
            inter_closure = self._detector.next_inter_robot_closure()
        if inter_closure is not None:
            self._publisher.publish_inter_robot(inter_closure)
            self._between += len(inter_closure.closures)
            if self._recorder is not None:
                self._recorder.record_inter_robot(inter_closure)

    def _drops(self) -> dict[str, int]:
        return count_drops(self._synchronizer.counters, self._worker.dropped + self._decoder.dropped)

    def _tick(self) -> None:
        self._diagnose(self._own_status())
        self._writer.submit(None)  # a slow disk must not block the executor

    def _write_summary(self) -> None:
        if self._recorder is not None:
            self._recorder.write_summary(self._drops())

    def _own_status(self) -> DiagnosticStatus:
        latency = self._last.latency_ms.get("total", 0.0) if self._last else 0.0
        newest_ns = max((watch.last_stamp_ns or 0 for watch in self._watches), default=0)
        lag_s = (newest_ns - self._last.frame_stamp_ns) * 1e-9 if self._last else 0.0
        values = {
            "places": len(self._detector.database),
            "closures": self._closures,
            "last_latency_ms": latency,
            "lag_s": lag_s,
            "memory_mb": memory_mb(),
            "last_error": self._last_fault or "none",
            **{f"fault_{kind}": count for kind, count in self._faults.items()},
            **{f"dropped_{name}": count for name, count in self._drops().items()},
            **_counts(self._synchronizer),
            **self._engine_counts,
            **self._fleet(),
        }
        text = "paused" if self._paused else f"{self._closures} closures among {len(self._detector.database)} places"
        level = ERROR if self._detector.sensors.contradictions else WARN if self._paused else OK
        return status(level, "detector", text, values)

    def _failures(self) -> dict[str, str]:
        if self._paused:
            return {}
        known, counts = self._detector.sensors.contradictions, self._engine_counts
        is_lost = counts[LOST] > max(1, MAX_LOST * counts[SCANS])
        inputs = self._synchronizer.counters.items()
        unplaced = [name for name, one in inputs if not one.used and any(kind in one.dropped for kind in UNPLACED)]
        return super()._failures() | {
            "contradicting_sensors": f"{WITHHELD}: {known[0].what}" if known else "",
            "lost_odometry": f"the engine lost track of {counts[LOST]} of {counts[SCANS]} scans" if is_lost else "",
            "overload": TOO_SLOW if self._worker.dropped or self._decoder.dropped else "",
            "no_calibration": f"no message of {' and '.join(unplaced)} fits the calibration" if unplaced else "",
        }

    def _fleet(self) -> dict[str, Any]:
        """Return the state of the link to the fleet's server, if there is one."""
        if self._detector.inter_robot is None:
            return {}
        link, waiting = self._detector.inter_robot.link, self._detector.database.store.waiting()
        known = {"fleet_connected": link.connected, "fleet_waiting": waiting, "fleet_pushed": link.pushed}
        return {**known, "fleet_closures": self._between, "fleet_trouble": link.trouble or "none"}

    def _save(self) -> str:
        path = Path(self._settings.database.path or "places.sqlite").with_suffix(".saved.sqlite").resolve()
        self._detector.database.store.save(path)
        return f"{len(self._detector.database)} places saved to {path}"

    def _reset(self, _: Any) -> str:
        self._ends_session = True  # the executor must not wait for the current keyframe
        return "a new session begins with the next frame; all places are kept (umf places deletes them)"

    def _pause(self, request: Any) -> str:
        self._paused = request.data
        return "paused" if request.data else "running"


class ClosurePublisher:
    """Publisher of loop closures, keyframes and their scans, tested candidates and markers.

    `loop_closures` carries verified closures only, `~/candidates` all tested candidates.

    Attributes:
        odom: name of the odometry's frame.
    """

    def __init__(self, node: Node, frames: FrameIds) -> None:
        self._node = node
        self.odom, self._base = frames.odom, frames.base
        self._closures = node.create_publisher(Odometry, "loop_closures", CLOSURES_QOS)
        self._keyframes = node.create_publisher(PoseStamped, "~/keyframes", CLOSURES_QOS)
        self._scans = node.create_publisher(PointCloud2, "~/keyframe_scans", QoSProfile(depth=SCAN_DEPTH))
        self._candidates = node.create_publisher(DiagnosticArray, "~/candidates", 10)
        self._markers = node.create_publisher(MarkerArray, "~/markers", LATCHED_QOS)
        self._accepted: deque[Array] = deque(maxlen=MAX_LINES)
        self._rejected: deque[Array] = deque(maxlen=MAX_LINES)

    def publish_closures(self, closures: list[LoopClosure]) -> None:
        """Publish closures as they are stored, so that a repeated one is equal."""
        for closure in closures:
            self._closures.publish(messages.closure_to_message(as_stored(closure)))

    def announce(self, detection: Detection, matches: dict[int, Keyframe]) -> None:
        """Publish the rest of one detection; `matches` are the matched keyframes by stamp, for the markers."""
        keyframe = detection.keyframe
        if keyframe is None:
            return
        # without odometry a keyframe is at the origin of its own frame
        frame = messages.keyframe_frame(keyframe.stamp_ns) if keyframe.odom_T_body is None else self.odom
        header = messages.to_header(keyframe.stamp_ns, frame)
        pose = messages.to_pose(np.eye(4) if keyframe.odom_T_body is None else keyframe.odom_T_body)
        self._keyframes.publish(PoseStamped(header=header, pose=pose))
        if len(keyframe.points) and self._scans.get_subscription_count():
            viewpoints = np.broadcast_to(keyframe.body_T_lidar[:3, 3], keyframe.points.shape)
            header = messages.to_header(keyframe.stamp_ns, self._base)
            self._scans.publish(messages.to_cloud(np.hstack([keyframe.points, viewpoints]), SCAN_FIELDS, header))
        if detection.verdicts:
            self._report(keyframe, detection.verdicts)
            self._draw(keyframe, detection.verdicts, matches)

    def publish_inter_robot(self, inter_closure: InterRobotClosure) -> None:
        """Publish closures with another rover's places, with the names of both rovers."""
        for closure in inter_closure.closures:
            self._closures.publish(messages.closure_to_message(closure, inter_closure.own, inter_closure.robot))
        self._report(inter_closure.keyframe, inter_closure.verdicts, inter_closure.robot)

    def wait_for_subscribers(self) -> None:
        """Wait for subscribers to acknowledge the last closures, a second at most."""
        self._closures.wait_for_all_acked(Duration(seconds=1))

    def _report(self, keyframe: Keyframe, verdicts: list[Hypothesis], robot: str = "") -> None:
        """Publish the tested candidates of a keyframe."""
        report = DiagnosticArray(header=Header(stamp=messages.to_time(keyframe.stamp_ns)))
        for verdict in verdicts:
            name = f"{messages.keyframe_frame(verdict.candidate.stamp_ns, robot)} -> {keyframe.stamp_ns}"
            level = WARN if verdict.closure is None else OK
            numbers = {"similarity": verdict.candidate.similarity, **verdict.numbers}
            report.status.append(status(level, name, verdict.outcome, numbers))
        self._candidates.publish(report)

    def _draw(self, keyframe: Keyframe, verdicts: list[Hypothesis], matches: dict[int, Keyframe]) -> None:
        if keyframe.odom_T_body is None:
            return
        for verdict in verdicts:
            match = matches.get(verdict.candidate.stamp_ns)
            if match is None or match.odom_T_body is None or match.session != keyframe.session:
                continue
            lines = self._rejected if verdict.closure is None else self._accepted
            lines.append(np.stack([match.odom_T_body[:3, 3], keyframe.odom_T_body[:3, 3]]))
        header = messages.to_header(keyframe.stamp_ns, self.odom)
        drawn = {State.ACCEPTED: self._accepted, State.REJECTED: self._rejected}
        self._markers.publish(messages.to_markers(drawn, header))


def describe(number: int, closure: LoopClosure) -> str:
    """Return one line about a closure for the log."""
    shift_m = float(np.linalg.norm(closure.match_T_query[:3, 3]))
    turn_deg = float(np.degrees(rotation_angle(closure.match_T_query)))
    seconds = (closure.query_stamp_ns - closure.match_stamp_ns) * 1e-9
    apart = f"{shift_m:.2f} m and {turn_deg:.1f} deg apart"
    return f"closure {number}: back after {seconds:.1f} s, {apart}, p = {closure.probability:.3f}"


def _counts(synchronizer: Synchronizer) -> dict[str, int]:
    """Return counts of every input's messages, such as `left_used` or `cloud_dropped_no_image`."""
    counts: dict[str, int] = {}
    for name, counter in synchronizer.counters.items():
        counts |= {f"{name}_received": counter.received, f"{name}_used": counter.used}
        dropped = dict(counter.dropped)  # another thread adds reasons meanwhile
        counts |= {f"{name}_dropped_{reason.replace(' ', '_')}": count for reason, count in dropped.items()}
    return counts


def main() -> None:
    """Run `ros2 run umf_ros loop_closure_node`."""
    leave(run(LoopClosureNode))


if __name__ == "__main__":
    main()
