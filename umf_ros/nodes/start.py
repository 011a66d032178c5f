"""Start of the nodes, before their libraries are loaded: entry points of the executables, and the checks of a launch.

`ros2 launch` imports this file with the Python of the system, which has YAML but none of the libraries.
"""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from umf_ros.core.errors import ConfigError, UmfError
from umf_ros.core.resources import check_packages


def start(module: str) -> None:
    """Load the module of a node and run its `main`; a signal during that ends the process with status 0.

    Loading the libraries takes seconds. A missing package is one line on stderr and status 1.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))  # there is nothing to lose yet
    try:
        check_packages()
        main = import_module(module).main
    except UmfError as error:
        sys.exit(f"umf: {error}")
    except ModuleNotFoundError as error:
        sys.exit(f"umf: {error.name} is not installed; run umf doctor for a remedy")
    main()


loop_closure_node, pose_graph_node, map_node = (
    partial(start, f"umf_ros.nodes.{node}") for node in ("loop_closure_node", "pose_graph_node", "map_node")
)
"""Entry points of the executables."""

PARAMETERS = "ros__parameters"


def check_parameter_file(path: Path, nodes: Sequence[str]) -> None:
    """Check that a parameter file has a section for one of the nodes (full names): ROS ignores all others.

    Raises:
        ConfigError: there is no such file, it is not YAML, or it has no section for any of the nodes.
    """
    from umf_ros.core.io import read_yaml

    if not path.is_file():
        raise ConfigError(f"params_file: there is no {path}")
    keys = list(_sections(read_yaml(path)))
    if not any(_matches(key, node) for key in keys for node in nodes):
        named = ", ".join(keys) or f"no {PARAMETERS} at all"
        raise ConfigError(f"params_file: {path} sets nothing for {' or '.join(nodes)}, but {named} ('/**' is for all)")


def is_true(name: str, text: str) -> bool:
    """Return the value of a boolean argument.

    Raises:
        ConfigError: it is neither.
    """
    values = {"true": True, "1": True, "yes": True, "on": True, "false": False, "0": False, "no": False, "off": False}
    if text.strip().lower() not in values:
        raise ConfigError(f"{name}: true or false, not {text!r}")
    return values[text.strip().lower()]


def full_name(namespace: str, node: str) -> str:
    """Return the full name of a node in a namespace."""
    return "/".join(["", *(part for part in namespace.split("/") if part), node])


def _sections(content: Any, prefix: str = "") -> Iterator[str]:
    """Yield names above `ros__parameters`, those of nested namespaces joined."""
    if not isinstance(content, dict):
        return
    for key, inner in content.items():
        if key == PARAMETERS:
            yield prefix
        else:
            yield from _sections(inner, f"{prefix}/{str(key).strip('/')}")


def _matches(key: str, node: str) -> bool:
    """Return whether a name, perhaps with ROS wildcards (`*`: one part, `**`: any number), matches a node."""
    parts = {"/**": "(/[^/]+)*", "/*": "/[^/]+"}
    pattern = "".join(parts.get(part, re.escape(part)) for part in re.findall(r"/[^/]*", key))
    return re.fullmatch(pattern, node) is not None
