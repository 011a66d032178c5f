"""Health of a node and of its inputs; as a program: a test of DDS on this machine."""

from __future__ import annotations

import sys
import time
from array import array
from collections.abc import Mapping

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import Image

from umf_ros.sensors.topic_finder import is_own

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
FAILURES = {
    "cannot_write": "make room for results_dir, or name another folder",
    "no_clock": "start the player or the simulator, or set use_sim_time to false",
    "no_data": "start the drivers, or name their topics: umf doctor --live finds them",
    "no_calibration": "publish /tf_static and camera_info, or name a file: calibration",
    "stale_odometry": "start the odometry, or make it from the scans: odometry.engine",
    "contradicting_sensors": "correct the mounting, clock or driver that the message names",
    "lost_odometry": "name another odometry: the scans show too little of its way",
    "overload": "raise keyframe.min_translation_m, or take load off the processor",
    "weak_overlap": "drive where the map was made, or give a pose on /initialpose",
    "fault": "read the log of the node, which continues",
}
"""Remedy by category of failures; where there are several, the first counts."""
TOO_SLOW = "too slow: messages are being dropped"
SILENT_S = 5.0
"""Silence of an input that is reported, by the machine's clock."""


def status(level: bytes, name: str, message: str, values: Mapping[str, object]) -> DiagnosticStatus:
    """Return one entry of a DiagnosticArray."""
    texts = {key: f"{value:.6g}" if isinstance(value, float) else str(value) for key, value in values.items()}
    pairs = [KeyValue(key=key, value=text) for key, text in texts.items()]
    return DiagnosticStatus(level=level, name=name, message=message, values=pairs)


class InputWatch:
    """Watch of one input topic: counts its messages and explains their absence.

    Args:
        topic: subscribed name, after remapping.
        kind: message class.
        rare: silence is no fault as long as there is a publisher.
    """

    def __init__(self, node: Node, name: str, topic: str, kind: type, rare: bool = False) -> None:
        self._node, self._rare = node, rare
        package, middle, *_ = kind.__module__.split(".")
        self._type = f"{package}/{middle}/{kind.__name__}"  # as the graph names it
        self.name, self.topic, self.warning = name, topic, ""
        self.received = self.refused = self.lost = 0
        self.last_stamp_ns: int | None = None
        self._last_seen_s: float | None = None
        self._started_s = time.monotonic()  # not the bag's clock: silence counts while /clock is silent, too
        self._window: tuple[float, int, int] = (self._started_s, 0, 0)

    def begin(self) -> None:
        """Restart the wait for the first message."""
        self._started_s = time.monotonic()

    def count(self, stamp_ns: int) -> None:
        """Count one message."""
        self.received += 1
        self.last_stamp_ns = stamp_ns
        self._last_seen_s = time.monotonic()

    def status(self) -> DiagnosticStatus:
        """Return the rate since the last call, and the reason when the topic is silent."""
        now_s = time.monotonic()
        since_s, count, refused = self._window
        rate = (self.received - count) / max(now_s - since_s, 1e-9)
        all_refused = self.received > count and self.refused - refused == self.received - count
        self._window = (now_s, self.received, self.refused)
        values = {
            "topic": self.topic,
            "rate_hz": round(rate, 2),
            "received": self.received,
            "refused": self.refused,
            "lost_on_the_wire": self.lost,
            "last_stamp_ns": "none" if self.last_stamp_ns is None else self.last_stamp_ns,
        }
        silent_s = None if self._last_seen_s is None else now_s - self._last_seen_s
        self.warning = ""
        if all_refused:
            self.warning = f"{self.name}: {rate:.1f} Hz on {self.topic}, all refused"
            return status(WARN, f"input {self.name}", f"{rate:.1f} Hz, all refused", values)
        if silent_s is not None and silent_s < SILENT_S:
            return status(OK, f"input {self.name}", f"{rate:.1f} Hz", values)
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        values["publishers"] = len(publishers)
        values["publisher_qos"] = ", ".join(one.qos_profile.reliability.name.lower() for one in publishers)
        if self._rare and any(info.topic_type == self._type for info in publishers):
            return status(OK, f"input {self.name}", f"{self.received} received", values)
        reason = self._reason(publishers, silent_s)
        if now_s - self._started_s > SILENT_S:
            self.warning = f"{self.name}: {reason}"
        return status(WARN, f"input {self.name}", reason, values)

    def _reason(self, publishers: list[TopicEndpointInfo], silent_s: float | None) -> str:
        kinds = {info.topic_type for info in publishers}
        if kinds and self._type not in kinds:
            return f"nothing received: {self.topic} carries {', '.join(sorted(kinds))}, expected {self._type}"
        if not kinds:
            others = self._others()
            hint = f"; {', '.join(others)} {'is' if len(others) == 1 else 'are'} of that type" if others else ""
            return f"nothing received: no publisher on {self.topic}{hint}"
        if silent_s is None:
            return f"nothing received from {len(publishers)} publisher(s) on {self.topic}: see their QoS"
        return f"silent for {silent_s:.0f} s: {len(publishers)} publisher(s) on {self.topic}"

    def _others(self) -> list[str]:
        """Return published topics that can be this input: of its type, no other input, closures only for closures."""
        taken = {subscription.topic_name for subscription in self._node.subscriptions}
        names = [name for name, types in self._node.get_topic_names_and_types() if self._type in types]
        fit = [name for name in names if name not in taken and is_own(name) == self._rare]
        return [name for name in fit if self._node.count_publishers(name)][:5]


DDS_TIMEOUT_S, DDS_TOPIC = 15.0, "umf_dds_check"


def exchange() -> str:
    """Send images from one DDS participant to another until one arrives; return the fault, empty without one."""
    contexts = Context(), Context()
    for context in contexts:
        rclpy.init(context=context)
    sender, receiver = (Node(f"umf_dds_check_{number}", context=context) for number, context in enumerate(contexts))
    executor = SingleThreadedExecutor(context=receiver.context)
    executor.add_node(receiver)
    arrived: list[Image] = []
    publisher = sender.create_publisher(Image, DDS_TOPIC, 10)
    receiver.create_subscription(Image, DDS_TOPIC, arrived.append, qos_profile_sensor_data)
    image = Image(width=688, height=512, step=688, encoding="mono8", data=array("B", bytes(688 * 512)))
    deadline = time.monotonic() + DDS_TIMEOUT_S
    while not arrived and time.monotonic() < deadline:
        if publisher.get_subscription_count():
            publisher.publish(image)
        executor.spin_once(timeout_sec=0.05)
    connected = publisher.get_subscription_count() > 0
    executor.remove_node(receiver)
    for node in (sender, receiver):
        node.destroy_node()
        rclpy.try_shutdown(context=node.context)
    if arrived and len(arrived[0].data) == len(image.data):
        return ""
    return "no message arrived" if connected else "publisher and subscriber did not find each other"


def main() -> None:
    """Print one line, on stdout with status 0 when an image arrived, else on stderr with status 1."""
    started = time.monotonic()
    fault = exchange()
    if fault:
        sys.exit(f"{fault} within {DDS_TIMEOUT_S:.0f} s")
    sys.stdout.write(f"an image arrived after {time.monotonic() - started:.1f} s\n")


if __name__ == "__main__":
    main()
