from __future__ import annotations

import itertools

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation

from umf_ros.core.config import FrameIds
from umf_ros.core.errors import MessageError
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import make_pose
from umf_ros.nodes import conversions
from umf_ros.nodes.conversions import Odometry, closure_from_message, closure_to_message


def random_closure(rng: np.random.Generator) -> LoopClosure:
    root = rng.standard_normal((6, 6))
    pose = make_pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 5, 3))
    return LoopClosure(1_667_000_000_123_456_789, 1_666_999_999_000_000_001, pose, root @ root.T)


def test_a_closure_survives_the_wire(rng: np.random.Generator) -> None:
    closure = random_closure(rng)
    wire = serialize_message(closure_to_message(closure))
    found = closure_from_message(deserialize_message(wire, Odometry))
    assert (found.query_stamp_ns, found.match_stamp_ns) == (closure.query_stamp_ns, closure.match_stamp_ns)
    np.testing.assert_allclose(found.match_T_query, closure.match_T_query, atol=1e-12)
    np.testing.assert_array_equal(found.covariance, closure.covariance)
    assert np.isnan(found.probability)  # it does not travel: the back-end must not claim one


def test_the_message_names_its_ends_as_documented(rng: np.random.Generator) -> None:
    message = closure_to_message(random_closure(rng))
    assert message.header.frame_id == "keyframe/1666999999000000001"
    assert message.child_frame_id == "keyframe/1667000000123456789"
    assert conversions.from_time(message.header.stamp) == 1_667_000_000_123_456_789
    assert message.twist.covariance[0] == -1.0


NO_STAMPS = ["keyframe/" + "9" * 5000, "keyframe/" + "9" * 19, "keyframe/\u0661\u0662", "keyframe/-1"]


@pytest.mark.parametrize("frame", ["", "odom", "keyframe/", "keyframe/12a", "xkeyframe/12", *NO_STAMPS])
def test_foreign_frames_are_refused(rng: np.random.Generator, frame: str) -> None:
    message = closure_to_message(random_closure(rng))
    message.child_frame_id = frame
    with pytest.raises(MessageError, match="expected keyframe/<stamp in ns>"):
        closure_from_message(message)


def test_a_pose_that_is_none_is_refused(rng: np.random.Generator) -> None:
    message = closure_to_message(random_closure(rng))
    message.pose.pose.position.x = float("nan")
    with pytest.raises(MessageError, match="not finite"):
        closure_from_message(message)
    message = closure_to_message(random_closure(rng))
    message.pose.pose.orientation.w = 4.0
    with pytest.raises(MessageError, match="not a unit quaternion"):
        closure_from_message(message)


@pytest.mark.parametrize("frame", NO_STAMPS)
def test_a_pair_to_reject_has_stamps_that_a_message_can_carry(frame: str) -> None:
    assert conversions.parse_pair("keyframe/1 keyframe/2") == (1, 2)
    with pytest.raises(MessageError, match="expected 'keyframe/<match ns> keyframe/<query ns>'"):
        conversions.parse_pair(f"{frame} keyframe/2")


def test_the_poses_of_a_long_path_stay_in_longer_ones() -> None:
    rng = np.random.default_rng(0)
    stamps = np.cumsum(rng.integers(1, 10**9, 9000))
    found = []
    for count in (1, 2, 1999, 2000, 2001, 5000, 9000):
        message = conversions.path(stamps[:count], np.tile(np.eye(4), (count, 1, 1)), FrameIds())
        found.append([conversions.from_time(pose.header.stamp) for pose in message.poses])
        assert len(found[-1]) <= conversions.MAX_POSES and found[-1][-1] == stamps[count - 1]
        assert len(found[-1]) == count or len(found[-1]) > conversions.MAX_POSES / 4
    for earlier, later in itertools.pairwise(found):
        assert {stamp for stamp in later if stamp < earlier[-1]} <= set(earlier)
