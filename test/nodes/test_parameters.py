from __future__ import annotations

from collections.abc import Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node

from umf_ros.config import Settings, load_settings
from umf_ros.errors import ConfigError
from umf_ros.nodes.parameters import declare

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
    settings, _ = declare(node)
    assert settings == Settings()
    assert node.get_parameter("loop.top_k").value == 20
    descriptor = node.describe_parameter("keyframe.min_translation_m")
    assert "motion" in descriptor.description and descriptor.read_only


def test_overrides_win_and_whole_numbers_pass_for_floats() -> None:
    node = make_node("loop.top_k:=7", "loop.min_time_gap_s:=50", "topics.cloud:=/points")
    settings, _ = declare(node)
    assert (settings.loop.top_k, settings.loop.min_time_gap_s, settings.topics.cloud) == (7, 50.0, "/points")
    assert node.get_parameter("loop.min_time_gap_s").value == 50.0


def test_a_parameter_file_reads_like_for_the_command_line(tmp_path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text("/**:\n  ros__parameters:\n    loop: {top_k: 5}\n    keyframe.min_period_s: 1\n")
    context = Context()
    rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
    node = Node("probe", context=context, automatically_declare_parameters_from_overrides=True)
    made.append((node, context))
    assert declare(node)[0] == load_settings(path)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("loop.topk:=7", "unknown parameter loop.topk"),
        ("loop.top_k:=many", r"loop\.top_k: .*got 'many'"),
        ("loop.min_travel_m:=-1.0", r"loop\.min_travel_m: .*greater than or equal to 0"),
        ("results_dir:=5", "results_dir: expected text, got 5"),
    ],
)
def test_what_is_wrong_is_named(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        declare(make_node(override), results_dir="somewhere")


def test_a_node_has_parameters_of_its_own() -> None:
    node = make_node("results_dir:=/somewhere", "use_sim_time:=true")
    _, own = declare(node, results_dir="where results go")
    assert own == {"results_dir": "/somewhere"}
    assert node.get_parameter("results_dir").value == "/somewhere"
    assert node.get_parameter("use_sim_time").value is True
