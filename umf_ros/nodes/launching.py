"""Checks of `ros2 launch` before it starts anything. The system's Python runs it: nothing but YAML is imported."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from umf_ros.core.errors import ConfigError
from umf_ros.core.io import read_yaml

PARAMETERS = "ros__parameters"


def check_parameter_file(path: Path, nodes: Sequence[str]) -> None:
    """Check that a parameter file has a section for one of the nodes (full names): ROS ignores all others.

    Raises:
        ConfigError: there is no such file, it is no YAML, or nothing in it is for any of the nodes.
    """
    if not path.is_file():
        raise ConfigError(f"params_file: there is no {path}")
    keys = list(_sections(read_yaml(path)))
    if not any(_matches(key, node) for key in keys for node in nodes):
        named = ", ".join(keys) or f"no {PARAMETERS} at all"
        raise ConfigError(f"params_file: {path} sets nothing for {' or '.join(nodes)}, but {named} ('/**' is for all)")


def is_true(name: str, text: str) -> bool:
    """The value of an argument that is true or false.

    Raises:
        ConfigError: it is neither.
    """
    values = {"true": True, "1": True, "yes": True, "on": True, "false": False, "0": False, "no": False, "off": False}
    if text.strip().lower() not in values:
        raise ConfigError(f"{name}: true or false, not {text!r}")
    return values[text.strip().lower()]


def full_name(namespace: str, node: str) -> str:
    """The name of a node in a namespace, as the graph has it."""
    return "/".join(["", *(part for part in namespace.split("/") if part), node])


def _sections(content: Any, prefix: str = "") -> Iterator[str]:
    """Names that stand above `ros__parameters`, those of nested namespaces joined."""
    if not isinstance(content, dict):
        return
    for key, inner in content.items():
        if key == PARAMETERS:
            yield prefix
        else:
            yield from _sections(inner, f"{prefix}/{str(key).strip('/')}")


def _matches(key: str, node: str) -> bool:
    """Whether a name that may hold the wildcards of ROS, `*` for one part and `**` for any number, is a node's."""
    parts = {"/**": "(/[^/]+)*", "/*": "/[^/]+"}
    pattern = "".join(parts.get(part, re.escape(part)) for part in re.findall(r"/[^/]*", key))
    return re.fullmatch(pattern, node) is not None
