"""Checks of a launch before it starts anything."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from umf_ros.core.errors import ConfigError
from umf_ros.nodes.start import check_parameter_file, full_name, is_true

NODES = ["/red/loop_closure_node", "/red/pose_graph_node"]
INNER = "ros__parameters: {loop.top_k: 7}"


@pytest.mark.parametrize(
    "text",
    [
        f"/**: {{{INNER}}}",
        f"/red/loop_closure_node: {{{INNER}}}",
        f"red/pose_graph_node: {{{INNER}}}",
        f"red: {{pose_graph_node: {{{INNER}}}}}",
        f"/*/pose_graph_node: {{{INNER}}}",
        f"/**/loop_closure_node: {{{INNER}}}",
        f"camera_driver: {{{INNER}}}\n/red/*: {{{INNER}}}",
    ],
)
def test_a_file_that_is_for_one_of_the_nodes_is_fine(text: str, tmp_path: Path) -> None:
    path = tmp_path / "rover.yaml"
    path.write_text(text)
    check_parameter_file(path, NODES)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "but no ros__parameters at all ('/**' is for all)"),
        ("/**: {loop.top_k: 7}", "but no ros__parameters at all"),
        # outside of every namespace, as ROS reads it
        (f"loop_closure_node: {{{INNER}}}", "but /loop_closure_node ('/**' is for all)"),
        (f"/blue/loop_closure_node: {{{INNER}}}", "but /blue/loop_closure_node"),
        (f"/*: {{{INNER}}}\n/**/loop_closure: {{{INNER}}}", "but /*, /**/loop_closure"),
        ("/**: [1, 2", "is not valid YAML"),
    ],
)
def test_a_file_that_is_for_nobody_is_refused(text: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "rover.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        check_parameter_file(path, NODES)
    assert told in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "rover.yaml"):
        with pytest.raises(ConfigError, match=f"params_file: there is no {path}"):
            check_parameter_file(path, NODES)


@pytest.mark.parametrize("namespace", ["red", "/red", "red/", "/red/"])
def test_a_namespace_may_have_slashes_or_not(namespace: str) -> None:
    assert full_name(namespace, "loop_closure_node") == NODES[0]


def test_without_a_namespace_a_node_is_at_the_root() -> None:
    assert full_name("", "pose_graph_node") == "/pose_graph_node"


def test_what_is_neither_true_nor_false_is_refused() -> None:
    assert is_true("rviz", "True") and not is_true("rviz", "false")
    with pytest.raises(ConfigError, match="rviz: true or false, not 'perhaps'"):
        is_true("rviz", "perhaps")


def test_the_python_of_the_system_can_load_it() -> None:
    """It has the modules of ROS and YAML, but none of those in the venv of the nodes."""
    heavy = "{'numpy', 'pydantic', 'torch', 'rclpy', 'cv2'}"
    code = f"import sys, umf_ros.nodes.start; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
