"""Every setting as a ROS parameter, declared with description and range, and checked by the same model."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import Any, Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from umf_ros.core.config import Settings, nest, parse_settings
from umf_ros.core.errors import ConfigError

# parameters rclpy itself brings along
BUILT_IN = ("use_sim_time", "qos_overrides", "start_type_description_service")
CHANGEABLE = (
    "loop.",
    "verification.min_probability",
    "pose_graph.gate_chi2",
    "pose_graph.pair_chi2",
    "pose_graph.max_chance",
    "pose_graph.max_closure_m",
    "pose_graph.max_correction_m",
    "pose_graph.max_pending_s",
    "pose_graph.min_support",
    "pose_graph.patience_m",
)
"""What may change while a node runs: it takes effect with the next keyframe or closure."""


def declare(node: Node, **own: str) -> tuple[Settings, dict[str, str]]:
    """Declare all settings on `node` and return them with the overrides of file, launch and command line.

    The node must have been made with `automatically_declare_parameters_from_overrides=True`: only so
    can an unknown name be told from a known one. Whole numbers are taken where a float is declared.

    Args:
        node: the node; gets a parameter `autostart` besides.
        own: further text parameters of this node, by name, with their description; empty by default.

    Returns:
        The settings, and the values of the node's own parameters.

    Raises:
        ConfigError: a parameter is unknown, of the wrong type or out of range.
    """
    given = {name: value for name, value in _overrides(node).items() if not name.startswith(BUILT_IN)}
    texts = {name: given.pop(name, "") for name in own}
    autostart = given.pop("autostart", True)
    wrong = [f"{name}: expected text, got {value!r}" for name, value in texts.items() if not isinstance(value, str)]
    if not isinstance(autostart, bool):
        wrong.append(f"autostart: expected true or false, got {autostart!r}")
    if wrong:
        raise ConfigError("; ".join(wrong))
    settings = parse_settings(nest(given))
    for name in [*given, *(name for name in (*own, "autostart") if node.has_parameter(name))]:
        node.undeclare_parameter(name)
    for name, field, value in _leaves(settings):
        _declare(node, name, value, describe(name, field))
    for name, description in own.items():
        _declare(node, name, texts[name], ParameterDescriptor(description=description, read_only=True))
    text = "configure and activate at once; false: wait for the services of the life cycle"
    _declare(node, "autostart", autostart, ParameterDescriptor(description=text, read_only=True))
    return settings, texts


def changed_settings(settings: Settings, parameters: Sequence[Parameter]) -> Settings:
    """The settings with some parameters changed; parameters that are no settings are left to ROS.

    Raises:
        ConfigError: a value is out of range.
    """
    known = {name for name, *_ in _leaves(settings)}
    changed = {parameter.name: parameter.value for parameter in parameters if parameter.name in known}
    if not changed:
        return settings
    values = {name: value for name, _, value in _leaves(settings)}
    return parse_settings(nest(values | changed))


def describe(name: str, field: FieldInfo) -> ParameterDescriptor:
    """Description, range and choices of a setting."""
    descriptor = ParameterDescriptor(description=field.description or "", read_only=not name.startswith(CHANGEABLE))
    if get_origin(field.annotation) is Literal:
        descriptor.additional_constraints = f"one of: {', '.join(map(str, get_args(field.annotation)))}"
    lower = [item for item in field.metadata if isinstance(item, Ge | Gt)]
    upper = [item for item in field.metadata if isinstance(item, Le | Lt)]
    if lower or upper:
        _limit(descriptor, field, lower, upper)
    return descriptor


def _limit(descriptor: ParameterDescriptor, field: FieldInfo, lower: list[Any], upper: list[Any]) -> None:
    bounds = [f"{'>=' if isinstance(item, Ge) else '>'} {_bound(item):g}" for item in lower]
    bounds += [f"{'<=' if isinstance(item, Le) else '<'} {_bound(item):g}" for item in upper]
    descriptor.additional_constraints = ", ".join(bounds)
    if field.annotation is int:
        limits = [int(_bound(lower[0])) if lower else -(2**63), int(_bound(upper[0])) if upper else 2**63 - 1]
        descriptor.integer_range = [IntegerRange(from_value=limits[0], to_value=limits[1], step=0)]
    else:
        low, high = (
            _bound(lower[0]) if lower else -sys.float_info.max,
            _bound(upper[0]) if upper else sys.float_info.max,
        )
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]


def _bound(item: Any) -> float:
    return float(next(getattr(item, name) for name in ("ge", "gt", "le", "lt") if hasattr(item, name)))


def _declare(node: Node, name: str, value: Any, descriptor: ParameterDescriptor) -> None:
    # the overrides are in `value` already, with the right type
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
