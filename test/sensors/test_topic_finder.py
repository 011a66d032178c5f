"""Which topics are taken by the types of their messages, in a graph and in a namespace of it."""

from __future__ import annotations

import pytest

from umf_ros.core.config import TRANSFORMS, Settings, Topics, parse_settings
from umf_ros.core.errors import ConfigError
from umf_ros.sensors.decode import CLOUD, COMPRESSED, IMAGE
from umf_ros.sensors.topic_finder import (
    BACK_END,
    FRONT_END,
    TopicFinder,
    describe_inputs,
    known_dataset,
    must_find,
    with_topics,
)

INFO, ODOMETRY = "sensor_msgs/msg/CameraInfo", "nav_msgs/msg/Odometry"
ROVER = {
    "/velodyne_points": CLOUD,
    "/camera/image_raw": IMAGE,
    "/camera/image_raw/compressed": COMPRESSED,
    "/camera/camera_info": INFO,
    "/odom": ODOMETRY,
    "/loop_closures": ODOMETRY,
    "/pose_graph_node/map_cloud": CLOUD,
    "/imu": "sensor_msgs/msg/Imu",
}


def pair(left: str, right: str) -> dict[str, str]:
    return {f"{camera}/{name}": kind for camera in (left, right) for name, kind in (("image_rect", IMAGE), ("camera_info", INFO))}  # noqa: E501  # fmt: skip


def found_in(types: dict[str, str]) -> Topics:
    return with_topics(Settings(), types).topics


def test_a_lidar_and_a_camera_are_found_by_type_and_its_own_topics_are_none() -> None:
    topics = found_in(ROVER)
    assert topics == Topics(
        left_image="/camera/image_raw",
        right_image="",
        left_info="/camera/camera_info",
        right_info="",
        cloud="/velodyne_points",
        odometry="/odom",
    )


def test_the_best_pictures_of_one_camera_are_taken() -> None:
    images = ("/camera/image_rect_color", "/camera/image_rect", "/camera/image_raw", "/camera/depth/image_raw")
    assert found_in(dict.fromkeys(images, IMAGE)).left_image == "/camera/image_rect"
    only = {"/camera/image_raw/compressed": COMPRESSED, "/camera/camera_info": INFO}
    found = found_in(only)
    assert (found.left_image, found.left_info) == ("/camera/image_raw/compressed", "/camera/camera_info")


def test_two_cameras_are_a_pair_by_their_names_alone() -> None:
    found = found_in(pair("/stereo/right", "/stereo/left"))
    assert (found.left_image, found.right_image) == ("/stereo/left/image_rect", "/stereo/right/image_rect")
    assert (found.left_info, found.right_info) == ("/stereo/left/camera_info", "/stereo/right/camera_info")


