"""Settings as ROS parameters, declared with description and range, and checked by the same model."""

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

# parameters of rclpy itself
BUILT_IN = ("use_sim_time", "qos_overrides", "start_type_description_service")
AUTOSTART = "configure and activate at once; false: wait for the services of the life cycle"
SIGNS = {Ge: ">=", Gt: ">", Le: "<=", Lt: "<"}
OWN_ODOMETRY = "loop_closure_node/odometry"
"""Topic of the odometry that the front-end makes from the scans."""
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
"""Settings that may change while a node runs; they take effect with the next keyframe or closure."""


def declare(node: Node, results: str) -> tuple[Settings, str]:
    """Declare all settings, `results_dir` and `autostart` on `node`, with the overrides of files and arguments.

    The node must have been made with `automatically_declare_parameters_from_overrides=True`: otherwise unknown
    names cannot be detected. Whole numbers are taken where a float is declared. `results` describes the folder
    `results_dir`. Returns the settings and that folder.

    Raises:
        ConfigError: a parameter is unknown, of the wrong type or out of range.
    """
    # rclpy annotates plain values here, but returns Parameter objects
    overrides: dict[str, Any] = dict(node.get_parameters_by_prefix(""))
    given = {name: one.value for name, one in overrides.items() if not name.startswith(BUILT_IN)}
    for name in given:
        node.undeclare_parameter(name)
    folder, autostart = given.pop("results_dir", ""), given.pop("autostart", True)
    wrong = [] if isinstance(folder, str) else [f"results_dir: expected text, got {folder!r}"]
    wrong += [] if isinstance(autostart, bool) else [f"autostart: expected true or false, got {autostart!r}"]
    if wrong:
        raise ConfigError("; ".join(wrong))
    settings = parse_settings(nest(given))
    declared = [(name, value, describe(name, field)) for name, field, value in _leaves(settings)]
    for name, value, text in (("results_dir", folder, results), ("autostart", autostart, AUTOSTART)):
        declared.append((name, value, ParameterDescriptor(description=text, read_only=True)))
    for name, value, descriptor in declared:
        # the overrides are in `value` already, with the right type
        node.declare_parameter(name, value, descriptor, ignore_override=True)
    return settings, folder


def changed_settings(settings: Settings, parameters: Sequence[Parameter]) -> Settings:
    """Return the settings with some parameters changed; other parameters are left to ROS.

    Raises:
        ConfigError: a value is out of range.
    """
    known = {name for name, *_ in _leaves(settings)}
    changed = {parameter.name: parameter.value for parameter in parameters if parameter.name in known}
    if not changed:
        return settings
    values = {name: value for name, _, value in _leaves(settings)}
    return parse_settings(nest(values | changed))


def with_own_odometry(settings: Settings) -> Settings:
    """Return settings whose topic of the odometry is that of the front-end, where an engine makes it.

    Raises:
        ConfigError: they name a topic of the odometry, too.
    """
    if not settings.odometry.engine:
        return settings
    if settings.topics.odometry and "odometry" in settings.topics.model_fields_set:
        raise ConfigError("odometry.engine makes the odometry that topics.odometry names: leave one of them")
    topics = settings.topics.model_copy(update={"odometry": OWN_ODOMETRY})
    return settings.model_copy(update={"topics": topics})


def describe(name: str, field: FieldInfo) -> ParameterDescriptor:
    """Return the description, range and choices of a setting."""
    descriptor = ParameterDescriptor(description=field.description or "", read_only=not name.startswith(CHANGEABLE))
    if get_origin(field.annotation) is Literal:
        descriptor.additional_constraints = f"one of: {', '.join(map(str, get_args(field.annotation)))}"
    bounds = {type(one): getattr(one, type(one).__name__.lower()) for one in field.metadata if type(one) in SIGNS}
    if bounds:
        descriptor.additional_constraints = ", ".join(f"{SIGNS[kind]} {bound:g}" for kind, bound in bounds.items())
        lower, upper = bounds.get(Ge, bounds.get(Gt)), bounds.get(Le, bounds.get(Lt))
        if field.annotation is int:
            low, high = -(2**63) if lower is None else int(lower), 2**63 - 1 if upper is None else int(upper)
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
        else:
            far = sys.float_info.max
            least, most = -far if lower is None else float(lower), far if upper is None else float(upper)
            descriptor.floating_point_range = [FloatingPointRange(from_value=least, to_value=most)]
    return descriptor


def _leaves(group: BaseModel, prefix: str = "") -> Iterator[tuple[str, FieldInfo, Any]]:
    """Yield every single setting: dotted name, its field, its value."""
    for name, field in type(group).model_fields.items():
        value = getattr(group, name)
        if isinstance(value, BaseModel):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", field, value
