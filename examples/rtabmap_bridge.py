"""Loop closures as links between nodes of RTAB-Map, through its service `add_link`.

python examples/rtabmap_bridge.py      (with ROS 2 Jazzy and rtabmap_msgs; no package of umf_ros needed)

Names are those of `ros2 launch rtabmap_launch rtabmap.launch.py`; where RTAB-Map runs without that namespace, add
`--ros-args -r rtabmap/info:=info -r rtabmap/rtabmap/add_link:=rtabmap/add_link`.

RTAB-Map numbers its nodes, and says the stamp of each on `info`; its nodes are not taken at our keyframes' stamps. So
a closure is carried by odometry from both keyframes to the nodes nearest in time.
"""

from __future__ import annotations

import sys
from bisect import bisect_left, insort
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
USER_CLOSURE = 4
FURTHEST_NS = 1_000_000_000
"""A node further in time from a keyframe is none of it."""


def matrix(pose: Any) -> Array:
    """(4, 4) matrix of a geometry_msgs/Pose."""
    x, y, z, w = pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w
    made = np.eye(4)
    made[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    made[:3, 3] = pose.position.x, pose.position.y, pose.position.z
    return made


def quaternion(rotation: Array) -> Array:
    """X y z w of a (3, 3) rotation: the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    rows = [a - e - i, b + d, c + g, h - f], [b + d, e - a - i, f + h, c - g]
    symmetric = np.array([*rows, [c + g, f + h, i - a - e, d - b], [h - f, c - g, d - b, a + e + i]])
    found: Array = np.linalg.eigh(symmetric)[1][:, -1]
    return found if found[3] >= 0 else -found


def is_own(message: Any) -> bool:
    """Whether a closure lies between keyframes of this robot: between rovers of a fleet the frames name theirs."""
    return all(frame.count("/") == 1 for frame in (message.header.frame_id, message.child_frame_id))


class Links:
    """Turns closures into links as soon as nodes of RTAB-Map and odometry are there."""

    def __init__(self) -> None:
        self._nodes: list[tuple[int, int]] = []
        self._odometry: list[tuple[int, Any]] = []

    def add_node(self, stamp_ns: int, number: int) -> None:
        """RTAB-Map has made a node."""
        insort(self._nodes, (stamp_ns, number))

    def add_odometry(self, stamp_ns: int, pose: Any) -> None:
        """A pose of the odometry has come."""
        insort(self._odometry, (stamp_ns, pose), key=lambda item: item[0])

    def link(self, message: Any, types: Any) -> Any | None:
        """The link that a message of loop_closures says, or None while a node or odometry is missing."""
        stamps = [int(frame.removeprefix("keyframe/")) for frame in (message.header.frame_id, message.child_frame_id)]
        nodes = [self._nearest(self._nodes, stamp) for stamp in stamps]
        if nodes[0] is None or nodes[1] is None or nodes[0][1] == nodes[1][1]:
            return None
        ways = [self._way(node[0], stamp) for node, stamp in zip(nodes, stamps, strict=True) if node is not None]
        if ways[0] is None or ways[1] is None:
            return None
        transform = ways[0] @ matrix(message.pose.pose) @ np.linalg.inv(ways[1])
        # about the axes of the match's node instead of the match
        turn = np.kron(np.eye(2), ways[0][:3, :3])
        information = np.linalg.inv(turn @ np.reshape(message.pose.covariance, (6, 6)) @ turn.T)
        x, y, z, w = (float(number) for number in quaternion(transform[:3, :3]))
        shift = types.Vector3(**dict(zip("xyz", map(float, transform[:3, 3]), strict=True)))
        rigid = types.Transform(translation=shift, rotation=types.Quaternion(x=x, y=y, z=z, w=w))
        ids = {"from_id": nodes[0][1], "to_id": nodes[1][1]}
        return types.Link(**ids, type=USER_CLOSURE, transform=rigid, information=information.ravel())

    def _way(self, node_ns: int, keyframe_ns: int) -> Array | None:
        """`node_T_keyframe`, by odometry."""
        node, keyframe = (self._nearest(self._odometry, stamp) for stamp in (node_ns, keyframe_ns))
        if node is None or keyframe is None:
            return None
        return np.linalg.inv(matrix(node[1])) @ matrix(keyframe[1])

    @staticmethod
    def _nearest(items: list[tuple[int, Any]], stamp_ns: int) -> tuple[int, Any] | None:
        after = bisect_left(items, stamp_ns, key=lambda item: item[0])
        near = items[max(0, after - 1) : after + 1]
        best = min(near, key=lambda item: abs(item[0] - stamp_ns), default=None)
        return best if best is not None and abs(best[0] - stamp_ns) <= FURTHEST_NS else None


def main() -> None:
    """Forward every closure; those whose node is not there yet wait."""
    from types import SimpleNamespace

    import rclpy
    from geometry_msgs.msg import Quaternion, Transform, Vector3
    from nav_msgs.msg import Odometry
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rtabmap_msgs.msg import Info, Link
    from rtabmap_msgs.srv import AddLink

    rclpy.init()
    node = rclpy.create_node("rtabmap_bridge")
    types = SimpleNamespace(Link=Link, Transform=Transform, Vector3=Vector3, Quaternion=Quaternion)
    links = Links()
    waiting: list[Any] = []
    service = node.create_client(AddLink, "rtabmap/rtabmap/add_link")

    def stamp_ns(message: Any) -> int:
        return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)

    def add_odometry(message: Any) -> None:
        links.add_odometry(stamp_ns(message), message.pose.pose)

    def add_node(message: Any) -> None:
        links.add_node(stamp_ns(message), int(message.ref_id))

    def add_closure(message: Any) -> None:
        if is_own(message):
            waiting.append(message)

    def retry() -> None:
        if waiting and not service.service_is_ready():
            node.get_logger().warning(f"{len(waiting)} closures wait for {service.srv_name}", throttle_duration_sec=30)
            return
        for message in list(waiting):
            link = links.link(message, types)
            if link is not None:
                waiting.remove(message)
                service.call_async(AddLink.Request(link=link))

    latched = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(Odometry, "loop_closures", add_closure, latched)
    node.create_subscription(Odometry, "odom", add_odometry, 200)
    node.create_subscription(Info, "rtabmap/info", add_node, 100)
    node.create_timer(1.0, retry)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    try:
        main()
    except ModuleNotFoundError as error:
        missing = str(error.name).split(".")[0]
        first = {"rtabmap_msgs": "sudo apt install ros-jazzy-rtabmap-msgs, then "}.get(missing, "")
        sys.exit(f"rtabmap_bridge: {missing} is not installed: {first}source /opt/ros/jazzy/setup.bash")
