"""Bridges to other SLAM systems, on messages made from the text of their definitions."""

from __future__ import annotations

import importlib.util
import re
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from recordings import START_NS, odometry
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation
from sources import ROOT, run

from umf_ros.core.geometry import make_pose, relative

EXAMPLES = ROOT / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def store() -> Any:
    made = get_typestore(Stores.ROS2_JAZZY)
    found: dict[str, Any] = {}
    for path in sorted((EXAMPLES / "definitions").glob("*.msg")):
        package, name = path.name.removesuffix(".msg").split(".")
        found |= get_types_from_msg(path.read_text(), f"{package}/msg/{name}")
    made.register(found)
    return made


def closure(match_ns: int, query_ns: int, pose: np.ndarray) -> Any:
    message = odometry(query_ns, pose)
    message.header.frame_id, message.child_frame_id = f"keyframe/{match_ns}", f"keyframe/{query_ns}"
    message.pose.covariance = np.diag([1.0, 4, 9, 0.1, 0.2, 0.3]).ravel()
    return message


def pose_at(second: float) -> np.ndarray:
    return make_pose(Rotation.from_euler("z", 0.2 * second).as_matrix(), [second, 0.1 * second, 0])


def test_an_edge_for_kimera_says_what_the_closure_says(store: Any) -> None:
    names = {name.rpartition("/")[2]: kind for name, kind in store.types.items() if "pose_graph_tools" in name}
    message = closure(START_NS, START_NS + 60 * 10**9, pose_at(1.5))
    graph = example("kimera_bridge").to_pose_graph(message, 3, SimpleNamespace(**names))
    (edge,) = graph.edges
    assert (edge.key_from, edge.key_to, edge.type, edge.robot_to) == (START_NS, START_NS + 60 * 10**9, 1, 3)
    raw = store.serialize_cdr(graph, graph.__msgtype__)
    again = store.deserialize_cdr(raw, graph.__msgtype__).edges[0]
    assert again.pose.position.x == 1.5 and again.covariance[7] == 4


def test_a_link_for_rtabmap_is_carried_to_its_nodes(store: Any) -> None:
    module = example("rtabmap_bridge")
    links = module.Links()
    kinds = {"Link": "rtabmap_msgs/msg/Link"} | {
        name: f"geometry_msgs/msg/{name}" for name in ("Transform", "Vector3", "Quaternion")
    }
    types = SimpleNamespace(**{name: store.types[kind] for name, kind in kinds.items()})
    start, end = START_NS, START_NS + 60 * 10**9
    message = closure(start, end, relative(pose_at(0), pose_at(60)))
    assert links.link(message, types) is None
    for tenth in range(-5, 610):
        links.add_odometry(start + tenth * 10**8, odometry(start, pose_at(tenth / 10)).pose.pose)
    links.add_node(start + 4 * 10**8, 7)
    assert links.link(message, types) is None
    links.add_node(end - 3 * 10**8, 42)
    link = links.link(message, types)
    assert (link.from_id, link.to_id, link.type) == (7, 42, 4)
    truth = relative(pose_at(0.4), pose_at(59.7))
    shift, turn = link.transform.translation, link.transform.rotation
    np.testing.assert_allclose([shift.x, shift.y, shift.z], truth[:3, 3], atol=1e-9)
    found = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    np.testing.assert_allclose(found, truth[:3, :3], atol=1e-9)
    np.testing.assert_allclose(np.linalg.eigvalsh(link.information.reshape(6, 6))[[0, -1]], [1 / 9, 10], atol=1e-9)
    assert store.serialize_cdr(link, "rtabmap_msgs/msg/Link")


@pytest.mark.parametrize(
    ("name", "missing", "remedy"),
    [
        ("kimera_bridge", "pose_graph_tools_msgs", "MIT-SPARK/pose_graph_tools"),
        ("rtabmap_bridge", "rtabmap_msgs", "ros-jazzy-rtabmap-msgs"),
        ("slam_subscriber", "nav_msgs", "/opt/ros/jazzy/setup.bash"),
    ],
)
def test_one_line_names_the_message_package_that_is_missing(name: str, missing: str, remedy: str) -> None:
    path = str(EXAMPLES / f"{name}.py")
    code = f"import runpy, sys; sys.modules[{missing!r}] = None; runpy.run_path({path!r}, run_name='__main__')"
    done = run(sys.executable, "-c", code)
    assert done.returncode == 1
    assert re.fullmatch(rf"{name}: {missing} is not installed: .*{remedy}.*\n", done.stderr)


@pytest.mark.parametrize("bridge", ["kimera_bridge", "rtabmap_bridge"])
def test_closures_between_rovers_are_left_to_those_who_know_both(bridge: str) -> None:
    message = closure(START_NS, START_NS + 60 * 10**9, pose_at(1.5))
    assert example(bridge).is_own(message)
    message.header.frame_id = f"keyframe/red/{START_NS}"
    assert not example(bridge).is_own(message)
