"""Entry points of the executables. To load the libraries takes seconds, and Ctrl-C may come before it is done."""

from __future__ import annotations

import os
import signal
from importlib import import_module


def start(module: str) -> None:
    """Load the module of a node and run its `main`; a signal that comes before it can be heard ends the process, as 0.

    Args:
        module: its name.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))  # nothing is made yet that could be lost
    import_module(module).main()


def loop_closure_node() -> None:
    """Entry point of `ros2 run umf_ros loop_closure_node`."""
    start("umf_ros.nodes.loop_closure_node")


def pose_graph_node() -> None:
    """Entry point of `ros2 run umf_ros pose_graph_node`."""
    start("umf_ros.nodes.pose_graph_node")
