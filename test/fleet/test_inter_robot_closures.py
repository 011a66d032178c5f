from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import unit
from fleets import IDENTITY, rover_places, settings
from submaps_drives import Drive, rough_ground
from submaps_drives import drive as drive_lidar

from benchmarks.accuracy.postgres import PostgresServer
from umf_ros.core.config import Settings, Verification
from umf_ros.core.errors import ConfigError
from umf_ros.core.frames import Embedding, Keyframe
from umf_ros.core.geometry import Array, relative, rotation_angle
from umf_ros.detector import LoopDetector
from umf_ros.fleet.inter_robot_closures import InterRobotClosure, InterRobotMatcher
from umf_ros.lab.simulation.scenes import landscape, pose_at, take
from umf_ros.submaps.history import SubmapHistory
from umf_ros.verification import RejectReason

GROUND = landscape(20)
PLACES_M = (-24.0, -14.0)
"""Two places that both rovers come by."""


def seen(pose: Array, second: float, place: int, path_length_m: float) -> Keyframe:
    """A keyframe whose descriptor says which place it is; its odometry is the truth."""
    keyframe = take(GROUND, pose, second)
    descriptor = unit(np.eye(IDENTITY[1])[place] + 0.01)
    embedding = replace(keyframe.embedding, descriptor=descriptor)
    return replace(keyframe, embedding=embedding, odom_T_body=pose, path_length_m=path_length_m)


def poses_of(rover: str) -> list[Array]:
    if rover == "bea":
        return [pose_at(GROUND, x - 1.0, 0.0, 0.0) for x in PLACES_M]
    return [pose_at(GROUND, x, 1.2, 6.0, 2.0) for x in PLACES_M]


def drive(server: PostgresServer, rover: str, later: Verification | None = None) -> list[InterRobotClosure]:
    """Both places by one rover, whose clock says the same as the other's; what it made of the other's places.

    With other settings after the first place.
    """
    places = rover_places(server, rover)
    inter_robot = InterRobotMatcher(Settings(database=settings(server, rover)), SubmapHistory(places.store), IDENTITY)
    found: list[InterRobotClosure] = []
    for place, pose in enumerate(poses_of(rover)):
        inter_robot.link.enqueue(places.add(seen(pose, 10.0 * place, place, 10.0 * place)))
        if later is not None and place == 0:
            found += inter_robot.finish(60)
            inter_robot.retune(later)
    found += inter_robot.finish(60)
    inter_robot.link.close()
    places.close()
    return found


def test_settings_that_are_changed_hold_between_rovers_too(server: PostgresServer) -> None:
    drive(server, "bea")
    first, second = drive(server, "ada", later=Verification(min_probability=0.9999))
    assert any(one.closure is not None for one in first.verdicts)
    assert {one.reason for one in second.verdicts if one.probability} == {RejectReason.IMPROBABLE}


def test_two_rovers_at_two_common_places_get_closures(server: PostgresServer) -> None:
    assert drive(server, "bea") == []
    first, second = drive(server, "ada")
    assert (first.own, first.robot) == ("ada", "bea")
    # one place alone is not enough: it may only look like another
    waiting = [one.reason for one in first.verdicts if one.closure is not None]
    assert first.closures == [] and waiting == [RejectReason.UNCONFIRMED]
    assert len(second.closures) == 2
    for closure, ours, theirs in zip(second.closures, poses_of("ada"), poses_of("bea"), strict=True):
        error = relative(relative(theirs, ours), closure.match_T_query)
        assert np.linalg.norm(error[:3, 3]) < 0.1 and rotation_angle(error) < 0.01


def narrow_drive(
    server: PostgresServer, rover: str, outing: Drive, rows: range, descriptors: Array
) -> list[InterRobotClosure]:
    """A part of the way there and back, driven by a rover with a narrow LiDAR; odometry and clock begin anew."""
    places = rover_places(server, rover)
    history = SubmapHistory(places.store)
    inter_robot = InterRobotMatcher(Settings(database=settings(server, rover)), history, IDENTITY)
    start = outing.keyframes[rows[0]]
    assert start.odom_T_body is not None
    for row in rows:
        one = outing.keyframes[row]
        assert one.odom_T_body is not None
        keyframe = replace(
            one,
            stamp_ns=one.stamp_ns - start.stamp_ns,
            embedding=Embedding(descriptors[row]),
            odom_T_body=relative(start.odom_T_body, one.odom_T_body),
            path_length_m=one.path_length_m - start.path_length_m,
        )
        inter_robot.link.enqueue(places.add(keyframe))
        history.add(keyframe)
    found = list(inter_robot.finish(120))
    inter_robot.link.close()
    places.close()
    return found


def test_rovers_with_narrow_lidars_that_drive_in_opposite_directions_get_closures(server: PostgresServer) -> None:
    outing = drive_lidar(rough_ground(5), out_m=27.0)
    half = len(outing.keyframes) // 2
    there = np.array([pose[0, 3] for pose in outing.truth])
    circle = np.pi * there / there.max()  # alike where they are near
    descriptors = np.zeros((len(there), IDENTITY[1]), np.float32)
    descriptors[:, :2] = np.column_stack([np.cos(circle), np.sin(circle)])
    assert narrow_drive(server, "bea", outing, range(half), descriptors) == []
    first = outing.keyframes[half].stamp_ns
    true = {one.stamp_ns: pose for one, pose in zip(outing.keyframes, outing.truth, strict=True)}
    closures = [
        closure
        for found in narrow_drive(server, "ada", outing, range(half, 2 * half), descriptors)
        for closure in found.closures
    ]
    assert len(closures) > half // 4
    for closure in closures:
        expected = relative(true[closure.match_stamp_ns], true[closure.query_stamp_ns + first])
        assert np.linalg.norm(relative(expected, closure.match_T_query)[:3, 3]) < 0.5


def test_a_fleet_needs_a_server() -> None:
    class Nobody:
        name, dimension = "none", 16

    with pytest.raises(ConfigError, match=r"postgres needs database\.server"):
        LoopDetector(Settings(database={"backend": "postgres"}), Nobody())
