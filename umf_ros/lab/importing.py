"""Formats of data sets with cameras: KITTI, EuRoC (ASL), TUM RGB-D, nuScenes, VSLAM-LAB, plain folders.

Every format is a function that returns an `Imported`; a new one is a row in `FORMATS`.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from umf_ros.bags.trajectories import read_tum
from umf_ros.core import limits
from umf_ros.core.errors import BagError, command_line
from umf_ros.core.geometry import Array, from_quaternion, invert, make_pose
from umf_ros.core.io import read_yaml
from umf_ros.core.trajectory import Trajectory
from umf_ros.lab import lidar_sets
from umf_ros.lab.imported import OPTICAL, DataSetFile, Imported, pose_entry
from umf_ros.lab.scan_files import IMAGE_SUFFIXES, SUFFIXES, SensorFileError, read_image, read_picture, read_scan
from umf_ros.sensors.decode import Cloud


def pinhole(width: int, height: int, matrix: Array, **more: Any) -> dict[str, Any]:
    """Intrinsics as a calibration file has them, of a (3, 3) or (3, 4) matrix."""
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **more}


def lines_of(path: Path) -> list[str]:
    """Lines of a text file that are neither empty nor comments.

    Raises:
        SensorFileError: it cannot be read.
    """
    try:
        return [line.strip() for line in limits.lines_of(path) if line.strip() and not line.lstrip().startswith("#")]
    except UnicodeDecodeError:
        raise SensorFileError(f"cannot read {path}: no text") from None
    except (OSError, ValueError) as error:
        raise SensorFileError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None


def numbers_of(path: Path, separator: str | None = None) -> Array:
    """A table of numbers (N, M).

    Raises:
        SensorFileError: it is none.
    """
    try:
        return np.array([[float(word) for word in line.split(separator)] for line in lines_of(path)], float)
    except ValueError:
        raise SensorFileError(f"{path}: expected lines of numbers, all as long") from None


def entries_of(path: Path) -> dict[str, Array]:
    """`name: numbers` lines, as of KITTI's calibrations; what holds no numbers is left out."""
    found: dict[str, Array] = {}
    for line in lines_of(path):
        name, _, rest = line.partition(":")
        try:
            found[name.strip()] = np.array([float(word) for word in rest.split()])
        except ValueError:
            continue
    return found


def entry(entries: dict[str, Array], name: str, shape: tuple[int, ...], path: Path) -> Array:
    """One of them, in its shape.

    Raises:
        SensorFileError: it is not there, or of another size.
    """
    if name not in entries or entries[name].size != np.prod(shape):
        raise SensorFileError(f"{path}: expected an entry {name} of {int(np.prod(shape))} numbers")
    return entries[name].reshape(shape)


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of an image."""
    height, width = read_image(path).shape
    return width, height


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
        raise SensorFileError(f"{tables} has drives of {len(cities)} cities ({', '.join(cities)}): leave those of one")
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
    if images:
        camera = mounted[images[0]["calibrated_sensor_token"]]
        matrix = np.array(camera["camera_intrinsic"], float).reshape(3, 3)
        found.camera = {"camera": pinhole(*size_of(found.left[0][1]), matrix, baseline=0.0)}
        found.body_T_camera = _pose(camera)
    if scans:
        found.body_T_lidar = _pose(mounted[scans[0]["calibrated_sensor_token"]])
        bodies = np.stack([_pose(poses[row["ego_pose_token"]]) for row in scans])
        found.truth = Trajectory(np.array([_stamp(row) for row in scans], np.int64), bodies)
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


KITTI_START_NS = 1_300_000_000 * 10**9
"""KITTI's odometry counts its times from 0; a message needs a stamp."""
TUM_INTRINSICS = {"freiburg1": (517.3, 516.5, 318.6, 255.3), "freiburg2": (520.9, 521.0, 325.1, 249.7)}
TUM_USUAL = (535.4, 539.2, 320.1, 247.6)
DEPTH_UNITS, DEPTH_STEP, FARTHEST_M = 5000.0, 4, 6.0
"""Of TUM RGB-D: units per metre; every fourth pixel; beyond, a structured light knows nothing."""


