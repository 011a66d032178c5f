"""Messages of the front-end, received by another node over DDS."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import make_keyframe
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from processes import wait_until
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from scipy.spatial.transform import Rotation
from visualization_msgs.msg import Marker, MarkerArray

from umf_ros.core.config import FrameIds
from umf_ros.core.frames import Candidate, Keyframe, LoopClosure
from umf_ros.core.geometry import Array, make_pose
from umf_ros.detector import Detection
from umf_ros.fleet.inter_robot_closures import InterRobotClosure
from umf_ros.nodes.conversions import (
    CLOSURES_QOS,
    LATCHED_QOS,
    MAX_LINES,
    closure_to_message,
    from_time,
    is_between_rovers,
)
from umf_ros.nodes.loop_closure_node import ClosurePublisher
from umf_ros.verification import Hypothesis, RejectReason

TOPICS: dict[str, tuple[type, Any]] = {
    "/loop_closures": (Odometry, CLOSURES_QOS),
    "/front_end/keyframes": (PoseStamped, 10),
    "/front_end/candidates": (DiagnosticArray, 10),
    "/front_end/markers": (MarkerArray, LATCHED_QOS),
}
QUERY_NS = 1_667_000_100_123_456_789
MATCH_NS = 1_667_000_000_000_000_001
POSE = make_pose(Rotation.from_euler("zyx", [20, -3, 5], degrees=True).as_matrix(), [1.5, -0.75, 0.25])
UPPER = np.triu(np.arange(36.0).reshape(6, 6))
COVARIANCE = UPPER + UPPER.T + 100 * np.eye(6)


class Talk:
    """An announcer, and ears on all of its topics."""

    def __init__(self, frames: FrameIds) -> None:
        self.speaker = Node("front_end")
        self.listener = Node("listener")
        self.heard: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
        self.announcer = ClosurePublisher(self.speaker, frames)
        self.executor = SingleThreadedExecutor()
        for node in (self.speaker, self.listener):
            self.executor.add_node(node)
        for topic, (kind, qos) in TOPICS.items():
            self.listener.create_subscription(kind, topic, self.heard[topic].append, qos)
        assert wait_until(self.connected, spin=self.spin)

    def spin(self) -> None:
        self.executor.spin_once(timeout_sec=0.02)

    def connected(self) -> bool:
        publishers = [publisher for publisher in self.speaker.publishers if publisher.topic_name in TOPICS]
        return len(publishers) == len(TOPICS) and all(publisher.get_subscription_count() for publisher in publishers)

    def hear(self, topic: str, count: int = 1) -> list[Any]:
        assert wait_until(lambda: len(self.heard[topic]) >= count, spin=self.spin), f"{topic}: {self.heard[topic]}"
        return self.heard[topic]

    def close(self) -> None:
        self.speaker.destroy_node()
        self.listener.destroy_node()


@pytest.fixture
def talk(ros_context: None) -> Iterator[Talk]:
    made = Talk(FrameIds(odom="wheel_odom"))
    yield made
    made.close()


def at(stamp_ns: int, x: float, y: float, session: int = 0) -> Keyframe:
    pose = make_pose(Rotation.from_euler("z", 30, degrees=True).as_matrix(), [x, y, 0.5])
    return replace(make_keyframe(0, 1.0), stamp_ns=stamp_ns, odom_T_body=pose, session=session)


def accepted(match_ns: int = MATCH_NS, pose: Array = POSE) -> Hypothesis:
    closure = LoopClosure(QUERY_NS, match_ns, pose, COVARIANCE, 0.97)
    measurements = {"similarity": 0.8125, "inliers_image": 41.0}
    return Hypothesis(QUERY_NS, Candidate(0, match_ns, 0.8125), measurements, closure=closure, probability=0.9712345678)


def rejected(match_ns: int, reason: RejectReason = RejectReason.NO_POSE) -> Hypothesis:
    return Hypothesis(QUERY_NS, Candidate(1, match_ns, 0.5), {"similarity": 0.5, "inliers_image": 3.0}, reason)


def detection(verdicts: list[Hypothesis], keyframe: Keyframe | None = None) -> Detection:
    return Detection(QUERY_NS, keyframe or at(QUERY_NS, 4.0, 2.0), verdicts)


def test_a_closure_goes_out_as_it_is_documented(talk: Talk) -> None:
    talk.announcer.publish_closures(detection([accepted()]).closures)
    (message,) = talk.hear("/loop_closures")
    assert message.header.frame_id == f"keyframe/{MATCH_NS}" and message.child_frame_id == f"keyframe/{QUERY_NS}"
    assert from_time(message.header.stamp) == QUERY_NS
    p, q = message.pose.pose.position, message.pose.pose.orientation
    np.testing.assert_allclose([p.x, p.y, p.z], [1.5, -0.75, 0.25])
    turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    np.testing.assert_allclose(turn, POSE[:3, :3], atol=1e-12)
    # row by row: x y z rx ry rz
    np.testing.assert_array_equal(message.pose.covariance, COVARIANCE.ravel())
    assert message.twist.covariance[0] == -1.0 and message.twist.twist.linear.x == 0.0


def test_a_closure_with_another_rover_names_both(talk: Talk) -> None:
    found, waiting = accepted(), replace(accepted(8), reason=RejectReason.UNCONFIRMED)
    closure = found.closure
    assert closure is not None
    keyframe = at(QUERY_NS, 4.0, 2.0)
    talk.announcer.publish_inter_robot(InterRobotClosure(keyframe, "ada", "bea", [found, waiting], [closure]))
    (message,) = talk.hear("/loop_closures")
    assert message.header.frame_id == f"keyframe/bea/{MATCH_NS}"
    assert message.child_frame_id == f"keyframe/ada/{QUERY_NS}"
    assert is_between_rovers(message)
    (report,) = talk.hear("/front_end/candidates")
    assert [status.name for status in report.status] == [f"keyframe/bea/{n} -> {QUERY_NS}" for n in (MATCH_NS, 8)]
    assert not is_between_rovers(closure_to_message(closure))


def test_what_was_rejected_is_reported_and_never_published_as_a_closure(talk: Talk) -> None:
    without = detection([rejected(7), rejected(8, RejectReason.TURNED)])
    talk.announcer.publish_closures(without.closures)
    talk.announcer.announce(without, {})
    (report,) = talk.hear("/front_end/candidates")
    assert [status.message for status in report.status] == [RejectReason.NO_POSE.value, RejectReason.TURNED.value]
    talk.announcer.publish_closures(detection([accepted()]).closures)
    talk.hear("/loop_closures")
    assert len(talk.heard["/loop_closures"]) == 1


def test_every_candidate_is_reported_with_its_reason_and_numbers(talk: Talk) -> None:
    talk.announcer.announce(detection([accepted(), rejected(7)]), {})
    (report,) = talk.hear("/front_end/candidates")
    assert from_time(report.header.stamp) == QUERY_NS
    first, second = report.status
    assert first.name == f"keyframe/{MATCH_NS} -> {QUERY_NS}" and second.name == f"keyframe/7 -> {QUERY_NS}"
    assert (first.level, second.level) == (DiagnosticStatus.OK, DiagnosticStatus.WARN)
    values = {pair.key: pair.value for pair in first.values}
    assert values == {"similarity": "0.8125", "inliers_image": "41", "probability": "0.971235"}
    values = {pair.key: pair.value for pair in second.values}
    assert values == {"similarity": "0.5", "inliers_image": "3"}


def test_a_keyframe_is_a_pose_in_the_odometry_frame(talk: Talk) -> None:
    talk.announcer.announce(detection([]), {})
    (message,) = talk.hear("/front_end/keyframes")
    assert message.header.frame_id == "wheel_odom" and from_time(message.header.stamp) == QUERY_NS
    assert (message.pose.position.x, message.pose.position.y, message.pose.position.z) == (4.0, 2.0, 0.5)
    assert message.pose.orientation.z == pytest.approx(np.sin(np.radians(15)))


def test_silence_where_there_is_nothing_to_say(talk: Talk) -> None:
    talk.announcer.announce(Detection(QUERY_NS - 1), {})  # passed over
    untracked = replace(at(QUERY_NS, 0, 0), odom_T_body=None)
    talk.announcer.announce(detection([rejected(7)], untracked), {7: untracked})
    talk.hear("/front_end/candidates")
    talk.announcer.announce(detection([]), {})  # the last word: what was sent before it has arrived
    talk.hear("/front_end/keyframes")
    heard = {topic: len(messages) for topic, messages in talk.heard.items()}
    sent = dict.fromkeys(("/front_end/keyframes", "/front_end/candidates"), 1)
    assert heard == sent | dict.fromkeys(("/loop_closures", "/front_end/markers"), 0)


def lines(marker: Marker) -> list[tuple[float, ...]]:
    points = [(point.x, point.y, point.z) for point in marker.points]
    return [start + end for start, end in zip(points[::2], points[1::2], strict=True)]


def test_markers_join_the_match_with_the_query(talk: Talk) -> None:
    matches = {MATCH_NS: at(MATCH_NS, -1.0, 3.0), 7: at(7, 9.0, 9.0), 8: at(8, 1.0, 1.0, session=1)}
    talk.announcer.announce(detection([accepted(), rejected(7), rejected(8), rejected(9)]), matches)
    (message,) = talk.hear("/front_end/markers")
    green, red = message.markers
    assert (green.ns, red.ns) == ("accepted", "rejected") and green.id != red.id
    assert lines(green) == [(-1.0, 3.0, 0.5, 4.0, 2.0, 0.5)]
    # another session has another odometry frame, and 9 is not known any more: no line
    assert lines(red) == [(9.0, 9.0, 0.5, 4.0, 2.0, 0.5)]
    for marker in message.markers:
        assert marker.type == Marker.LINE_LIST and marker.action == Marker.ADD
        assert marker.header.frame_id == "wheel_odom" and from_time(marker.header.stamp) == QUERY_NS
        assert marker.pose.orientation.w == 1.0 and marker.scale.x > 0 and marker.color.a > 0
    assert green.color.g > green.color.r and red.color.r > red.color.g


def test_who_joins_late_gets_the_latest_markers(talk: Talk) -> None:
    for count, match_ns in enumerate((5, 6), 1):
        talk.announcer.announce(detection([accepted(match_ns)]), {match_ns: at(match_ns, match_ns, 0)})
        talk.hear("/front_end/markers", count)
    late: list[MarkerArray] = []
    talk.listener.create_subscription(MarkerArray, "/front_end/markers", late.append, LATCHED_QOS)
    assert wait_until(lambda: bool(late), spin=talk.spin)
    assert [len(lines(message.markers[0])) for message in late] == [2]


def test_markers_keep_the_latest_lines_only(talk: Talk) -> None:
    matches = {stamp: at(stamp, stamp, 0) for stamp in range(1, MAX_LINES + 11)}
    talk.announcer.announce(detection([rejected(stamp) for stamp in matches]), matches)
    (message,) = talk.hear("/front_end/markers")
    shown = lines(message.markers[1])
    assert len(shown) == MAX_LINES and shown[0][0] == 11.0 and shown[-1][0] == MAX_LINES + 10


@pytest.mark.parametrize(
    ("topic", "durability"),
    [
        ("/loop_closures", QoSDurabilityPolicy.TRANSIENT_LOCAL),
        ("/front_end/candidates", QoSDurabilityPolicy.VOLATILE),
        ("/front_end/keyframes", QoSDurabilityPolicy.TRANSIENT_LOCAL),
        ("/front_end/markers", QoSDurabilityPolicy.TRANSIENT_LOCAL),
    ],
)
def test_quality_of_service_is_as_documented(talk: Talk, topic: str, durability: QoSDurabilityPolicy) -> None:
    (publisher,) = talk.listener.get_publishers_info_by_topic(topic)
    assert publisher.qos_profile.reliability == QoSReliabilityPolicy.RELIABLE
    assert publisher.qos_profile.durability == durability


def test_a_burst_of_closures_arrives_whole_and_in_order(talk: Talk) -> None:
    for number in range(1, 81):
        talk.announcer.publish_closures(detection([accepted(number)]).closures)
    heard = talk.hear("/loop_closures", 80)
    assert [message.header.frame_id for message in heard] == [f"keyframe/{number}" for number in range(1, 81)]


def test_a_best_effort_listener_hears_closures_too(talk: Talk) -> None:
    heard: list[Odometry] = []
    qos = QoSProfile(depth=5, reliability=QoSReliabilityPolicy.BEST_EFFORT)
    talk.listener.create_subscription(Odometry, "/loop_closures", heard.append, qos)
    assert wait_until(lambda: talk.speaker.count_subscribers("/loop_closures") == 2, spin=talk.spin)

    def again() -> None:
        talk.announcer.publish_closures(detection([accepted()]).closures)
        talk.spin()

    assert wait_until(lambda: bool(heard), spin=again)


def test_who_joins_late_hears_every_closure(talk: Talk) -> None:
    for number in range(1, 151):
        talk.announcer.publish_closures(detection([accepted(number)]).closures)
    late: list[Odometry] = []
    talk.listener.create_subscription(Odometry, "/loop_closures", late.append, CLOSURES_QOS)
    assert wait_until(lambda: len(late) >= 150, spin=talk.spin)
    assert [message.header.frame_id for message in late] == [f"keyframe/{number}" for number in range(1, 151)]
