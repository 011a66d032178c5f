"""Starting and stopping a node: signals, errors, last words."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rclpy.node import Node

from umf_ros.errors import ConfigError
from umf_ros.nodes import dds_check
from umf_ros.nodes.process import run


@pytest.fixture(autouse=True)
def leave_signals_alone() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
    rclpy.try_shutdown()


class Dutiful(Node):
    """Does something once it spins, and has work to finish at the end."""

    def __init__(self, action: Callable[[], object]) -> None:
        super().__init__("dutiful")
        self.closed = 0
        self.could_still_publish = False
        self._action = action
        self.create_timer(0.01, self._act)

    def _act(self) -> None:
        self._action()

    def close(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)  # an impatient user
        self.could_still_publish = rclpy.ok()
        self.closed += 1


def send(number: int) -> Callable[[], object]:
    return lambda: os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_spinning_and_the_node_finishes_its_work(number: int) -> None:
    nodes: list[Dutiful] = []

    def make() -> Node:
        nodes.append(Dutiful(send(number)))
        return nodes[0]

    assert run(make) == 0
    assert nodes[0].closed == 1 and nodes[0].could_still_publish
    assert not rclpy.ok()


def test_a_node_without_work_to_finish_ends_too() -> None:
    def make() -> Node:
        node = Node("plain")
        node.create_timer(0.01, send(signal.SIGINT))
        return node

    assert run(make) == 0


def test_an_error_at_the_start_is_one_line_and_status_1(capfd: pytest.CaptureFixture[str]) -> None:
    def make() -> Node:
        raise ConfigError("unknown parameter loop.topk")

    assert run(make) == 1
    assert capfd.readouterr() == ("", "umf: unknown parameter loop.topk\n")
    assert not rclpy.ok()


def test_results_are_written_even_when_a_callback_fails() -> None:
    def fail() -> None:
        raise ZeroDivisionError("a fault in the program")

    nodes: list[Dutiful] = []

    def make() -> Node:
        nodes.append(Dutiful(fail))
        return nodes[0]

    with pytest.raises(ZeroDivisionError):
        run(make)
    assert nodes[0].closed == 1 and not rclpy.ok()


def test_arguments_reach_the_node() -> None:
    values: list[object] = []

    def make() -> Node:
        node = Node("plain", automatically_declare_parameters_from_overrides=True)
        values.append(node.get_parameter("depth").value)
        node.create_timer(0.01, send(signal.SIGINT))
        return node

    assert run(make, ["--ros-args", "-p", "depth:=7"]) == 0
    assert values == [7]


def test_two_participants_exchange_an_image(capsys: pytest.CaptureFixture[str]) -> None:
    dds_check.main()
    assert "an image arrived after" in capsys.readouterr().out


def test_images_that_do_not_arrive_are_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dds_check, "TIMEOUT_S", 0.0)
    with pytest.raises(SystemExit) as ended:
        dds_check.main()
    # text as the status: Python writes it to stderr and exits with 1
    told = "no message arrived", "publisher and subscriber did not find each other"
    assert ended.value.code in [f"{fault} within 0 s" for fault in told]