def kitti_odometry(source: Path) -> Imported:
    """A sequence of KITTI's odometry: calib.txt, times.txt, image_0 and image_1, velodyne; the LiDAR is the body."""
    path = source / "calib.txt"
    entries = entries_of(path)
    left, right = (entry(entries, name, (3, 4), path) for name in ("P0", "P1"))
    camera_T_body = np.vstack([entry(entries, "Tr", (3, 4), path), [0, 0, 0, 1]])
    try:
        stamps = [KITTI_START_NS + _stamp_ns(line) for line in lines_of(source / "times.txt")]
    except ValueError:
        raise SensorFileError(f"{source / 'times.txt'}: expected lines of SECONDS") from None
    found = Imported({}, invert(camera_T_body))
    found.left, found.right = (_in_order(source / name, stamps) for name in ("image_0", "image_1"))
    found.scans = [(s, partial(read_scan, file, 4)) for s, file in _in_order(source / "velodyne", stamps)]
    found.check(source)
    size = size_of(found.left[0][1]) if found.left else (1241, 376)
    found.camera = {"camera": pinhole(*size, left, baseline=float(-right[0, 3] / right[0, 0]))}
    poses = source.parent.parent / "poses" / f"{source.name}.txt"
    if poses.is_file():
        cameras = numbers_of(poses).reshape(-1, 3, 4)
        bodies = np.stack([invert(camera_T_body) @ np.vstack([one, [0, 0, 0, 1]]) @ camera_T_body for one in cameras])
        found.truth = Trajectory(np.array(stamps[: len(bodies)], np.int64), bodies)
    return found


def kitti_raw(source: Path) -> Imported:
    """A drive of KITTI's raw data, synchronised and rectified, with the calibration in the folder above."""
    cameras, lidar = source.parent / "calib_cam_to_cam.txt", source.parent / "calib_velo_to_cam.txt"
    entries, mounted = entries_of(cameras), entries_of(lidar)
    left, right = (entry(entries, f"P_rect_{name}", (3, 4), cameras) for name in ("00", "01"))
    upright = make_pose(entry(entries, "R_rect_00", (3, 3), cameras), np.zeros(3))
    velo = make_pose(entry(mounted, "R", (3, 3), lidar), entry(mounted, "T", (3,), lidar))
    found = Imported({}, invert(upright @ velo))
    found.left, found.right = (_raw_files(source / name) for name in ("image_00", "image_01"))
    found.scans = [(s, partial(read_scan, file, 4)) for s, file in _raw_files(source / "velodyne_points")]
    found.check(source)
    size = size_of(found.left[0][1]) if found.left else (1242, 375)
    found.camera = {"camera": pinhole(*size, left, baseline=float(-right[0, 3] / right[0, 0]))}
    return found


def euroc(source: Path) -> Imported:
    """A folder in EuRoC's ASL format: cam0, cam1 with their sensor.yaml, and state_groundtruth_estimate0; no scans."""
    root = source / "mav0" if (source / "mav0").is_dir() else source
    (left, body_T_left), (right, body_T_right) = (_asl_camera(root / name) for name in ("cam0", "cam1"))
    turn = invert(body_T_left) @ body_T_right
    found = Imported({"raw_camera": {"left": left, "right": right, "left_T_right": pose_entry(turn)}})
    found.camera["raw_camera"] |= {"width": left["width"], "height": left["height"]}
    found.left, found.right = (_asl_files(root / name) for name in ("cam0", "cam1"))
    truth = root / "state_groundtruth_estimate0" / "data.csv"
    if truth.is_file():
        rows = [line.split(",") for line in lines_of(truth)]
        poses = [from_quaternion([float(v) for v in row[1:4]], [float(row[i]) for i in (5, 6, 7, 4)]) for row in rows]
        bodies = np.stack(poses) @ body_T_left @ invert(OPTICAL)
        found.truth = Trajectory(np.array([int(row[0]) for row in rows], np.int64), bodies)
    return found.check(source)


def tum_rgbd(source: Path) -> Imported:
    """A sequence of TUM RGB-D: rgb.txt, depth.txt, groundtruth.txt; the depth images are the scans."""
    fx, fy, cx, cy = next((k for name, k in TUM_INTRINSICS.items() if name in source.name), TUM_USUAL)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    found = Imported({})
    found.left = _listed(source / "rgb.txt")
    found.scans = [(s, partial(_depth_scan, file, matrix)) for s, file in _listed(source / "depth.txt")]
    found.check(source)
    size = size_of(found.left[0][1]) if found.left else (640, 480)
    found.camera = {"camera": pinhole(*size, matrix, baseline=0.0)}
    if (source / "groundtruth.txt").is_file():
        found.truth = read_tum(source / "groundtruth.txt").of_body(OPTICAL)
    return found


