"""Diagnostics of the inputs: rates, and why nothing arrives."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from subprocess import PIPE, Popen
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from processes import wait_until
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from sources import ROOT

from umf_ros.core.config import Qos
from umf_ros.core.io import memory_mb
from umf_ros.nodes import diagnostics
from umf_ros.nodes.conversions import sensor_qos
from umf_ros.nodes.diagnostics import InputWatch, status

TOPIC = "/watched/image"


class Clock:
    """The machine's clock, as the test wants it."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(diagnostics, "time", SimpleNamespace(monotonic=made.monotonic))
    return made


@pytest.fixture
def node(ros_context: None) -> Iterator[Node]:
    made = Node("watcher")
    yield made
    made.destroy_node()


def values_of(line: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in line.values}


def publish_on(node: Node, count: int, reliability: QoSReliabilityPolicy = QoSReliabilityPolicy.RELIABLE) -> None:
    for _ in range(count):
        node.create_publisher(Image, TOPIC, QoSProfile(depth=1, reliability=reliability))
    assert wait_until(lambda: len(node.get_publishers_info_by_topic(TOPIC)) >= count)


def test_a_topic_that_talks_is_fine_and_has_its_rate(node: Node, clock: Clock) -> None:
    watch = InputWatch(node, "left_image", TOPIC, Image)
    clock.now_s += 2
    for i in range(9):
        watch.count(10**18 + i)
    line = watch.status()
    assert (line.level, line.name, line.message) == (DiagnosticStatus.OK, "input left_image", "4.5 Hz")
    assert values_of(line) == {
        "topic": TOPIC,
        "rate_hz": "4.5",
        "received": "9",
        "refused": "0",
        "lost_on_the_wire": "0",
        "last_stamp_ns": str(10**18 + 8),
    }
    assert watch.warning == ""


def test_the_rate_is_that_since_the_last_look(node: Node, clock: Clock) -> None:
    watch = InputWatch(node, "cloud", TOPIC, Image)
    rates = []
    for count in (5, 0, 20):
        clock.now_s += 1
        for _ in range(count):
            watch.count(1)
        rates.append(values_of(watch.status())["rate_hz"])
    assert rates == ["5", "0", "20"]


def test_an_input_of_which_everything_is_refused_is_a_warning_while_it_is_so(node: Node, clock: Clock) -> None:
    """As when a driver was started again with other frames: the rate alone looks healthy."""
    watch = InputWatch(node, "odometry", TOPIC, Image)
    levels = []
    for refused in (0, 3, 4):
        clock.now_s += 1
        for _ in range(4):
            watch.count(1)
        watch.refused += refused
        levels.append((watch.status().level, watch.warning))
    assert levels[:2] == [(DiagnosticStatus.OK, "")] * 2
    assert levels[2] == (DiagnosticStatus.WARN, f"odometry: 4.0 Hz on {TOPIC}, all refused")


def test_without_a_publisher_the_topic_is_named(node: Node, clock: Clock) -> None:
    watch = InputWatch(node, "cloud", TOPIC, Image)
    clock.now_s += 1
    line = watch.status()
    assert (line.level, line.message) == (DiagnosticStatus.WARN, f"nothing received: no publisher on {TOPIC}")
    assert values_of(line)["publishers"] == "0" and values_of(line)["last_stamp_ns"] == "none"
    assert watch.warning == ""  # a node that has just started waits for its topics
    clock.now_s += 5
    watch.status()
    assert watch.warning == f"cloud: nothing received: no publisher on {TOPIC}"


@pytest.mark.parametrize(
    ("reliability", "shown"),
    [(QoSReliabilityPolicy.BEST_EFFORT, "best_effort"), (QoSReliabilityPolicy.RELIABLE, "reliable")],
)
def test_publishers_that_are_not_heard_are_shown_with_their_qos(
    node: Node, clock: Clock, reliability: QoSReliabilityPolicy, shown: str
) -> None:
    watch = InputWatch(node, "left_image", TOPIC, Image)
    publish_on(node, 2, reliability)
    clock.now_s += 6
    line = watch.status()
    assert line.message == f"nothing received from 2 publisher(s) on {TOPIC}: see their QoS"
    assert values_of(line)["publisher_qos"] == f"{shown}, {shown}"
    assert watch.warning.startswith("left_image: nothing received")


