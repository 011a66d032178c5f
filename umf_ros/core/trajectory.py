"""Poses over time and graphs of poses, and their text formats."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from umf_ros.core.errors import writing
from umf_ros.core.geometry import Array, from_enu, interpolate, to_quaternion, transform
from umf_ros.core.io import write_atomically

MAX_GAP_S = 2.0
"""Longest gap that poses are interpolated across."""


def bracket(
    known_ns: NDArray[np.int64], stamps_ns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return rows (K,) before and after each stamp among sorted known stamps, and its fraction (K,) between, 0 to 1.

    Both rows are the same where a stamp is known or before the first one.
    """
    after = np.clip(np.searchsorted(known_ns, stamps_ns), 0, len(known_ns) - 1)
    before = np.where(known_ns[after] == stamps_ns, after, np.maximum(after - 1, 0))
    span = np.maximum(known_ns[after] - known_ns[before], 1)
    return before, after, np.clip((stamps_ns - known_ns[before]) / span, 0.0, 1.0)


def interpolated(known_ns: NDArray[np.int64], poses: Array, stamps_ns: NDArray[np.int64]) -> Array:
    """Return poses (K, 4, 4) at stamps between sorted known ones, of (N, 4, 4) poses; held constant outside.

    Positions are interpolated linearly, rotations along the shortest arc.
    """
    before, after, share = bracket(known_ns, stamps_ns)
    found, between = poses[before], np.flatnonzero(share)
    if len(between):
        found[between] = interpolate(found[between], poses[after[between]], share[between])
    return found


@dataclass(frozen=True)
class Trajectory:
    """Poses over time, in a fixed frame of its own.

    Attributes:
        stamps_ns: (N,) int64, increasing.
        poses: (N, 4, 4) `world_T_body`; rotations are the identity where they are unknown.
        has_orientation: whether the rotations are known.
    """

    stamps_ns: NDArray[np.int64]
    poses: Array
    has_orientation: bool = True

    @classmethod
    def rising(cls, samples: Iterable[tuple[int, Array]]) -> Trajectory | None:
        """Return the stamped poses (4, 4) that are later than all before them; None without any."""
        kept: list[tuple[int, Array]] = []
        for stamp_ns, pose in samples:
            if not kept or stamp_ns > kept[-1][0]:
                kept.append((stamp_ns, pose))
        if not kept:
            return None
        return cls(np.array([stamp for stamp, _ in kept], np.int64), np.stack([pose for _, pose in kept]))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def at(self, stamps_ns: NDArray[np.int64], max_gap_s: float = MAX_GAP_S) -> tuple[Array, NDArray[np.bool_]]:
        """Return the interpolated (K, 4, 4) poses at (K,) stamps, and (K,) whether each is known.

        Positions are interpolated linearly, rotations along the shortest arc. A pose is known between
        two poses no further apart than `max_gap_s`; the others are the identity.
        """
        stamps = np.asarray(stamps_ns, np.int64)
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        if not len(self):
            return poses, np.zeros(len(stamps), bool)
        before, after, _ = bracket(self.stamps_ns, stamps)
        known = (self.stamps_ns[0] <= stamps) & (stamps <= self.stamps_ns[-1])
        known &= self.stamps_ns[after] - self.stamps_ns[before] <= max_gap_s * 1e9
        poses[known] = interpolated(self.stamps_ns, self.poses, stamps[known])
        return poses, known

    def of_body(self, body_T_sensor: Array) -> Trajectory:
        """Return the poses of the body, where these are of a sensor on it, such as a SLAM system's IMU or camera."""
        return Trajectory(self.stamps_ns, self.poses @ np.linalg.inv(body_T_sensor), self.has_orientation)


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write `seconds x y z qx qy qz qw` lines, the stamps to the nanosecond.

    Raises:
        OutputError: the file cannot be written.
    """
    poses = trajectory.poses
    numbers = np.concatenate([poses[:, :3, 3], to_quaternion(poses)], axis=1).tolist() if len(poses) else []
    stamps = [divmod(stamp, 10**9) for stamp in trajectory.stamps_ns.tolist()]
    form = "%d.%09d" + " %.9f" * 7 + "\n"
    lines = [form % (*stamp, *row) for stamp, row in zip(stamps, numbers, strict=True)]
    with writing(path):
        Path(path).write_text("".join(lines), encoding="ascii")


def write_geojson(path: Path, trajectories: Mapping[str, Array], world_T_map: Array, origin: Array) -> None:
    """Write trajectories by name as line strings of a GeoJSON file (RFC 7946); those of one pose are left out.

    Args:
        path: the file.
        trajectories: (N, 4, 4) `map_T_body` each.
        world_T_map: (4, 4) pose of their frame in axes east, north and up of the origin.
        origin: (3,) latitude, longitude (deg) and height (m) on WGS 84.

    Raises:
        OutputError: the file cannot be written.
    """
    features = []
    for name, poses in trajectories.items():
        if len(poses) > 1:
            degrees = from_enu(transform(world_T_map, poses[:, :3, 3]), origin)[:, [1, 0, 2]]
            line = {"type": "LineString", "coordinates": degrees.round(9).tolist()}
            features.append({"type": "Feature", "properties": {"name": name}, "geometry": line})
    write_atomically(path, json.dumps({"type": "FeatureCollection", "features": features}) + "\n")


EDGE = np.dtype([("first", "i8"), ("second", "i8"), ("pose", "f8", (4, 4)), ("covariance", "f8", (6, 6))])
"""Fields of an array of edges: pose `first_T_second`, covariance in GTSAM's order, tangent space of `second`."""


def write_g2o(path: Path, poses: Array, edges: ArrayLike, ids: Sequence[int] | None = None) -> None:
    """Write a g2o file.

    Args:
        path: the file.
        poses: (N, 4, 4) of the vertices.
        edges: (M,) of `EDGE` between rows of `poses`, or a list of such tuples.
        ids: (N,) of the vertices in the file; None: 0, 1, ...

    Raises:
        OutputError: the file cannot be written.
    """
    names = range(len(poses)) if ids is None else ids
    measured = np.asarray(edges, EDGE)
    pairs = [(names[first], names[second]) for first, second in measured[["first", "second"]].tolist()]
    information = np.linalg.inv(np.roll(measured["covariance"], 3, axis=(1, 2)))  # position first
    upper = np.triu_indices(6)
    numbers = np.concatenate([_numbers(measured["pose"]), information[:, upper[0], upper[1]]], axis=1)
    lines = g2o_lines("VERTEX_SE3:QUAT", [(name,) for name in names], _numbers(poses))
    with writing(path):
        path.write_text("".join(lines + g2o_lines("EDGE_SE3:QUAT", pairs, numbers)), encoding="ascii")


def g2o_lines(tag: str, ids: Sequence[tuple[int, ...]], numbers: Array) -> list[str]:
    """Return lines of a tag, the ids of vertices and (N, M) numbers."""
    form = tag + " %d" * len(ids[0]) + " %.12g" * numbers.shape[1] + "\n" if len(ids) else ""
    return [form % (*names, *row) for names, row in zip(ids, numbers.tolist(), strict=True)]


def _numbers(poses: Array) -> Array:
    """Return (N, 7) position and quaternion of (N, 4, 4) poses."""
    return np.concatenate([poses[:, :3, 3], to_quaternion(poses) if len(poses) else np.empty((0, 4))], axis=1)
