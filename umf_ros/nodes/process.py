"""Starting and stopping a node as a process."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from umf_ros.errors import UmfError


@runtime_checkable
class Closing(Protocol):
    """What a node's process needs of it."""

    def close(self) -> None:
        """Finish the work in hand and write the results."""
        ...


def run(make_node: Callable[[], Node], arguments: list[str] | None = None) -> int:
    """Spin one node until Ctrl-C, then let it finish; returns the exit status.

    A `UmfError` while the node starts or finishes is one line on stderr and status 1. The first SIGINT or
    SIGTERM ends the spinning; while the node writes its results further ones are ignored.
    """
    # our own handlers: rclpy's would shut the context down before the node has published its last words
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    stop = _StopRequest()
    try:
        node = make_node()
    except UmfError as error:
        complain(error)
        rclpy.try_shutdown()
        return 1
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    status = 0
    try:
        while not stop.requested and rclpy.ok():
            executor.spin_once(timeout_sec=0.2)
    except ExternalShutdownException:
        pass
    finally:
        try:
            if isinstance(node, Closing):
                node.close()
        except UmfError as error:
            complain(error)
            status = 1
        executor.shutdown()  # it must not outlive what it waits for
        node.destroy_node()
        rclpy.try_shutdown()
    return status


def complain(error: UmfError) -> None:
    """Tell an error as the command line does: one line on stderr."""
    sys.stderr.write(f"umf: {error}\n")


class _StopRequest:
    """Remembers that a signal asked the process to end."""

    def __init__(self) -> None:
        self.requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def _request(self, *_: object) -> None:
        self.requested = True
