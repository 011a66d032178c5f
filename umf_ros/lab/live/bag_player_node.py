"""Publishes a recording on its topics, with /clock, at the pace of the recording."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.utilities import remove_ros_args
from rich.console import Console
from rosgraph_msgs.msg import Clock

from umf_ros.bags.reader import Bag, open_bag
from umf_ros.commands.console import LineProgress, waiting
from umf_ros.core.errors import BagError, UmfError
from umf_ros.core.resources import find
from umf_ros.nodes.conversions import latched
from umf_ros.nodes.process import complain, init

CLOCK_PERIOD_NS = 10_000_000
TRANSPORT, TRANSPORT_FILE = "FASTRTPS_DEFAULT_PROFILES_FILE", "config/dds/large_messages.xml"
"""Where Fast DDS reads how a process sends, and what it takes to send images at full rate."""
SENSOR_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2")
SUBSCRIBER_TIMEOUT_S = 180.0
SETTLING_S = 2.0
"""Discovery is over when nothing has changed for this long."""


class BagPlayer(Node):
    """Plays a recording; messages go out serialised, as they were recorded.

    Args:
        bag: the recording.
        rate: 2 plays it twice as fast.
    """

    def __init__(self, bag: Bag, rate: float) -> None:
        super().__init__("bag_player")
        self._bag = bag
        self._rate = rate
        self._clock_publisher = self.create_publisher(Clock, "/clock", 10)
        self._topic_publishers = self._make_publishers()
        self._last_clock_ns: int | None = None

    def wait_for_subscribers(self) -> None:
        """Wait until somebody takes images and scans (as far as there are any) and all subscriptions are connected.

        Raises:
            UmfError: no subscriber within the time.
        """
        sensors = [
            [topic for topic in self._topic_publishers if self._bag.topics[topic].type == kind] for kind in SENSOR_TYPES
        ]
        deadline = time.monotonic() + SUBSCRIBER_TIMEOUT_S
        settled_since = None
        while settled_since is None or time.monotonic() - settled_since < SETTLING_S:
            if not all(self._is_taken(topics) for topics in sensors if topics) or not self._all_connected():
                settled_since = None
            elif settled_since is None:
                settled_since = time.monotonic()
            if time.monotonic() > deadline:
                names = " and ".join(" or ".join(self._names(topics)) for topics in sensors if topics)
                raise UmfError(f"no node subscribed to {names} within {SUBSCRIBER_TIMEOUT_S:.0f} s")
            time.sleep(0.02)

    def play(self, on_progress: Callable[[float], None]) -> None:
        """Publish the whole recording once; `on_progress` gets the seconds played."""
        started = time.monotonic()
        self._last_clock_ns = None
        for message in self._bag.raw_messages(self._topic_publishers):
            self._wait_until(message.log_ns, started)
            self._publish_clock(message.log_ns)
            self._topic_publishers[message.topic].publish(bytes(message.data))
            on_progress((message.log_ns - self._bag.start_ns) * 1e-9)

    def finish(self) -> None:
        """Wait until reliable subscribers have everything."""
        for publisher in self._topic_publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=2))

    def _make_publishers(self) -> dict[str, Publisher]:
        publishers: dict[str, Publisher] = {}
        for topic, info in self._bag.topics.items():
            kind = message_type(info.type)
            if kind is None:
                self.get_logger().warning(f"{topic} is left out: {info.type} is not installed")
            elif topic != "/clock" and info.count:
                # in a namespace its topics move along; the trees of transforms are one for all
                name = topic if topic in ("/tf", "/tf_static") else topic.removeprefix("/")
                publishers[topic] = self.create_publisher(kind, name, latched(20) if topic == "/tf_static" else 20)
        if not publishers:
            raise BagError(f"{self._bag.path} holds no topic whose message type is installed")
        return publishers

    def _names(self, topics: list[str]) -> list[str]:
        return [self._topic_publishers[topic].topic_name for topic in topics]

    def _is_taken(self, topics: list[str]) -> bool:
        return any(self._topic_publishers[topic].get_subscription_count() for topic in topics)

    def _all_connected(self) -> bool:
        return all(
            publisher.get_subscription_count() >= self.count_subscribers(publisher.topic_name)
            for publisher in self._topic_publishers.values()
        )

    def _wait_until(self, log_ns: int, started: float) -> None:
        """Sleep until a message is due, while the clock runs on."""
        due = started + (log_ns - self._bag.start_ns) * 1e-9 / self._rate
        while (remaining_s := due - time.monotonic()) > 0:
            self._publish_clock(log_ns - round(remaining_s * self._rate * 1e9))
            time.sleep(min(remaining_s, CLOCK_PERIOD_NS * 1e-9))

    def _publish_clock(self, now_ns: int) -> None:
        if self._last_clock_ns is not None and now_ns < self._last_clock_ns + CLOCK_PERIOD_NS:
            return
        self._last_clock_ns = now_ns
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now_ns, 10**9)
        self._clock_publisher.publish(message)


def message_type(name: str) -> Any | None:
    """Return the class of a message by its name, as in sensor_msgs/msg/Image; None where it is not installed."""
    package, _, kind = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind, None)
    except ImportError:
        return None


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="bag_player_node", description="Publish a recording on its topics.")
    parser.add_argument("bag", type=Path, help="mcap file, db3 folder, or ROS 1 .bag")
    parser.add_argument("--rate", type=float, default=1.0, help="speed, 1 is that of the recording")
    parser.add_argument("--loop", action="store_true", help="start again at the end, until Ctrl-C")
    parser.add_argument("--wait-for-subscribers", action="store_true", help="start when images and scans are wanted")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    options = parser.parse_args(arguments)
    if not 0 < options.rate < float("inf"):
        parser.error(f"--rate must be positive (got {options.rate})")
    return options


def _play(options: argparse.Namespace) -> None:
    bag = open_bag(options.bag)
    player = BagPlayer(bag, options.rate)
    console = Console(stderr=True)
    if bag.warning:
        console.print(bag.warning, style="yellow", markup=False, highlight=False, soft_wrap=True)
    progress = LineProgress(Console(stderr=True, quiet=options.quiet), f"Playing {bag.path.name}")
    if options.wait_for_subscribers:
        with waiting(progress.console, "Waiting for subscribers"):
            player.wait_for_subscribers()
    with progress:
        while True:
            player.play(lambda seconds: progress.advance_to(seconds / max(bag.duration_s, 1e-9)))
            if not options.loop:
                break
    player.finish()


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def main() -> None:
    """Entry point of `ros2 run umf_ros bag_player_node`; 0 at the end and after Ctrl-C."""
    options = _parse(remove_ros_args(sys.argv)[1:])
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    status = 0
    try:
        os.environ.setdefault(TRANSPORT, str(find(TRANSPORT_FILE)))
        init()
        _play(options)
    except KeyboardInterrupt:
        pass
    except UmfError as error:
        complain(error)
        status = 1
    finally:
        rclpy.try_shutdown()
    sys.exit(status)


if __name__ == "__main__":
    main()
