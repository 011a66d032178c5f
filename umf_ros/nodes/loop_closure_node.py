"""The live front-end: sensor topics in, loop closures out. Thin: every decision is the core's."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import SetBool, Trigger

from umf_ros.bags.presets import calibration_of, topics_of
from umf_ros.config import Settings
from umf_ros.errors import OutputError, UmfError
from umf_ros.frames import Frame, LoopClosure
from umf_ros.geometry import rotation_angle
from umf_ros.loop_detector import Detection, LoopDetector, make_detector_embedder
from umf_ros.nodes.announcer import Announcer
from umf_ros.nodes.conversions import from_time
from umf_ros.nodes.diagnostics import OK, WARN, InputWatch, memory_mb, status
from umf_ros.nodes.parameters import declare
from umf_ros.nodes.process import run
from umf_ros.nodes.qos import sensor_qos
from umf_ros.nodes.worker import Worker
from umf_ros.runs.recorder import RunRecorder, count_drops
from umf_ros.sensors.intake import Intake, wanted_inputs
from umf_ros.sensors.synchronizer import Synchronizer

# messages between the executor and the intake: about five seconds of stereo at 30 Hz
INTAKE_QUEUE = 400
MESSAGE_TYPES = {
    "left_image": Image,
    "right_image": Image,
    "left_info": CameraInfo,
    "right_info": CameraInfo,
    "cloud": PointCloud2,
    "odometry": Odometry,
}


class LoopClosureNode(Node):
    """Subscribes to the sensors, detects loop closures in a thread of its own, publishes them.

    Executor callbacks only enqueue. One thread decodes and synchronises, another embeds and verifies;
    when the latter is late the oldest frames are dropped and counted.
    """

    def __init__(self) -> None:
        super().__init__("loop_closure_node", automatically_declare_parameters_from_overrides=True)
        self._settings, own = declare(self, results_dir="folder for closures and summary; empty: none")
        embedder = make_detector_embedder(self._settings)
        self._detector = LoopDetector(self._settings, embedder)
        calibration = calibration_of(self._settings)
        topics = topics_of(self._settings)
        self._synchronizer = Synchronizer(self._settings.sync, calibration, wanted_inputs(topics))
        self._intake = Intake(self._synchronizer, topics, self.get_logger().warning)
        self._recorder = _make_recorder(own["results_dir"], self._settings, embedder.name)
        self._announcer = Announcer(self, self._settings.frames)
        self._lock = threading.Lock()
        self._paused = False
        self._closures = 0
        self._last: Detection | None = None
        self._last_error = ""
        self._worker: Worker[Frame] = Worker(self._detect, self._complain, self._settings.worker.queue_size)
        self._decoder: Worker[tuple[str, Any]] = Worker(self._take, self._complain, INTAKE_QUEUE)
        self._watches = [self._subscribe(name, topic) for name, topic in topics.model_dump().items() if topic]
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_timer(1.0, self._diagnose)
        self.create_service(Trigger, "~/save", self._save)
        self.create_service(Trigger, "~/reset", self._reset)
        self.create_service(SetBool, "~/pause", self._pause)
        self.get_logger().info("ready")

    def close(self) -> None:
        """Finish every frame in hand and write the results."""
        self._decoder.close()
        for frame in self._synchronizer.flush():
            self._worker.submit(frame)
        self._worker.close(timeout_s=30.0)
        try:
            if self._recorder is not None:
                self._recorder.write_summary(self._drops())
                self._recorder.close()
        finally:
            self._detector.database.close()

    def _subscribe(self, name: str, topic: str) -> InputWatch:
        watch = InputWatch(self, name, topic)

        def enqueue(message: Any) -> None:
            watch.saw(from_time(message.header.stamp))
            if not self._paused:
                self._decoder.submit((topic, message))

        def lost(event: Any) -> None:
            watch.lost += event.total_count_change

        events = SubscriptionEventCallbacks(message_lost=lost)
        qos = sensor_qos(self._settings.qos)
        self.create_subscription(MESSAGE_TYPES[name], topic, enqueue, qos, event_callbacks=events)
        return watch

    def _take(self, item: tuple[str, Any]) -> None:
        self._intake.take(*item)
        for frame in self._synchronizer.pop():
            self._worker.submit(frame)

    def _detect(self, frame: Frame) -> None:
        with self._lock:
            detection = self._detector.process(frame)
            # before anybody forgets them
            matches = {v.candidate.stamp_ns: self._detector.database[v.candidate.index] for v in detection.verdicts}
        self._last = detection
        self._announcer.announce(detection, matches)
        for closure in detection.closures:
            self._closures += 1
            self.get_logger().info(describe(self._closures, closure))
        if detection.fault is not None:
            self._complain(detection.fault)
        if self._recorder is not None:
            self._recorder.record(frame, detection)

    def _complain(self, error: Exception) -> None:
        self._last_error = f"{type(error).__name__}: {error}"
        self.get_logger().error(self._last_error, throttle_duration_sec=10.0)

    def _drops(self) -> dict[str, int]:
        return count_drops(self._synchronizer.counters, self._worker.dropped + self._decoder.dropped)

    def _diagnose(self) -> None:
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [self._own_status(), *(watch.status() for watch in self._watches)]
        for line in message.status:
            line.name = f"{self.get_name()}: {line.name}"
        self._diagnostics.publish(message)
        for watch in self._watches:
            if watch.warning:
                self.get_logger().warning(watch.warning, throttle_duration_sec=30.0)
        if self._recorder is not None:
            try:
                self._recorder.write_summary(self._drops())
            except OutputError as error:  # closures matter more than the tally
                self._complain(error)

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
            "last_error": self._last_error or "none",
            **{f"dropped_{name}": count for name, count in self._drops().items()},
            **_counts(self._synchronizer),
        }
        if self._paused:
            return status(WARN, "detector", "paused", values)
        if self._worker.dropped or self._decoder.dropped:
            return status(WARN, "detector", "too slow: messages are being dropped", values)
        return status(OK, "detector", f"{self._closures} closures among {len(self._detector.database)} places", values)

    def _save(self, _: Any, response: Any) -> Any:
        path = Path(self._settings.database.path or "places.sqlite").with_suffix(".saved.sqlite").resolve()
        try:
            self._detector.database.save(path)
            response.success, response.message = True, f"{len(self._detector.database)} places saved to {path}"
        except UmfError as error:
            response.success, response.message = False, str(error)
        return response

    def _reset(self, _: Any, response: Any) -> Any:
        with self._lock:
            self._detector.reset()
        response.success, response.message = True, "all places forgotten"
        return response

    def _pause(self, request: Any, response: Any) -> Any:
        self._paused = request.data
        response.success, response.message = True, "paused" if request.data else "running"
        return response


def describe(number: int, closure: LoopClosure) -> str:
    """One line about a closure for a person."""
    shift_m = float(np.linalg.norm(closure.match_T_query[:3, 3]))
    turn_deg = float(np.degrees(rotation_angle(closure.match_T_query)))
    seconds = (closure.query_stamp_ns - closure.match_stamp_ns) * 1e-9
    apart = f"{shift_m:.2f} m and {turn_deg:.1f} deg apart"
    return f"closure {number}: back after {seconds:.1f} s, {apart}, p = {closure.probability:.3f}"


def _counts(synchronizer: Synchronizer) -> dict[str, int]:
    """Every input's messages by fate, as `left_used` or `cloud_dropped_no_image`."""
    counts: dict[str, int] = {}
    for name, counter in synchronizer.counters.items():
        counts |= {f"{name}_received": counter.received, f"{name}_used": counter.used}
        dropped = dict(counter.dropped)  # the decoder adds reasons meanwhile
        counts |= {f"{name}_dropped_{reason.replace(' ', '_')}": count for reason, count in dropped.items()}
    return counts


def _make_recorder(folder: str, settings: Settings, weights: str) -> RunRecorder | None:
    if not folder:
        return None
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror}") from None
    return RunRecorder(Path(folder), settings, weights)


def main() -> None:
    """Entry point of `ros2 run umf_ros loop_closure_node`."""
    sys.exit(run(LoopClosureNode))


if __name__ == "__main__":
    main()
