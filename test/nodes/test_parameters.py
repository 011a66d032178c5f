from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from rcl_interfaces.msg import ParameterType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from umf_ros.core.config import Settings, load_settings
from umf_ros.core.errors import ConfigError
from umf_ros.nodes.parameters import CHANGEABLE, changed_settings, declare

RESULTS = "where results go"

made: list[tuple[Node, Context]] = []


@pytest.fixture(autouse=True)
def close_nodes() -> Iterator[None]:
    yield
    for node, context in made:
        node.destroy_node()
        rclpy.shutdown(context=context)
    made.clear()


def make_node(*overrides: str) -> Node:
    context = Context()
    arguments = ["--ros-args", *(word for override in overrides for word in ("-p", override))]
    rclpy.init(args=arguments, context=context)
    node = Node("probe", context=context, automatically_declare_parameters_from_overrides=True)
    made.append((node, context))
    return node


def test_without_overrides_every_setting_is_declared_with_its_default() -> None:
    node = make_node()
    settings, _ = declare(node, RESULTS)
    assert settings == Settings()
    assert node.get_parameter("loop.top_k").value == 20
    descriptor = node.describe_parameter("keyframe.min_translation_m")
    assert "translation" in descriptor.description and descriptor.read_only
    assert node.describe_parameter("qos.reliability").additional_constraints == "one of: best_effort, reliable"
    (limits,) = node.describe_parameter("loop.top_k").integer_range
    assert (limits.from_value, limits.to_value) == (1, 200)
    assert node.describe_parameter("keyframe.max_period_s").additional_constraints == "> 0"


def test_overrides_win_and_whole_numbers_pass_for_floats() -> None:
    node = make_node("loop.top_k:=7", "loop.min_time_gap_s:=50", "topics.cloud:=/points")
    settings, _ = declare(node, RESULTS)
    assert (settings.loop.top_k, settings.loop.min_time_gap_s, settings.topics.cloud) == (7, 50.0, "/points")
    assert node.get_parameter("loop.min_time_gap_s").value == 50.0


def test_a_parameter_file_reads_like_for_the_command_line(tmp_path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text("/**:\n  ros__parameters:\n    loop: {top_k: 5}\n    keyframe.min_period_s: 1\n")
    context = Context()
    rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
    node = Node("probe", context=context, automatically_declare_parameters_from_overrides=True)
    made.append((node, context))
    assert declare(node, RESULTS)[0] == load_settings(path)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("loop.topk:=7", "unknown parameter loop.topk"),
        ("loop.top_k:=many", r"loop\.top_k: .*got 'many'"),
        ("loop.min_travel_m:=-1.0", r"loop\.min_travel_m: .*greater than or equal to 0"),
        ("results_dir:=5", "results_dir: expected text, got 5"),
        ("loop.top_k:=2.5", r"loop\.top_k: .*got 2\.5"),
        ("loop.min_travel_m:=.nan", r"loop\.min_travel_m: .*got nan"),
        ("topics.cloud:=5", r"topics\.cloud: .*string.*got 5"),
        ("qos.reliability:=sometimes", r"qos\.reliability: .*'best_effort' or 'reliable'.*got 'sometimes'"),
        ("pose_graph.reject_outliers:=perhaps", r"pose_graph\.reject_outliers: .*boolean.*got 'perhaps'"),
        ("loop.top_k:=[1, 2]", r"loop\.top_k: .*integer"),
        ("loop:=5", r"loop: .*got 5"),
        ("dataset:=kitti", r"dataset: .*got 'kitti'"),
    ],
)
def test_what_is_wrong_is_named(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        declare(make_node(override), "somewhere")
    assert "\n" not in str(caught.value)


def test_everything_that_is_wrong_is_named_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        declare(make_node("loop.topk:=7", "loop.top_k:=0", "keyframe.min_period:=1.0"), RESULTS)
    told = str(caught.value)
    assert "unknown parameter loop.topk" in told and "unknown parameter keyframe.min_period" in told
    assert "loop.top_k: " in told and "\n" not in told


def test_every_parameter_is_described_typed_and_as_a_rule_read_only() -> None:
    node = make_node("verification.max_shift_m:=11", "pose_graph.max_gap_s:=3")
    declare(node, RESULTS)
    described = {name: node.describe_parameter(name) for name in documented_names()}
    assert [name for name, found in described.items() if not found.description] == []
    changing = [name for name, found in described.items() if not found.read_only]
    assert "loop.top_k" in changing and all(name.startswith(CHANGEABLE) for name in changing)
    doubles = ["verification.max_shift_m", "pose_graph.max_gap_s", "loop.min_travel_m"]
    assert [described[name].type for name in doubles] == [ParameterType.PARAMETER_DOUBLE] * 3
    assert described["loop.top_k"].type == ParameterType.PARAMETER_INTEGER
    assert described["pose_graph.reject_outliers"].type == ParameterType.PARAMETER_BOOL


def documented_names() -> list[str]:
    """Every parameter that the documentation lists."""
    text = (Path(__file__).parents[2] / "docs" / "parameters.md").read_text()
    names = re.findall(r"^\| `([a-z_.]+)`", text, re.M)
    assert len(names) > 60
    return names


def test_a_running_node_keeps_its_parameters() -> None:
    node = make_node()
    declare(node, RESULTS)
    (answer,) = node.set_parameters([Parameter("embedding.threads", value=3)])
    assert not answer.successful and "read-only" in answer.reason
    assert node.get_parameter("embedding.threads").value == 0


def test_a_topic_can_be_switched_off_with_an_empty_name() -> None:
    settings, _ = declare(make_node("topics.odometry:=''"), RESULTS)
    assert settings.topics.odometry == ""


def test_qos_overrides_of_ros_are_left_to_ros() -> None:
    settings, _ = declare(make_node("qos_overrides./odom.subscription.depth:=3"), RESULTS)
    assert settings == Settings()


def test_a_node_has_parameters_of_its_own() -> None:
    node = make_node("results_dir:=/somewhere", "use_sim_time:=true")
    _, folder = declare(node, RESULTS)
    assert folder == "/somewhere"
    assert node.get_parameter("results_dir").value == "/somewhere"
    assert node.get_parameter("use_sim_time").value is True


def test_changes_are_checked_like_overrides() -> None:
    changed = changed_settings(Settings(), [Parameter("loop.top_k", value=3), Parameter("use_sim_time", value=True)])
    assert changed.loop.top_k == 3
    with pytest.raises(ConfigError, match=r"loop\.top_k: "):
        changed_settings(Settings(), [Parameter("loop.top_k", value=0)])
    assert changed_settings(changed, [Parameter("elsewhere", value=1)]) is changed


def test_ros_itself_refuses_what_is_out_of_range() -> None:
    node = make_node()
    declare(node, RESULTS)
    (answer,) = node.set_parameters([Parameter("verification.min_probability", value=1.5)])
    assert not answer.successful
    (answer,) = node.set_parameters([Parameter("verification.min_probability", value=0.97)])
    assert answer.successful


def test_autostart_is_true_or_false() -> None:
    node = make_node("autostart:=false")
    declare(node, RESULTS)
    assert node.get_parameter("autostart").value is False
    with pytest.raises(ConfigError, match="autostart: expected true or false, got 3"):
        declare(make_node("autostart:=3"), RESULTS)
