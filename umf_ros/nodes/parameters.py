"""Every setting as a ROS parameter, declared with its description and checked by the same model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from umf_ros.config import Settings, nest, parse_settings
from umf_ros.errors import ConfigError

# parameters rclpy itself brings along
BUILT_IN = ("use_sim_time", "qos_overrides", "start_type_description_service")


def declare(node: Node, **own: str) -> tuple[Settings, dict[str, str]]:
    """Declare all settings on `node` and return them with the overrides of file, launch and command line.

    The node must have been made with `automatically_declare_parameters_from_overrides=True`: only so
    can an unknown name be told from a known one. Whole numbers are taken where a float is declared.

    Args:
        node: the node.
        own: further text parameters of this node, by name, with their description; empty by default.

    Returns:
        The settings, and the values of the node's own parameters.

    Raises:
        ConfigError: a parameter is unknown, of the wrong type or out of range.
    """
    given = {name: value for name, value in _overrides(node).items() if not name.startswith(BUILT_IN)}
    texts = {name: given.pop(name, "") for name in own}
    wrong = [f"{name}: expected text, got {value!r}" for name, value in texts.items() if not isinstance(value, str)]
    if wrong:
        raise ConfigError("; ".join(wrong))
    settings = parse_settings(nest(given))
    for name in [*given, *(name for name in own if node.has_parameter(name))]:
        node.undeclare_parameter(name)
    for name, field, value in _leaves(settings):
        _declare(node, name, value, field.description or "")
    for name, description in own.items():
        _declare(node, name, texts[name], description)
    return settings, texts


def _declare(node: Node, name: str, value: Any, description: str) -> None:
    # the overrides are in `value` already, with the right type
    descriptor = ParameterDescriptor(description=description, read_only=True)
    node.declare_parameter(name, value, descriptor, ignore_override=True)


def _overrides(node: Node) -> dict[str, Any]:
    # rclpy annotates plain values here, but hands out Parameter objects
    parameters: dict[str, Any] = dict(node.get_parameters_by_prefix(""))
    return {name: parameter.value for name, parameter in parameters.items()}


def _leaves(group: BaseModel, prefix: str = "") -> Iterator[tuple[str, FieldInfo, Any]]:
    """Every single setting: dotted name, its field, its value."""
    for name, field in type(group).model_fields.items():
        value = getattr(group, name)
        if isinstance(value, BaseModel):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", field, value
