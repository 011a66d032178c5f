"""Whether DDS works on this machine: an image goes from a publisher to a subscriber."""

from __future__ import annotations

import sys
import time
from array import array

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rich.console import Console
from sensor_msgs.msg import Image

TIMEOUT_S = 15.0
TOPIC = "umf_dds_check"


def exchange() -> str:
    """Send images from one DDS participant to another until one arrives; returns what went wrong, or nothing."""
    contexts = Context(), Context()
    for context in contexts:
        rclpy.init(context=context)
    sender, receiver = (Node(f"umf_dds_check_{number}", context=context) for number, context in enumerate(contexts))
    executor = SingleThreadedExecutor(context=receiver.context)
    executor.add_node(receiver)
    arrived: list[Image] = []
    publisher = sender.create_publisher(Image, TOPIC, 10)
    receiver.create_subscription(Image, TOPIC, arrived.append, qos_profile_sensor_data)
    image = Image(width=688, height=512, step=688, encoding="mono8", data=array("B", bytes(688 * 512)))
    deadline = time.monotonic() + TIMEOUT_S
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
    """One line on stdout and 0 when an image arrived, on stderr and 1 when none did."""
    started = time.monotonic()
    fault = exchange()
    if fault:
        sys.exit(f"{fault} within {TIMEOUT_S:.0f} s")
    Console().print(f"an image arrived after {time.monotonic() - started:.1f} s")


if __name__ == "__main__":
    main()
