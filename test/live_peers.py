"""A node beside the one under test, over real DDS: it hears some topics, and one line of the diagnostics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from processes import call_service, wait_until
from rclpy.node import Node
from std_srvs.srv import Trigger

from umf_ros.core.geometry import Array
from umf_ros.nodes.conversions import to_header, to_pose


def odometry(stamp_ns: int, pose: Array) -> Odometry:
    message = Odometry(header=to_header(stamp_ns, "odom"), child_frame_id="base_link")
    message.pose.pose = to_pose(pose)
    return message


class Peer(Node):
    """Hears a node.

    Attributes:
        heard: messages by the name of the topic below the node's.
        values, message, level: the newest of the line of its diagnostics.
        messages: of every line, by node and line.
    """

    def __init__(self, tested: str, line: str) -> None:
        super().__init__("rig")
        self._tested, self._line = tested, f"{tested}: {line}"
        self.heard: dict[str, list[Any]] = {}
        self.values: dict[str, str] = {}
        self.message, self.level = "", DiagnosticStatus.OK
        self.messages: dict[str, str] = {}
        self.create_subscription(DiagnosticArray, "/diagnostics", self._diagnose, 10)

    def hear(self, kind: type, name: str, qos: object) -> None:
        self.heard[name] = []
        self.create_subscription(kind, f"/{self._tested}/{name}", self.heard[name].append, qos)

    def spin(self) -> None:
        rclpy.spin_once(self, timeout_sec=0.02)

    def until(self, condition: Callable[[], object], timeout_s: float = 30.0) -> bool:
        return wait_until(lambda: bool(condition()), timeout_s, self.spin)

    def wait_for(self, condition: Callable[[], object]) -> None:
        assert self.until(condition, 40.0), self.values

    def call(self, service: str, kind: type = Trigger, request: object = None) -> Any:
        return call_service(self, kind, f"/{self._tested}/{service}", request or kind.Request())

    def _diagnose(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.messages[status.name] = status.message
            if status.name == self._line:
                self.values = {pair.key: pair.value for pair in status.values}
                self.message, self.level = status.message, status.level
