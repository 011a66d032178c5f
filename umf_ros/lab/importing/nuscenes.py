"""nuScenes and folders laid out like it: tables in v1.0-*/, files in samples/ and sweeps/ (Caesar, CVPR 2020)."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.errors import SensorFileError
from umf_ros.core.geometry import Array, from_quaternion
from umf_ros.core.trajectory import Trajectory
from umf_ros.lab.importing.files import size_of
from umf_ros.lab.importing.imported import Imported, pinhole
from umf_ros.sensors.scan_files import read_scan

CAMERA, LIDAR = "CAM_FRONT", "LIDAR_TOP"
SCAN_COLUMNS = 5
"""Of a .pcd.bin: x y z, intensity and ring."""
Row = dict[str, Any]


def nuscenes(source: Path) -> Imported:
    """The drives of one city: front camera and LiDAR, keyframes and sweeps, as far as their files are there.

    The body is nuScenes's ego frame, the truth its ego poses in the map of the city. There is one camera, no stereo.
    """
    tables = next((path for path in sorted(source.glob("v1.0-*")) if path.is_dir()), None)
    if tables is None:
        raise SensorFileError(f"{source} holds no tables: expected a folder v1.0-mini or the like")
    cities = sorted({str(row.get("location", "")) for row in _table(tables, "log")})
    if len(cities) > 1:
        named = ", ".join(cities)
        raise SensorFileError(f"{tables} holds drives of {len(cities)} cities ({named}): leave those of one")
    try:
        return _import(source, tables).check(source)
    except (KeyError, TypeError, ValueError) as error:
        raise SensorFileError(f"{tables}: not the tables of nuScenes ({error!r})") from None


def _import(source: Path, tables: Path) -> Imported:
    sensors = {row["token"]: row["channel"] for row in _table(tables, "sensor")}
    mounted = {row["token"]: row for row in _table(tables, "calibrated_sensor")}
    poses = {row["token"]: row for row in _table(tables, "ego_pose")}
    taken: dict[str, list[Row]] = {CAMERA: [], LIDAR: []}
    for row in _table(tables, "sample_data"):
        channel = sensors[mounted[row["calibrated_sensor_token"]]["sensor_token"]]
        if channel in taken and (source / row["filename"]).is_file():
            taken[channel].append(row)
    images, scans = (sorted(rows, key=lambda row: int(row["timestamp"])) for rows in taken.values())
    found = Imported({})
    found.left = [(_stamp(row), source / row["filename"]) for row in images]
    found.scans = [(_stamp(row), partial(read_scan, source / row["filename"], SCAN_COLUMNS)) for row in scans]
    width, height = size_of(found.left[0][1]) if found.left else (1600, 900)
    matrix = np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    if images:
        camera = mounted[images[0]["calibrated_sensor_token"]]
        found.body_T_camera, matrix = _pose(camera), np.array(camera["camera_intrinsic"], float).reshape(3, 3)
    if scans:
        found.body_T_lidar = _pose(mounted[scans[0]["calibrated_sensor_token"]])
        bodies = np.stack([_pose(poses[row["ego_pose_token"]]) for row in scans])
        found.truth = Trajectory(np.array([_stamp(row) for row in scans], np.int64), bodies)
    found.camera = {"camera": pinhole(width, height, matrix, baseline=0.0)}
    return found


def _table(tables: Path, name: str) -> list[Row]:
    path = tables / f"{name}.json"
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SensorFileError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'no JSON'}") from None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise SensorFileError(f"{path}: expected a list of rows")
    return rows


def _stamp(row: Row) -> int:
    return int(row["timestamp"]) * 1000


def _pose(row: Row) -> Array:
    w, x, y, z = (float(value) for value in row["rotation"])
    return from_quaternion([float(value) for value in row["translation"]], [x, y, z, w])