def folder(source: Path) -> Imported:
    """Images and scans with a times.txt of lines `FILE SECONDS`; what has right in its path is the right camera's."""
    found = Imported({})
    for line in lines_of(source / "times.txt"):
        name, _, seconds = line.rpartition(" ")
        path = source / name.strip()
        try:
            stamp = _stamp_ns(seconds)
        except ValueError:
            raise SensorFileError(f"{source / 'times.txt'}: expected lines FILE SECONDS, found {line[:60]!r}") from None
        if not path.is_file():
            raise SensorFileError(f"{source / 'times.txt'}: there is no file {name.strip()}")
        if path.suffix.lower() in SUFFIXES:
            found.scans.append((stamp, partial(read_scan, path)))
        elif path.suffix.lower() in IMAGE_SUFFIXES:
            (found.right if "right" in name.lower() else found.left).append((stamp, path))
    for files in (found.left, found.right, found.scans):
        files.sort(key=lambda one: one[0])
    if not found.left and not found.scans:
        raise SensorFileError(f"{source / 'times.txt'} names neither images nor scans: expected lines FILE SECONDS")
    if not found.left:
        return found  # the body is the LiDAR
    found.guessed = ["the intrinsics of the camera", "the mountings of camera and LiDAR"]
    width, height = size_of(found.left[0][1])
    matrix = np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    found.camera = {"camera": pinhole(width, height, matrix, baseline=0.1 if found.right else 0.0)}
    return found


def _stamp_ns(seconds: str) -> int:
    """Nanoseconds of a time in seconds that a message can have, from 1970 to 2038; else a `ValueError`."""
    number = float(seconds)
    if not 0 <= number < 2**31:
        raise ValueError(seconds)
    return round(number * 1e9)


def vslam_lab(source: Path) -> Imported:
    """An export of S3LI Vulcano by VSLAM-LAB: rgb.csv without a header, calibration.yaml; neither scans nor truth."""
    matrix, baseline = _export_calibration(source / "calibration.yaml")
    found = Imported({})
    for line in lines_of(source / "rgb.csv"):
        row = [word.strip() for word in line.split(",")]
        try:
            left, right = (_stamp_ns(row[place]) for place in (0, 2))
        except (ValueError, IndexError):
            raise SensorFileError(
                f"{source / 'rgb.csv'}: expected SECONDS,FILE,SECONDS,FILE, found {line[:60]!r}"
            ) from None
        found.left.append((left, source / row[1]))
        found.right.append((right, source / row[3]))
    found.check(source)
    found.camera = {"camera": pinhole(*size_of(found.left[0][1]), matrix, baseline=baseline)}
    return found


def _export_calibration(path: Path) -> tuple[Array, float]:
    """(3, 3) intrinsics and the baseline in metres from `calibration.yaml` of VSLAM-LAB's export.

    Its `Stereo.bf` holds metres, unlike ORB-SLAM's.

    Raises:
        SensorFileError: the file is missing, cut or of other content.
    """
    try:
        storage = cv2.FileStorage(limits.read_text(path), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        fx, fy, cx, cy, baseline = (
            storage.getNode(name).real()
            for name in ("Camera0.fx", "Camera0.fy", "Camera0.cx", "Camera0.cy", "Stereo.bf")
        )
    except (OSError, ValueError, cv2.error, SystemError):
        raise SensorFileError(f"{path} is no calibration of an export: it cannot be read") from None
    if fx <= 0 or fy <= 0 or not 0.02 <= baseline <= 1:
        raise SensorFileError(f"{path}: fx {fx:.4g} px and a baseline of {baseline:.4g} m: expected pixels and metres")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), float(baseline)


Format = tuple[Callable[[Path], Imported], tuple[str, ...]]
FORMATS: dict[str, Format] = {
    "kitti-odometry": (kitti_odometry, ("calib.txt", "times.txt")),
    "kitti-raw": (kitti_raw, ("velodyne_points/timestamps.txt",)),
    "euroc": (euroc, ("**/cam0/sensor.yaml",)),
    "tum-rgbd": (tum_rgbd, ("rgb.txt", "depth.txt")),
    "nuscenes": (nuscenes, ("v1.0-*",)),
    "vslam-lab": (vslam_lab, ("rgb.csv", "calibration.yaml")),
    "mulran": (lidar_sets.mulran, ("**/Ouster", "global_pose.csv")),
    "helipr": (lidar_sets.helipr, ("LiDAR/Ouster",)),
    "nclt": (lidar_sets.nclt, ("velodyne_sync",)),
    "newer-college": (lidar_sets.newer_college, ("**/ouster_scan",)),
    "folder": (folder, ("times.txt",)),
}
"""Function that reads a format, and files and folders that it is recognised by; the more special formats first."""


