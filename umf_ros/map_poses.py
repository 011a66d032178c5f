"""Poses of a map's places, and a pose near them that a person, a parameter or the last run gives: a hypothesis."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from umf_ros.absolute.measurement import parse_numbers
from umf_ros.core.config import Settings
from umf_ros.core.errors import MessageError, UmfError, command_line, one_line
from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, heading, invert, make_pose, rotation_angle
from umf_ros.core.io import write_atomically
from umf_ros.core.limits import open_archive, read_json
from umf_ros.core.trajectory import Trajectory

POSES = "poses.npz"
"""In the folder of a map, its places with a pose: `stamps` (N,) on the map's clock, `poses` (N, 4, 4) `map_T_body`."""
LAST_POSE = "last_pose.json"
"""In a folder of results, the newest pose in the map, for the next start."""
MIN_SIGMAS = np.array([0.5, 0.5, 1.0, 0.2, 0.2, 0.2])
"""Least uncertainty of an initial pose, m and rad, x y z rx ry rz (*by hand*: of a click in rviz; a rover that was
pushed aside while it was off)."""
_NEAR_M, _REACH_M, _TRIED = 4.0, 20.0, 4
_METRES_PER_RAD = 2.0


def read_poses(path: Path) -> Trajectory:
    """Read the poses of a map's places, on the map's clock; raise an `UmfError` if the map has not been solved."""
    try:
        with open_archive(path / POSES), np.load(path / POSES) as stored:
            return Trajectory(stored["stamps"], stored["poses"])
    except Exception as error:  # damaged bytes raise any exception
        cause = one_line(error)
        again = command_line("map", "edit", path)
        raise UmfError(f"{path / POSES} cannot be read ({cause}): solve the map with {again}") from None


class InitialPose(NamedTuple):
    """A pose in the map that the rover may have.

    Attributes:
        map_T_body: (4, 4).
        covariance: (6, 6) in ROS order about the map's axes.
    """

    map_T_body: Array
    covariance: Array

    def __str__(self) -> str:
        x, y = self.map_T_body[:2, 3]
        return f"({x:.1f}, {y:.1f}) m, heading {np.degrees(heading(self.map_T_body)):.0f} deg"


