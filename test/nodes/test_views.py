"""Views of RViz and Foxglove show topics that the nodes publish, in the frame that needs no transform."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
import yaml
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy
from sources import ROOT

from umf_ros.core.config import FrameIds, Topics
from umf_ros.nodes.loop_closure_node import ClosurePublisher
from umf_ros.nodes.map_node import MapNode
from umf_ros.nodes.pose_graph_node import PoseGraphNode

LATCHED = QoSDurabilityPolicy.TRANSIENT_LOCAL
SHOWN_AS = {
    "rviz_default_plugins/Path": "Path",
    "rviz_default_plugins/MarkerArray": "MarkerArray",
    "rviz_default_plugins/PoseWithCovariance": "PoseWithCovarianceStamped",
    "rviz_default_plugins/Image": "Image",
    "rviz_default_plugins/Map": "OccupancyGrid",
    "rviz_default_plugins/PointCloud2": "PointCloud2",
}


@pytest.fixture
def published(ros_context: None) -> Iterator[dict[str, tuple[str, bool]]]:
    """Every topic, with its type and whether it is latched."""
    back, ground, front = PoseGraphNode(), MapNode(), Node("loop_closure_node")
    ClosurePublisher(front, FrameIds())
    made = [*back.publishers, *ground.publishers, *front.publishers]
    topics = {item.topic_name: (item.msg_type.__name__, item.qos_profile.durability == LATCHED) for item in made}
    yield topics | {Topics().left_image: ("Image", False)}
    for node in (back, ground):
        node.close()
    for node in (back, ground, front):
        node.destroy_node()


def test_rviz_shows_what_is_there(published: dict[str, tuple[str, bool]]) -> None:
    manager = yaml.safe_load((ROOT / "config" / "loop_closure.rviz").read_text())["Visualization Manager"]
    shown = [display for display in manager["Displays"] if "Topic" in display]
    assert len(shown) >= 7
    for display in shown:
        topic = display["Topic"]
        assert topic["Value"][0] != "/", "relative: RViz runs in the namespace of the nodes"
        kind, latched = published[f"/{topic['Value']}"]
        assert kind == SHOWN_AS[display["Class"]]
        assert (topic.get("Durability Policy") == "Transient Local") == latched, topic
    assert manager["Global Options"]["Fixed Frame"] == FrameIds().map


def test_foxglove_shows_what_is_there(published: dict[str, tuple[str, bool]]) -> None:
    panels = json.loads((ROOT / "config" / "foxglove_layout.json").read_text())["configById"]
    names = set(panels["3D!umf_map"]["topics"]) | {path["value"] for path in panels["Plot!umf_probability"]["paths"]}
    names |= {panels["Image!umf_left"]["imageMode"]["imageTopic"], panels["RawMessages!umf_closures"]["topicPath"]}
    names.add(panels["DiagnosticSummary!umf"]["topicToRender"])
    assert {name.partition(".")[0] for name in names} <= set(published)