@pytest.mark.parametrize(
    ("types", "told"),
    [
        (pair("/front/camera", "/rear/camera"), "left_image: /front/camera/image_rect or /rear/camera/image_rect"),
        (pair("/l/left", "/m/right"), "left_image: /l/left/image_rect or /m/right/image_rect"),
        ({"/a": CLOUD, "/b": CLOUD, "/c": CLOUD}, "cloud: /a, /b or /c"),
        ({"/odom": ODOMETRY, "/icp/odom": ODOMETRY}, "odometry: /icp/odom or /odom"),
        ({"/lidar/signal": IMAGE, "/lidar/range": IMAGE}, "left_image: /lidar/range or /lidar/signal"),
    ],
)
def test_what_is_ambiguous_is_an_error_that_lists_the_candidates(types: dict[str, str], told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        found_in(types)
    assert told in str(caught.value) and "topics.NAME" in str(caught.value) and "\n" not in str(caught.value)


def test_a_camera_with_a_camera_info_goes_before_pictures_of_a_lidar() -> None:
    found = found_in({**ROVER, "/lidar/signal": IMAGE, "/lidar/range": IMAGE})
    assert found.left_image == "/camera/image_raw"


def test_a_parameter_decides_what_is_ambiguous_and_the_rest_is_found() -> None:
    types = {**ROVER, "/other_points": CLOUD}
    settings = parse_settings({"topics": {"cloud": "/other_points", "right_image": ""}})
    assert must_find(settings)
    found = with_topics(settings, types)
    assert (found.topics.cloud, found.topics.odometry) == ("/other_points", "/odom")
    assert found.calibration == TRANSFORMS and found.uses_transforms
    # the back-end has no use for scans: it does not mind that there are two
    assert with_topics(Settings(), types, BACK_END).topics.odometry == "/odom"
    line = describe_inputs(found)
    assert "cloud /other_points" in line and "not found: topics.right_image, topics.right_info" in line
    assert "rig: /tf_static and camera_info (parameter calibration)" in line


def test_what_a_file_names_is_not_looked_for() -> None:
    assert not must_find(parse_settings({"dataset": "s3li-etna"}))
    assert not must_find(parse_settings({"topics": {"odometry": ""}}), BACK_END)
    assert must_find(Settings()) and must_find(Settings(), BACK_END)


def test_a_node_waits_until_nothing_new_is_announced() -> None:
    finder = TopicFinder(Settings(), "/", FRONT_END)
    assert finder.look({"/odom": ODOMETRY}, 0.0) is None
    assert finder.look({"/odom": ODOMETRY}, 60.0) is None  # neither a scanner nor a camera
    assert finder.look(ROVER, 61.0) is None
    assert finder.look(ROVER | {"/late": INFO}, 63.9) is None
    assert finder.look(ROVER | {"/late": INFO}, 66.8) is None
    found = finder.look(ROVER | {"/late": INFO}, 67.0)
    assert found is not None and found.topics.cloud == "/velodyne_points"


@pytest.mark.parametrize(
    ("wanted", "types"),
    [
        (FRONT_END, {"/map_node/map_cloud": CLOUD}),
        (FRONT_END, {"/pose_graph_node/map_cloud": CLOUD, "/odom": ODOMETRY}),
        (FRONT_END, {"/camera/depth/image_rect": IMAGE}),
        (BACK_END, {"/loop_closures": ODOMETRY}),
    ],
)
def test_a_node_waits_for_sensors_beside_topics_that_are_none(wanted: tuple[str, ...], types: dict[str, str]) -> None:
    finder = TopicFinder(Settings(), "/", wanted)
    assert all(finder.look(types, seconds) is None for seconds in (0.0, 60.0, 120.0))
    assert finder.look(types | ROVER, 121.0) is None
    assert finder.look(types | ROVER, 125.0) is not None


def test_a_node_in_a_namespace_takes_the_topics_of_its_robot_alone() -> None:
    robots = {f"/{robot}{topic}": kind for robot in ("red", "blue") for topic, kind in ROVER.items()}
    found = TopicFinder(Settings(), "/red", FRONT_END).look(robots, 0.0, 0.0)
    assert found is not None and found.topics.cloud == "/red/velodyne_points"
    with pytest.raises(ConfigError, match="/blue/odom or /red/odom"):
        TopicFinder(Settings(), "/", BACK_END).look(robots, 0.0, 0.0)


def test_a_data_set_is_recognised_by_its_scans_and_keeps_its_calibration() -> None:
    etna = {"/stereo/left/image_rect": IMAGE, "/bf_lidar/points_raw": CLOUD, "/odom": ODOMETRY}
    red = {f"/red{topic}": kind for topic, kind in etna.items()}
    found = TopicFinder(Settings(), "/red", FRONT_END).look(red, 0.0, 0.0)
    assert found is not None and found.dataset == "s3li-etna" and not found.calibration
    assert "data set s3li-etna" in describe_inputs(found)
    # the images' name alone is anybody's
    other = {"/stereo/left/image_rect": IMAGE, "/points": CLOUD}
    assert known_dataset(other) == "s3li-etna"
    found = TopicFinder(Settings(), "/", FRONT_END).look(other, 0.0, 0.0)
    assert found is not None and found.calibration == TRANSFORMS