def test_a_topic_that_falls_silent_is_a_warning_until_it_speaks_again(node: Node, clock: Clock) -> None:
    watch = InputWatch(node, "cloud", TOPIC, Image)
    publish_on(node, 1)
    watch.count(7)
    clock.now_s += 4.5
    assert watch.status().level == DiagnosticStatus.OK
    clock.now_s += 7.5
    assert watch.status().message == f"silent for 12 s: 1 publisher(s) on {TOPIC}"
    assert watch.warning == f"cloud: silent for 12 s: 1 publisher(s) on {TOPIC}"
    watch.count(8)
    assert watch.status().level == DiagnosticStatus.OK and watch.warning == ""


def test_a_line_of_diagnostics_is_text_for_any_value() -> None:
    line = status(diagnostics.ERROR, "name", "message", {"whole": 3, "real": 0.123456789, "text": "a b", "none": None})
    assert line.level == DiagnosticStatus.ERROR
    assert values_of(line) == {"whole": "3", "real": "0.123457", "text": "a b", "none": "None"}


def test_every_category_of_failures_is_documented() -> None:
    told = (ROOT / "docs" / "ros.md").read_text(encoding="utf-8")
    assert [
        name for name, remedy in diagnostics.FAILURES.items() if f"| `{name}` |" not in told or remedy not in told
    ] == []


def test_memory_is_what_is_resident_now() -> None:
    """Of a process of its own: in this one, pages of other tests come and go."""
    script = "block = b'x' * (100 * 2**20); print(flush=True); input(); del block; print(flush=True); input()"
    with Popen([sys.executable, "-c", script], stdin=PIPE, stdout=PIPE, text=True) as child:
        assert child.stdin is not None and child.stdout is not None
        resident = []
        for _ in range(2):
            child.stdout.readline()
            resident.append(memory_mb(child.pid))
            print(file=child.stdin, flush=True)
    assert 100 < resident[0] < 150 and resident[1] < 50


@pytest.mark.parametrize(
    ("settings", "least", "depth", "reliability"),
    [
        (Qos(), 1, 50, QoSReliabilityPolicy.BEST_EFFORT),
        (Qos(depth=5), 1, 5, QoSReliabilityPolicy.BEST_EFFORT),
        (Qos(depth=5), 30, 30, QoSReliabilityPolicy.BEST_EFFORT),
        (Qos(reliability="reliable", depth=200), 30, 200, QoSReliabilityPolicy.RELIABLE),
    ],
)
def test_sensors_are_subscribed_as_the_settings_say(
    settings: Qos, least: int, depth: int, reliability: QoSReliabilityPolicy
) -> None:
    profile = sensor_qos(settings, least)
    assert (profile.depth, profile.reliability) == (depth, reliability)


def test_another_type_on_the_topic_is_named(node: Node, clock: Clock) -> None:
    node.create_publisher(CompressedImage, TOPIC, 1)
    assert wait_until(lambda: len(node.get_publishers_info_by_topic(TOPIC)) == 1)
    watch = InputWatch(node, "left_image", TOPIC, Image)
    expected = f"nothing received: {TOPIC} carries sensor_msgs/msg/CompressedImage, expected sensor_msgs/msg/Image"
    assert watch.status().message == expected
    clock.now_s += 6
    watch.status()
    assert watch.warning == f"left_image: {expected}"


def test_a_sensor_under_another_name_is_named(node: Node, clock: Clock) -> None:
    for name in ("/elsewhere/image", "/blue/loop_closures"):
        node.create_publisher(Image, name, 1)
        assert wait_until(lambda name=name: node.count_publishers(name) == 1)
    message = InputWatch(node, "left_image", TOPIC, Image).status().message
    assert message == f"nothing received: no publisher on {TOPIC}; /elsewhere/image is of that type"


def test_what_is_rare_may_be_silent(node: Node, clock: Clock) -> None:
    publish_on(node, 1)
    watch = InputWatch(node, "closures", TOPIC, Image, rare=True)
    clock.now_s += 60
    assert watch.status().level == DiagnosticStatus.OK and watch.warning == ""
