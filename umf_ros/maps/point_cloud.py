"""The map as a point cloud: aligned scans without moving objects, thinned, and the thickness of their surfaces."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from umf_ros.core.config import TerrainSettings
from umf_ros.core.errors import UmfError, reading
from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, cubes, evenly, invert, transform
from umf_ros.core.io import atomic_write
from umf_ros.localizer import read_poses
from umf_ros.maps.joint_graph import JointMap
from umf_ros.maps.map_folder import MapFolder
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import stored_identity
from umf_ros.runs.gallery import HeightMap
from umf_ros.terrain.grid import write_terrain
from umf_ros.terrain.voxels import REACH_M, PlacedScan, VoxelMap

VOXEL_M = 0.1
Poses = dict[int, Array]
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
        _, first = np.unique(cubes(self.points.astype(float), voxel_m), return_index=True)
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


def gather(folder: MapFolder, poses: Poses) -> tuple[list[PlacedScan], NDArray[np.uint8]]:
    """Return the scans of a map at poses `map_T_body` by their stamps on its clock, and the session of each."""
    scans, sessions = [], []
    with closing(PlaceDatabase.of_map(folder.path, *stored_identity(folder.places))) as places:
        for number, one in enumerate(folder.sessions):
            for row in range(one.first_place, one.first_place + one.places):
                keyframe = places[row]
                if keyframe.stamp_ns in poses:
                    scans.append((keyframe.points, keyframe.body_T_lidar, poses[keyframe.stamp_ns]))
                    sessions.append(number % 256)
    return scans, np.array(sessions, np.uint8)


def merge(scans: list[PlacedScan], sessions: NDArray[np.uint8]) -> MapCloud:
    """Return the points of scans, each with its session, in one cloud."""
    placed = [transform(pose, points[np.linalg.norm(points, axis=1) < REACH_M]) for points, _, pose in scans]
    count = [len(points) for points in placed]
    return MapCloud(np.concatenate([np.empty((0, 3), np.float32), *placed]), np.repeat(sessions, count))


def write_cloud(folder: MapFolder, joint: JointMap) -> dict[str, float]:
    """Write `map.ply`, `map.pcd`, the picture `map.png` and the files of `write_terrain`.

    Returns:
        Thickness of surfaces in m: "before", by the odometry of every session alone; "with_moving", by the joint graph;
        "after", without moving objects.
    """
    solved, driven = Poses(), Poses()
    for one in joint.sessions:
        stamps = (one.stamps + one.session.shift_ns).tolist()
        solved |= zip(stamps, one.poses, strict=True)
        if stamps:
            driven |= zip(stamps, one.poses[0] @ invert(one.odometry[0]) @ one.odometry, strict=True)
    scans, sessions = gather(folder, solved)
    everything, voxels = merge(scans, sessions), VoxelMap(folder.settings.terrain.cell_m)
    voxels.add(scans)
    static = voxels.are_static(everything.points.astype(float))
    cloud = MapCloud(everything.points[static], everything.sessions[static])
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
    write_terrain(folder.path, voxels.points().astype(float), folder.settings.terrain, joint.world)
    before = merge(*gather(folder, driven)).thinned().thickness()
    return {"before": before, "with_moving": everything.thinned().thickness(), "after": thin.thickness()}


def export_terrain(folder: MapFolder, settings: TerrainSettings, out: Path) -> str:
    """Write the files of the ground of a solved map into a folder; return what could not be written, as a sentence.

    Raises:
        UmfError: the map has not been solved.
        OutputError: a file cannot be written.
    """
    solved, voxels = read_poses(folder.path), VoxelMap(settings.cell_m)
    voxels.add(gather(folder, Poses(zip(solved.stamps_ns.tolist(), solved.poses, strict=True)))[0])
    with reading(folder.path / "summary.json", UmfError, "is damaged"):
        world = json.loads((folder.path / "summary.json").read_text(encoding="utf-8")).get("world")
    placed = None if world is None else (np.array(world["world_T_map"]), np.array(world["origin"]))
    return write_terrain(out, voxels.points().astype(float), settings, placed)


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
