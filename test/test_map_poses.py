"""Initial poses: of a person, of the last run, and the places of the map near them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import make_frame
from geometry_msgs.msg import PoseWithCovarianceStamped
from maps_made import MadeSession, made_map, on_circle

from umf_ros.core.config import load_settings
from umf_ros.core.errors import ConfigError, MessageError
from umf_ros.core.frames import Embedding, Keyframe
from umf_ros.core.geometry import Array, heading, make_pose, relative
from umf_ros.detector import assemble
from umf_ros.map_poses import LAST_POSE, InitialPose, MapPoses, PoseHint
from umf_ros.maps.joint_graph import solve
from umf_ros.maps.outputs import write_results


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = made_map(tmp_path_factory.mktemp("maps") / "map", [MadeSession("one", 0, 40)])
    write_results(made, solve(made))
    return made.path


@pytest.fixture(scope="module")
def known(folder: Path) -> MapPoses:
    return MapPoses(folder)


def keyframe(odometry: Array | None, path_m: float = 0.0, session: int = 0) -> Keyframe:
    return assemble(make_frame(1.0, odometry, session), Embedding(np.ones(1, np.float32)), path_m, session)


def test_a_click_has_height_and_tilt_of_the_nearest_place_and_the_uncertainty_of_a_click(known: MapPoses) -> None:
    x, y, z = known.places.poses[20][:3, 3]
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "map"
    message.pose.pose.position.x, message.pose.pose.position.y = x + 0.2, y
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = np.sin(0.5), np.cos(0.5)
    message.pose.covariance[0] = 4.0
    found = known.from_message(message, "map")
    assert np.allclose(found.map_T_body[:3, 3], [x + 0.2, y, z])
    assert float(heading(found.map_T_body)) == pytest.approx(1.0)
    assert found.covariance[0, 0] > 4 and 0 < found.covariance[1, 1] < 1 and found.covariance[2, 2] > 0.5
    message.header.frame_id = "odom"
    with pytest.raises(MessageError, match="fixed frame of rviz"):
        known.from_message(message, "map")
    message.header.frame_id, message.pose.pose.position.x = "map", np.nan
    with pytest.raises(MessageError, match="not finite"):
        known.from_message(message, "map")


def test_the_parameter_is_three_numbers(known: MapPoses, folder: Path) -> None:
    chosen = {"mode": "localization", "map": str(folder)}
    found = known.initial(load_settings(**chosen, localization__initial_pose="3.0, -2, 90"), "")
    assert found is not None and str(found) == "(3.0, -2.0) m, heading 90 deg"
    assert known.initial(load_settings(**chosen), "") is None
    with pytest.raises(ConfigError, match=r"localization.initial_pose: expected 3 numbers"):
        known.initial(load_settings(**chosen, localization__initial_pose="3, 4"), "")


def test_the_last_pose_is_of_this_map_or_none(known: MapPoses, tmp_path: Path) -> None:
    assert known.read_last(tmp_path) is None
    pose, spread = on_circle(np.array([12.0]))[0], np.diag([1.0, 2.0, 3.0, 0.1, 0.1, 0.2])
    known.write_last(tmp_path, InitialPose(pose, spread))
    found = known.read_last(tmp_path)
    assert found is not None and np.array_equal(found.map_T_body, pose)
    assert (found.covariance.diagonal() > spread.diagonal()).all()
    other = made_map(tmp_path / "other", [MadeSession("one", 0, 41)])
    write_results(other, solve(other))
    assert MapPoses(other.path).read_last(tmp_path) is None  # that of another map says nothing
    for damaged in ("", "{}", "[1]", (tmp_path / LAST_POSE).read_text()[:-20]):
        (tmp_path / LAST_POSE).write_text(damaged)
        assert known.read_last(tmp_path) is None


def test_places_near_a_hint_move_with_the_odometry_and_end_with_it(known: MapPoses) -> None:
    def hint() -> PoseHint:
        return PoseHint(known.places, InitialPose(known.places.poses[10], np.diag([0.01] * 6)))

    one = hint()
    first = one.near(keyframe(np.eye(4)))
    assert len(first) == 4 and next(iter(first)) == known.places.stamps_ns[10]
    step = relative(known.places.poses[10], known.places.poses[15])
    there = one.near(keyframe(step, 5.0))
    nearest, pose = next(iter(there.items()))
    assert nearest == known.places.stamps_ns[15] and np.allclose(pose, np.eye(4), atol=1e-6)
    assert not one.near(keyframe(step, 25.0)) and not one.near(keyframe(step, 5.0, session=1))
    assert not one.near(keyframe(None))
    away = InitialPose(known.places.poses[10] @ make_pose(np.eye(3), [0, 0, 200.0]), np.eye(6))
    assert not PoseHint(known.places, away).near(keyframe(np.eye(4)))