class MapPoses:
    """Poses of the places of a map.

    Args:
        folder: of the map.

    Attributes:
        places: the poses, by the stamps of the places.

    Raises:
        UmfError: the map has not been solved.
    """

    def __init__(self, folder: Path) -> None:
        self.places = read_poses(folder)
        self._mark = zlib.crc32(self.places.poses.tobytes(), zlib.crc32(self.places.stamps_ns.tobytes()))

    def planar(self, x_m: float, y_m: float, heading_rad: float, covariance: Array | None = None) -> InitialPose:
        """Return the pose at a point and heading of the plane, with height and tilt of the nearest place.

        Raises:
            UmfError: the map has no places.
        """
        if not len(self.places):
            raise UmfError("an initial pose needs a map with places")
        away = np.linalg.norm(self.places.poses[:, :2, 3] - (x_m, y_m), axis=1)
        place = self.places.poses[int(away.argmin())]
        turn = heading_rad - float(heading(place))
        cos, sin = np.cos(turn), np.sin(turn)
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ place[:3, :3]
        return _uncertain(make_pose(rotation, [x_m, y_m, place[2, 3]]), covariance)

    def from_message(self, message: Any, frame: str) -> InitialPose:
        """Return the pose of a geometry_msgs/PoseWithCovarianceStamped, of which the plane counts, as of rviz's button.

        Raises:
            MessageError: it is in another frame than the map's, or not finite.
        """
        named, pose = message.header.frame_id.lstrip("/"), message.pose.pose
        if named not in ("", frame):
            raise MessageError("frame", f"initial pose in frame {named!r}: set the fixed frame of rviz to {frame!r}")
        q, covariance = pose.orientation, np.array(message.pose.covariance, float).reshape(6, 6)
        yaw = np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        if not np.isfinite([pose.position.x, pose.position.y, yaw, *covariance.ravel()]).all():
            raise MessageError("pose", "initial pose that is not finite")
        spread = np.diag(covariance.diagonal().clip(0.0))
        return self.planar(pose.position.x, pose.position.y, float(yaw), spread)

    def from_settings(self, settings: Settings) -> InitialPose | None:
        """Return the pose of the parameter; None where it is empty; raise a `ConfigError` if it is none."""
        numbers = parse_numbers(settings.localization.initial_pose, 3, "localization.initial_pose")
        return None if numbers is None else self.planar(numbers[0], numbers[1], float(np.radians(numbers[2])))

    def initial(self, settings: Settings, results: str) -> InitialPose | None:
        """Return the pose of the parameter, or else the last one in a folder of results (empty: none)."""
        given = self.from_settings(settings)
        return given if given is not None or not results else self.read_last(Path(results))

    def read_last(self, folder: Path) -> InitialPose | None:
        """Return the last pose in a folder of results; None where there is none in this map as it is now."""
        with suppress(OSError, ValueError, LookupError, TypeError):
            stored = read_json(folder / LAST_POSE)
            pose, spread = np.array(stored["map_T_body"], float), np.array(stored["covariance"], float)
            finite = np.isfinite(pose).all() and np.isfinite(spread).all()
            if stored["map"] == self._mark and finite and (pose.shape, spread.shape) == ((4, 4), (6, 6)):
                return _uncertain(pose, spread)
        return None

    def write_last(self, folder: Path, known: InitialPose) -> None:
        """Keep a verified pose for the next start; raise an `OutputError` if it cannot be written."""
        content = {"map": self._mark, "map_T_body": known.map_T_body.tolist(), "covariance": known.covariance.tolist()}
        write_atomically(folder / LAST_POSE, json.dumps(content) + "\n")


def _uncertain(pose: Array, covariance: Array | None) -> InitialPose:
    """Return a pose that is at least as uncertain as any initial pose."""
    spread = np.diag(MIN_SIGMAS**2)
    return InitialPose(pose, spread if covariance is None else spread + covariance)


class PoseHint:
    """Places near an initial pose, which odometry carries along, to be verified like all others.

    Args:
        places: poses of the map's places, by their stamps.
        initial: where the rover may be at the next keyframe.
    """

    def __init__(self, places: Trajectory, initial: InitialPose) -> None:
        self._places, self._initial = places, initial
        self._first: Keyframe | None = None

    def near(self, keyframe: Keyframe) -> dict[int, Array]:
        """Return `match_T_query` (4, 4) by the stamps of the nearest places; empty where nothing is known any more."""
        first = self._first = self._first or keyframe
        pose = self._initial.map_T_body
        if first is not keyframe:
            step = first.pose_of(keyframe)
            if step is None or keyframe.path_length_m - first.path_length_m > _REACH_M:
                return {}
            pose = pose @ step
        reach_m = _NEAR_M + 2 * float(np.sqrt(self._initial.covariance[:2, :2].trace() / 2))
        steps = invert(self._places.poses) @ pose
        rows = np.flatnonzero(np.linalg.norm(steps[:, :3, 3], axis=1) < reach_m).tolist()
        rows.sort(key=lambda row: np.linalg.norm(steps[row, :3, 3]) + _METRES_PER_RAD * rotation_angle(steps[row]))
        return {int(self._places.stamps_ns[row]): steps[row] for row in rows[:_TRIED]}


def hint_of(settings: Settings) -> Callable[[Keyframe], dict[int, Array]] | None:
    """Return the places near the initial pose of the settings; None where they name none."""
    known = MapPoses(Path(settings.map))
    initial = known.from_settings(settings)
    return None if initial is None else PoseHint(known.places, initial).near
