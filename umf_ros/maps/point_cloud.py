"""The map as a point cloud: aligned scans, thinned by voxels, and the thickness of their surfaces."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from umf_ros.core.frames import Points
from umf_ros.core.geometry import evenly, invert, transform
from umf_ros.core.io import atomic_write
from umf_ros.maps.joint_graph import JointMap
from umf_ros.maps.map_folder import MapFolder
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import stored_identity
from umf_ros.runs.gallery import HeightMap

VOXEL_M = 0.1
REACH_M = 25.0  # by hand: beyond, points are too sparse to show an alignment
_NEIGHBOURS_M, _FEWEST = 0.5, 12
_MOST_PROBED = 20_000
_RECORD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("session", "u1")])


@dataclass(frozen=True)
class MapCloud:
    """Points of a map.

    Attributes:
        points: (N, 3) float32, m, map frame.
        sessions: (N,) number of the recording of each point, modulo 256.
    """

    points: Points
    sessions: NDArray[np.uint8]

    def thinned(self, voxel_m: float = VOXEL_M) -> MapCloud:
        """Keep the first point in every voxel."""
        cells = np.floor(self.points / voxel_m).astype(np.int64)
        cells -= cells.min(axis=0, initial=0)
        size = cells.max(axis=0, initial=0) + 1
        _, first = np.unique((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2], return_index=True)
        return MapCloud(self.points[first], self.sessions[first])

    def thickness(self) -> float:
        """Return the median thickness in m of surfaces seen by at least two recordings; thinner means a crisper map.

        The standard deviation across the plane through the neighbours within half a metre of points all over the map
        [after the mean plane variance of Razlaw 2015]; NaN where no two recordings overlap.
        """
        tree = cKDTree(self.points)
        rows = evenly(len(self.points), _MOST_PROBED)
        found = []
        for near in tree.query_ball_point(self.points[rows], _NEIGHBOURS_M) if len(rows) else []:
            if len(near) >= _FEWEST and len(set(self.sessions[near].tolist())) > 1:
                spread = np.cov(self.points[near].T.astype(float))
                found.append(np.sqrt(max(np.linalg.eigvalsh(spread)[0], 0.0)))
        return float(np.median(found)) if found else float("nan")


def gather(folder: MapFolder, joint: JointMap, optimised: bool = True) -> MapCloud:
    """Return the scans of all joined recordings at their poses in the map, or at those of their odometry alone."""
    points, sessions = [np.empty((0, 3), np.float32)], [np.empty(0, np.uint8)]
    with closing(PlaceDatabase.of_map(folder.path, *stored_identity(folder.places))) as places:
        for number, one in enumerate(joint.sessions):
            poses = one.poses
            if len(poses) and not optimised:
                poses = poses[0] @ invert(one.odometry[0]) @ one.odometry
            known = dict(zip((one.stamps + one.session.shift_ns).tolist(), poses, strict=True))
            for row in range(one.session.first_place, one.session.first_place + one.session.places):
                keyframe = places[row]
                if keyframe.stamp_ns in known:
                    near = keyframe.points[np.linalg.norm(keyframe.points, axis=1) < REACH_M]
                    points.append(transform(known[keyframe.stamp_ns], near))
                    sessions.append(np.full(len(near), number % 256, np.uint8))
    return MapCloud(np.concatenate(points), np.concatenate(sessions))


def write_cloud(folder: MapFolder, joint: JointMap) -> tuple[float, float]:
    """Write `map.ply`, `map.pcd` and the picture `map.png`.

    Returns:
        Thickness of surfaces in m by the odometry of every session alone, and by the joint graph.
    """
    cloud = gather(folder, joint)
    thin = cloud.thinned()
    write_ply(folder.path / "map.ply", thin)
    write_pcd(folder.path / "map.pcd", thin)
    path = np.concatenate([np.empty((0, 2)), *(one.poses[:, :2, 3] for one in joint.sessions)])
    if len(path):
        heights = HeightMap(path)
        heights.add(cloud.points)
        png = heights.png()
        if png is not None:
            with atomic_write(folder.path / "map.png") as part:
                part.write_bytes(png)
    return gather(folder, joint, optimised=False).thinned().thickness(), thin.thickness()


def write_ply(path: Path, cloud: MapCloud) -> None:
    """Write a binary PLY file of x, y, z and session."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud.points)}\nproperty float x\n"
        "property float y\nproperty float z\nproperty uchar session\nend_header\n"
    )
    _write(path, header, cloud)


def write_pcd(path: Path, cloud: MapCloud) -> None:
    """Write a binary PCD file of x, y, z and session."""
    count = len(cloud.points)
    header = (
        "VERSION 0.7\nFIELDS x y z session\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 1\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )
    _write(path, header, cloud)


def _write(path: Path, header: str, cloud: MapCloud) -> None:
    records = np.empty(len(cloud.points), _RECORD)
    records["x"], records["y"], records["z"] = cloud.points.T
    records["session"] = cloud.sessions
    with atomic_write(path) as part:
        part.write_bytes(header.encode("ascii") + records.tobytes())
