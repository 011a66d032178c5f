"""Sensor topics of a running robot, recorded for some seconds."""

from __future__ import annotations

import os
import time
from functools import partial
from pathlib import Path

import rclpy
from mcap.writer import Writer
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from umf_ros.absolute.measurement import ABSOLUTE_TYPES
from umf_ros.core.config import Qos, Topics
from umf_ros.core.errors import UmfError
from umf_ros.lab.live.bag_player_node import message_type
from umf_ros.nodes.conversions import latched, sensor_qos
from umf_ros.nodes.diagnostics import InputWatch
from umf_ros.nodes.process import init
from umf_ros.sensors.decode import TYPES
from umf_ros.sensors.tf import TOPIC as TRANSFORMS
from umf_ros.sensors.tf import TYPE as TRANSFORMS_TYPE
from umf_ros.sensors.tf import transform_topics
from umf_ros.sensors.topic_finder import SETTLING_S, find_topics, is_own

RECORDED_S, SEARCH_S = 5.0, 10.0
LARGE_TYPES = {*TYPES["left_image"], *TYPES["cloud"]}
SENSOR_TYPES = {*sum(TYPES.values(), ()), *ABSOLUTE_TYPES.values(), TRANSFORMS_TYPE}


def record_robot(path: Path, named: Topics) -> dict[str, str]:
    """Find the topics of the sensors in the ROS graph and record them; return why an input or /tf_static is silent.

    Of images and scans only those are recorded that fit by type, or that the user `named`.

    Raises:
        UmfError: no topic of images or scans has a publisher.
    """
    init([])
    node = Node("umf_doctor", enable_rosout=False, start_parameter_services=False)
    try:
        types = _find_sensors(node)
        found, several = find_topics(types)
        inputs = found.model_dump() | {name: getattr(named, name) for name in named.model_fields_set}
        wanted = {*inputs.values(), *Topics().model_dump().values()}.union(*several.values())
        with path.open("wb") as stream:
            recorded = {topic: kind for topic, kind in types.items() if topic in wanted or kind not in LARGE_TYPES}
            causes = _record(node, recorded, Writer(stream))
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    if not transform_topics(types):
        causes[TRANSFORMS] = f"no topic {TRANSFORMS}"
    inputs[TRANSFORMS] = next(iter(transform_topics(types)), TRANSFORMS)
    return {name: causes[topic] for name, topic in inputs.items() if topic in causes}


def _find_sensors(node: Node) -> dict[str, str]:
    """Return type by topic of the sensors, as soon as nothing new was announced for a while."""
    types, since_s = dict[str, str](), time.monotonic()
    end_s = since_s + SEARCH_S
    while LARGE_TYPES.isdisjoint(types.values()) or time.monotonic() < since_s + SETTLING_S:
        before, names = types, node.get_topic_names_and_types()
        types = {topic: kinds[0] for topic, kinds in names if node.count_publishers(topic) and not is_own(topic)}
        since_s = since_s if types == before else time.monotonic()
        if time.monotonic() > end_s and LARGE_TYPES.isdisjoint(types.values()):
            others = [f"{topic} ({kind})" for topic, kind in types.items() if not kind.startswith("rcl_interfaces/")]
            raise UmfError(
                f"no topic of a LiDAR or a camera with ROS_DOMAIN_ID {os.environ.get('ROS_DOMAIN_ID', '0')} within "
                f"{SEARCH_S:.0f} s (others: {', '.join(others[:8]) or 'none'}); start the drivers, or name their domain"
            )
        time.sleep(0.1)
    return {topic: kind for topic, kind in types.items() if kind in SENSOR_TYPES}


def _record(node: Node, types: dict[str, str], writer: Writer) -> dict[str, str]:
    """Write the serialised messages; their times of recording are those of arrival."""
    causes, watches, executor = dict[str, str](), list[InputWatch](), SingleThreadedExecutor()
    executor.add_node(node)
    writer.start("ros2", "umf_ros")

    def take(channel: int, watch: InputWatch, data: bytes) -> None:
        now_ns = time.time_ns()
        watch.count(now_ns)
        writer.add_message(channel, now_ns, data, now_ns)

    for topic, kind in types.items():
        channel = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
        if (known := message_type(kind)) is None:
            causes[topic] = f"{topic} cannot be received: {kind.partition('/')[0]} is not installed"
            continue
        watches.append(InputWatch(node, "", topic, known))
        qos = latched(100) if topic.endswith(TRANSFORMS) else sensor_qos(Qos(), 200)
        node.create_subscription(known, topic, partial(take, channel, watches[-1]), qos, raw=True)
    end_s = time.monotonic() + RECORDED_S
    while time.monotonic() < end_s:
        executor.spin_once(timeout_sec=0.1)
    writer.finish()
    executor.shutdown()
    if not any(watch.received for watch in watches):
        raise UmfError(f"no message within {RECORDED_S:.0f} s on {', '.join(types)}; start the drivers")
    return causes | {watch.topic: watch.status().message for watch in watches if not watch.received}
