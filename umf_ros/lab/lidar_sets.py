"""Data sets of cars and people with a LiDAR, as they are downloaded: MulRan, HeLiPR, NCLT and Newer College.

Scans alone; names of files are their stamps. Mountings are those that the data sets publish.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.bags.trajectories import read_tum
from umf_ros.core import limits
from umf_ros.core.geometry import Array, make_pose
from umf_ros.core.trajectory import Trajectory
from umf_ros.lab.imported import Imported
from umf_ros.lab.scan_files import Record, SensorFileError, read_records, read_scan
from umf_ros.sensors.decode import Cloud


def _pose(translation: list[float], degrees: list[float]) -> Array:
    return make_pose(Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), translation)


MULRAN_LIDAR = _pose([1.7042, -0.021, 1.8047], [0.0001, 0.0003, 179.6654])
NCLT_LIDAR = _pose([0.002, -0.004, -0.957], [0.807, 0.166, -90.703])
"""In a body whose z axis points down."""
UPRIGHT = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns axes ahead, right and down to ahead, left and up."""
OUSTER: Record = np.dtype("<f4, <f4, <f4, <f4, <u4, <u2, <u2, <u2")
OUSTER.names = ("x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient")
VELODYNE: Record = np.dtype("<u2, <u2, <u2, u1, u1")
VELODYNE.names = ("x", "y", "z", "intensity", "laser")
NCLT_UNIT_M, NCLT_ORIGIN_M = 0.005, -100.0


def mulran(source: Path) -> Imported:
    """A sequence of MulRan: Ouster, and global_pose.csv of the car."""
    folder = next(source.glob("**/Ouster"), source)
    scans = _scans(folder, "*.bin", int, partial(read_scan, bin_columns=4))
    found = Imported({}, body_T_lidar=MULRAN_LIDAR, scans=scans)
    stamps, numbers = _table(source / "global_pose.csv", 12)
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, :3] = numbers.reshape(-1, 3, 4)
    found.truth = Trajectory.rising(zip(stamps, poses, strict=True))
    return found.check(source)


def helipr(source: Path) -> Imported:
    """A sequence of HeLiPR: its Ouster, which is the body, and LiDAR_GT/Ouster_gt.txt."""
    read = partial(read_records, record=OUSTER)
    found = Imported({}, scans=_scans(source / "LiDAR" / "Ouster", "*.bin", int, read))
    truth = source / "LiDAR_GT" / "Ouster_gt.txt"
    found.truth = read_tum(truth) if truth.is_file() else None
    return found.check(source)


def nclt(source: Path) -> Imported:
    """A session of NCLT: velodyne_sync and, where it is there, groundtruth_DATE.csv."""
    read = partial(read_records, record=VELODYNE, unit_m=NCLT_UNIT_M, origin_m=NCLT_ORIGIN_M)
    scans = _scans(source / "velodyne_sync", "*.bin", lambda name: int(name) * 1000, read)
    found = Imported({}, body_T_lidar=UPRIGHT @ NCLT_LIDAR, scans=scans)
    for path in source.glob("groundtruth*.csv"):
        stamps, numbers = _table(path, 6)
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        poses[:, :3, 3] = numbers[:, :3]
        poses[:, :3, :3] = Rotation.from_euler("xyz", numbers[:, 3:]).as_matrix()
        found.truth = Trajectory.rising(
            (1000 * us, UPRIGHT @ one @ UPRIGHT) for us, one in zip(stamps, poses, strict=True)
        )
    return found.check(source)


def newer_college(source: Path) -> Imported:
    """An experiment of Newer College 2020 in raw_format: ouster_scan. Its truth is of the camera, and is left out."""
    folder = next(source.glob("**/ouster_scan"), source)
    return Imported({}, scans=_scans(folder, "cloud_*.pcd", _seconds_and_ns, read_scan)).check(source)


def _seconds_and_ns(name: str) -> int:
    _, seconds, ns = name.split("_")
    return int(seconds) * 10**9 + int(ns)


def _scans(
    folder: Path, names: str, stamp_of: Callable[[str], int], read: Callable[[Path], Cloud]
) -> list[tuple[int, Callable[[], Cloud]]]:
    """Return the scans of a folder by the stamps in ns in their names, in order."""
    try:
        found = [(stamp_of(path.stem), partial(read, path)) for path in folder.glob(names)]
    except ValueError as error:
        raise SensorFileError(f"{folder}: names of scans are no stamps ({error})") from None
    return sorted(found, key=lambda one: one[0])


def _table(path: Path, columns: int) -> tuple[list[int], Array]:
    """Return whole stamps, and the `columns` numbers (N, C) after each, of lines separated by commas; no NaN."""
    try:
        rows = [line.split(",") for line in limits.lines_of(path) if line.strip() and "nan" not in line.lower()]
        if not rows or any(len(row) != 1 + columns for row in rows):
            raise ValueError(f"expected lines of a stamp and {columns} numbers")
        return [int(row[0]) for row in rows], np.array([row[1:] for row in rows], float)
    except (OSError, ValueError) as error:
        raise SensorFileError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