def open_data_set(source: Path) -> DataSetFile:
    """Read the folder of a data set like a file of a recording.

    Raises:
        BagError: it is of no known format, or lacks what a replay needs to know of the sensors.
        SensorFileError: a file cannot be read.
    """
    kind = next((kind for kind, (_, marks) in FORMATS.items() if all(any(source.glob(one)) for one in marks)), "")
    if not kind:
        endings = {one.suffix.lower() for pattern in ("*", "*/*") for one in source.glob(pattern)}
        has_files = not endings.isdisjoint((*SUFFIXES, *IMAGE_SUFFIXES))
        hint = "; scans and images need a times.txt of lines FILE SECONDS" if has_files else ""
        raise BagError(f"{source} is not a recording: it holds neither mcap nor db3 files, nor a known data set{hint}")
    found = FORMATS[kind][0](source)
    if found.guessed or "raw_camera" in found.camera:
        command = command_line("import", kind, source, f"{source.name}.mcap")
        raise BagError(f"{source} has files of {kind} and needs a calibration, which is written by {command}")
    return DataSetFile(source, found)


def _in_order(source: Path, stamps: list[int]) -> list[tuple[int, Path]]:
    """The files of a folder by their number, each with its stamp."""
    files = sorted(path for path in source.glob("*") if path.stem.isdigit())
    return [(stamps[int(path.stem)], path) for path in files if int(path.stem) < len(stamps)]


def _raw_files(source: Path) -> list[tuple[int, Path]]:
    if not (source / "timestamps.txt").is_file():
        return []
    try:
        times = np.array(lines_of(source / "timestamps.txt"), "datetime64[ns]").astype(np.int64)
    except ValueError:
        raise SensorFileError(f"{source / 'timestamps.txt'}: expected lines of dates and times") from None
    return _in_order(source / "data", times.tolist())


LENSES = {
    **dict.fromkeys(("radial-tangential", "radtan", "plumb_bob", "rational_polynomial", "thin_prism"), "radtan"),
    **dict.fromkeys(("equidistant", "equi", "fisheye", "kannala-brandt", "kannala_brandt"), "equidistant"),
}
"""Names of distortion models by the programs that write them, and those of a calibration file."""


def lens(path: Path, camera: object, distortion: object, coefficients: Any) -> dict[str, Any]:
    """Entries `distortion` and `distortion_model` of a raw camera.

    Args:
        path: file that holds them.
        camera: name of the camera model; None: a pinhole.
        distortion: name of the distortion model; "none", or None: there is none.
        coefficients: a list of numbers, in OpenCV's order.

    Raises:
        SensorFileError: the model, which is named, cannot be rectified.
    """
    models = str(camera or "pinhole").lower(), str(distortion or "none").lower()
    known = LENSES.get(models[1]) or ("radtan" if models[1] == "none" else "")
    if models[0] != "pinhole" or not known:
        raise SensorFileError(
            f"{path}: the model {'-'.join(models)} cannot be rectified; only pinhole with radtan or equidistant can"
        )
    numbers = [] if models[1] == "none" else [float(value) for value in coefficients]
    return {"distortion": numbers, "distortion_model": known}


def _asl_camera(source: Path) -> tuple[dict[str, Any], Array]:
    path = source / "sensor.yaml"
    try:
        content = read_yaml(path)
        width, height = content["resolution"]
        fx, fy, cx, cy = content["intrinsics"]
        mounted = np.array(content["T_BS"]["data"], float).reshape(4, 4)
        models = content.get("camera_model"), content.get("distortion_model", "radtan")
        distortion = lens(path, *models, content.get("distortion_coefficients"))
    except (KeyError, TypeError, ValueError) as error:
        raise SensorFileError(f"{path}: expected resolution, intrinsics, distortion and T_BS ({error})") from None
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return pinhole(width, height, matrix, **distortion), mounted


def _asl_files(source: Path) -> list[tuple[int, Path]]:
    rows = csv.reader(lines_of(source / "data.csv"))
    return sorted((int(row[0]), source / "data" / row[1].strip()) for row in rows)


def _listed(path: Path) -> list[tuple[int, Path]]:
    """`seconds name` lines of TUM."""
    rows = [line.split() for line in lines_of(path)]
    try:
        return sorted((_stamp_ns(row[0]), path.parent / row[1]) for row in rows)
    except (ValueError, IndexError):
        raise SensorFileError(f"{path}: expected lines SECONDS FILE") from None


def _depth_scan(path: Path, matrix: Array) -> Cloud:
    """Points in the body frame of a camera that is the body."""
    image = read_picture(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise SensorFileError(f"{path} is no depth image")
    depth = image[::DEPTH_STEP, ::DEPTH_STEP] / DEPTH_UNITS
    v, u = np.nonzero((depth > 0) & (depth < FARTHEST_M))
    z = depth[v, u]
    x = (u * DEPTH_STEP - matrix[0, 2]) / matrix[0, 0] * z
    y = (v * DEPTH_STEP - matrix[1, 2]) / matrix[1, 1] * z
    return Cloud((np.column_stack([x, y, z]) @ OPTICAL[:3, :3].T).astype(np.float32))
