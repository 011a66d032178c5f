"""Publishes what the detector found."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from umf_ros.core.config import FrameIds
from umf_ros.core.frames import Keyframe
from umf_ros.detector import Detection
from umf_ros.nodes import conversions
from umf_ros.nodes.diagnostics import OK, WARN, status
from umf_ros.nodes.qos import CLOSURES_QOS, LATCHED_QOS
from umf_ros.verification import Verdict

if TYPE_CHECKING:
    from umf_ros.fleet.inter_robot_closures import InterRobotClosure

# RViz redraws every line it is sent: a rover that runs for days shows its latest ones
MAX_LINES = 500


class ClosurePublisher:
    """Loop closures, keyframes, tested candidates and markers of one node.

    `loop_closures` carries verified closures only; `~/candidates` everything that was tested.

    Attributes:
        odom: name of the odometry's frame.
    """

    def __init__(self, node: Node, frames: FrameIds) -> None:
        self._node = node
        self.odom = frames.odom
        self._closures = node.create_publisher(Odometry, "loop_closures", CLOSURES_QOS)
        self._keyframes = node.create_publisher(PoseStamped, "~/keyframes", CLOSURES_QOS)
        self._candidates = node.create_publisher(DiagnosticArray, "~/candidates", 10)
        self._markers = node.create_publisher(MarkerArray, "~/markers", LATCHED_QOS)
        self._accepted: deque[list] = deque(maxlen=MAX_LINES)
        self._rejected: deque[list] = deque(maxlen=MAX_LINES)

    def announce(self, detection: Detection, matches: dict[int, Keyframe]) -> None:
        """Publish one detection.

        Args:
            detection: what became of a frame.
            matches: the matched keyframes by stamp, for the markers.
        """
        keyframe = detection.keyframe
        if keyframe is None:
            return
        for closure in detection.closures:
            self._closures.publish(conversions.closure_to_message(closure))
        self._keyframes.publish(self._pose_of(keyframe))
        if detection.verdicts:
            report = DiagnosticArray(status=[_describe(keyframe, verdict) for verdict in detection.verdicts])
            report.header.stamp = conversions.to_time(keyframe.stamp_ns)
            self._candidates.publish(report)
            self._draw(keyframe, detection.verdicts, matches)

    def announce_encounter(self, inter_closure: InterRobotClosure) -> None:
        """Publish what was found of another rover's places: closures like any other, with the names of both rovers."""
        for closure in inter_closure.closures:
            self._closures.publish(conversions.closure_to_message(closure, inter_closure.own, inter_closure.robot))
        report = DiagnosticArray(
            status=[_describe(inter_closure.keyframe, one, inter_closure.robot) for one in inter_closure.verdicts]
        )
        report.header.stamp = conversions.to_time(inter_closure.keyframe.stamp_ns)
        self._candidates.publish(report)

    def wait_until_heard(self) -> None:
        """Wait until whoever listens has the last closures, as far as they answer soon."""
        self._closures.wait_for_all_acked(Duration(seconds=1))

    def _pose_of(self, keyframe: Keyframe) -> PoseStamped:
        """The keyframe's odometry; without one it is where it is: at the origin of its own frame."""
        if keyframe.odom_T_body is not None:
            return conversions.to_pose_stamped(keyframe.stamp_ns, self.odom, keyframe.odom_T_body)
        return conversions.to_pose_stamped(keyframe.stamp_ns, conversions.keyframe_frame(keyframe.stamp_ns), np.eye(4))

    def _draw(self, keyframe: Keyframe, verdicts: list[Verdict], matches: dict[int, Keyframe]) -> None:
        if keyframe.odom_T_body is None:
            return
        here = conversions.to_point(keyframe.odom_T_body[:3, 3])
        for verdict in verdicts:
            match = matches.get(verdict.candidate.stamp_ns)
            if match is None or match.odom_T_body is None or match.session != keyframe.session:
                continue
            lines = self._rejected if verdict.closure is None else self._accepted
            lines.append([conversions.to_point(match.odom_T_body[:3, 3]), here])
        header = conversions.to_header(keyframe.stamp_ns, self.odom)
        chosen = {"accepted": self._accepted, "rejected": self._rejected}
        self._markers.publish(MarkerArray(markers=[conversions.to_lines(*item, header) for item in chosen.items()]))


def _describe(keyframe: Keyframe, verdict: Verdict, robot: str = "") -> DiagnosticStatus:
    accepted = verdict.closure is not None
    name = f"{conversions.keyframe_frame(verdict.candidate.stamp_ns, robot)} -> {keyframe.stamp_ns}"
    numbers = {"similarity": verdict.candidate.similarity, **verdict.numbers}
    return status(OK if accepted else WARN, name, verdict.reason, numbers)
