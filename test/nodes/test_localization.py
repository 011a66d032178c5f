"""The live back-end in mode localization over real DDS: a rover that wakes up in a map that is there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from live_peers import Peer, odometry
from maps_made import COVARIANCE, MadeSession, made_map, on_circle
from nav_msgs.msg import Odometry
from processes import Process, wait_until
from rclpy.qos import qos_profile_sensor_data

from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import relative
from umf_ros.map_poses import LAST_POSE, read_poses
from umf_ros.maps.joint_graph import solve
from umf_ros.maps.outputs import write_results
from umf_ros.nodes.conversions import CLOSURES_QOS, closure_to_message, to_pose, to_time
from umf_ros.sensors.decode import decode_pose

MODULE = "umf_ros.nodes.pose_graph_node"
LATER_NS = 1_800_000_000 * 10**9
STEP_NS = 500_000_000


class Rover(Peer):
    """Odometry from an origin of its own, closures with the map, and ears."""

    def __init__(self) -> None:
        super().__init__("pose_graph_node", "pose graph")
        self.odometry = self.create_publisher(Odometry, "/odom", 50)
        self.closures = self.create_publisher(Odometry, "/loop_closures", CLOSURES_QOS)
        self.hear(PoseWithCovarianceStamped, "pose", qos_profile_sensor_data)
        self.hear(TransformStamped, "map_to_odom", qos_profile_sensor_data)
        self.poses, self.transforms = self.heard["pose"], self.heard["map_to_odom"]

    def moved(self, stamp_ns: int, pose: np.ndarray) -> None:
        self.odometry.publish(odometry(stamp_ns, pose))


@pytest.fixture
def rover(ros_context: None) -> Iterator[Rover]:
    node = Rover()
    yield node
    node.destroy_node()


@pytest.fixture(scope="module")
def map_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = made_map(tmp_path_factory.mktemp("maps") / "map", [MadeSession("one", 0, 90)])
    write_results(folder, solve(folder))
    return folder.path


def test_pose_and_transform_come_once_the_rover_is_found(rover: Rover, map_folder: Path, tmp_path: Path) -> None:
    poses = read_poses(map_folder)
    process = Process(
        MODULE, tmp_path / "node.log", "mode:=localization", f"map:={map_folder}", f"results_dir:={tmp_path / 'out'}"
    )
    process.wait_for("ready")
    rover.wait_for(lambda: rover.odometry.get_subscription_count() and rover.closures.get_subscription_count())
    rover.wait_for(lambda: rover.message.startswith("not localised"))
    rover.wait_for(lambda: rover.values["failure_category"] == "stale_odometry")
    first = on_circle(np.array([30.0]))[0]
    for step in range(30):
        stamp, here = LATER_NS + step * STEP_NS, on_circle(np.array([30 + step / 2]))[0]
        rover.moved(stamp, relative(first, here))
        if step == 4:
            wait_until(lambda: False, 0.5, rover.spin)
            assert not rover.poses and not rover.transforms  # nothing is claimed before it is known
            rover.wait_for(lambda: rover.values["failure_category"] == "weak_overlap")
        if step % 2 == 0:
            row = 30 + step // 2
            match_T_query = relative(on_circle(np.array([row]))[0], here)
            closure = LoopClosure(stamp, int(poses.stamps_ns[row]), match_T_query, COVARIANCE, 0.99)
            rover.closures.publish(closure_to_message(closure))
        wait_until(lambda: False, 0.05, rover.spin)
    stamp = LATER_NS + 30 * STEP_NS
    rover.moved(stamp, relative(first, on_circle(np.array([45.0]))[0]))
    rover.wait_for(lambda: rover.poses and rover.poses[-1].header.stamp == to_time(stamp))
    assert rover.poses[-1].header.frame_id == "map"
    found = decode_pose(rover.poses[-1].pose.pose)
    assert np.linalg.norm(found[:3, 3] - poses.poses[45][:3, 3]) < 0.3
    covariance = np.array(rover.poses[-1].pose.covariance).reshape(6, 6)
    assert 0 < covariance[0, 0] < 0.1
    rover.wait_for(lambda: float(rover.values.get("probability", 0)) > 0.99)
    assert rover.message.startswith("in the map")
    rover.call("reset")
    rover.wait_for(lambda: rover.message.startswith("not localised"))
    assert process.interrupt() == 0
    assert (tmp_path / "out" / "trajectory_in_map.tum").is_file()


def test_a_click_in_rviz_and_the_last_pose_are_poses_with_one_closure(
    rover: Rover, map_folder: Path, tmp_path: Path
) -> None:
    click = rover.create_publisher(PoseWithCovarianceStamped, "/initialpose", 1)
    poses, stamp, out = read_poses(map_folder), LATER_NS + 10**12, f"results_dir:={tmp_path / 'out'}"
    for is_restart in (False, True):
        process = Process(MODULE, tmp_path / "node.log", "mode:=localization", f"map:={map_folder}", out)
        process.wait_for("ready")
        rover.wait_for(lambda: rover.odometry.get_subscription_count() and click.get_subscription_count())
        rover.poses.clear()
        here = on_circle(np.array([30]))[0]
        if not is_restart:
            message = PoseWithCovarianceStamped()
            message.pose.pose, message.header.frame_id = to_pose(here), "elsewhere"
            click.publish(message)
            rover.wait_for(lambda: "set the fixed frame of rviz to 'map'" in process.output)  # noqa: B023
            message.header.frame_id = "map"
            click.publish(message)
        for step in range(12):  # some centimetres are driven
            stamp, now = stamp + STEP_NS, on_circle(np.array([30 + 0.03 * step]))[0]
            rover.moved(stamp, relative(here, now))
            wait_until(lambda: False, 0.1, rover.spin)
            if step == 6:
                assert not rover.poses  # a hint alone is no pose
                closure = LoopClosure(stamp, int(poses.stamps_ns[30]), relative(here, now), COVARIANCE, 0.95)
                rover.closures.publish(closure_to_message(closure))
        rover.wait_for(lambda: rover.poses)
        found = decode_pose(rover.poses[-1].pose.pose)
        assert np.linalg.norm(found[:3, 3] - poses.poses[30][:3, 3]) < 0.5
        rover.wait_for(lambda: (tmp_path / "out" / LAST_POSE).is_file())
        process.kill()  # what is kept survives that


def test_a_map_that_is_none_is_told_in_one_line(tmp_path: Path) -> None:
    process = Process(MODULE, tmp_path / "node.log", "mode:=localization", f"map:={tmp_path}", "dataset:=simulated")
    assert wait_until(lambda: process.exit_code is not None, 60.0) and process.exit_code == 1
    assert "solve the map with umf map edit" in (tmp_path / "node.log").read_text()
