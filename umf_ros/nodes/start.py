"""Entry points of the executables. To load the libraries takes seconds, and Ctrl-C may come before it is done."""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module


def start(module: str) -> None:
    """Load the module of a node and run its `main`; a signal that comes meanwhile ends the process with status 0.

    A missing package is one line on stderr and status 1.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))  # nothing is made yet that could be lost
    from umf_ros.core.errors import UmfError
    from umf_ros.core.resources import check_packages

    try:
        check_packages()
        main = import_module(module).main
    except UmfError as error:
        sys.exit(f"umf: {error}")
    except ModuleNotFoundError as error:
        sys.exit(f"umf: {error.name} is not installed; umf doctor says what helps")
    main()


def loop_closure_node() -> None:
    """Entry point of `ros2 run umf_ros loop_closure_node`."""
    start("umf_ros.nodes.loop_closure_node")


def pose_graph_node() -> None:
    """Entry point of `ros2 run umf_ros pose_graph_node`."""
    start("umf_ros.nodes.pose_graph_node")
