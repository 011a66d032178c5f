"""Trajectories of odometry and ground truth, from files and recordings."""

from __future__ import annotations

from collections.abc import Iterable
from decimal import Decimal
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from umf_ros.bags.presets import GROUND_TRUTH_TOPIC
from umf_ros.bags.reader import Bag, RawMessage, decode
from umf_ros.core.config import Settings
from umf_ros.core.errors import BagError, MessageError
from umf_ros.core.geometry import to_enu
from umf_ros.core.io import read_lines
from umf_ros.core.trajectory import Trajectory
from umf_ros.sensors.calibration import calibration_of
from umf_ros.sensors.decode import LAST_STAMP_NS, decode_pose, stamp_ns

GPS_EPOCH_S, LEAP_SECONDS = 315_964_800, 18
"""1980-01-06 in POSIX seconds; GPS time is ahead of UTC by this much since 2017."""
WORST_QUALITY = 2
"""Worst accepted quality: 1 is a fixed, 2 a floating ambiguity; others err by metres."""


def read_tum(path: str | Path) -> Trajectory:
    """Return the trajectory from a TUM file: `seconds x y z qx qy qz qw` per line, # for comments.

    Raises:
        BagError: the file cannot be read; names the wrong line.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(read_lines(path, BagError), 1):
        fields = line.split()
        if not fields or line.lstrip().startswith("#"):
            continue
        try:
            stamp, row = _checked(int(Decimal(fields[0]) * 10**9)), [float(field) for field in fields[1:]]
        except (ValueError, ArithmeticError):
            raise BagError(f"{path}, line {number}: expected numbers, found {line.strip()[:60]!r}") from None
        if len(row) != 7:
            raise BagError(f"{path}, line {number}: expected 8 numbers (stamp x y z qx qy qz qw), found {len(fields)}")
        if not np.isfinite(row).all() or abs(np.linalg.norm(row[3:]) - 1) > 0.01:
            raise BagError(f"{path}, line {number}: not a pose (a number is not finite, or no unit quaternion)")
        if stamps and stamp <= stamps[-1]:
            raise BagError(f"{path}, line {number}: the stamp {fields[0]} is not later than the one before")
        stamps.append(stamp)
        rows.append(row)
    if not stamps:
        raise BagError(f"{path} holds no pose")
    values = np.array(rows)
    poses = RigidTransform.from_components(values[:, :3], Rotation.from_quat(values[:, 3:])).as_matrix()
    return Trajectory(np.array(stamps, np.int64), poses)


def read_odometry(path: str | Path, frame: str, settings: Settings) -> Trajectory:
    """Return the odometry of the body from a TUM file of the poses of `frame`: body, imu, camera or lidar.

    Raises:
        BagError: the file cannot be read, or there is no such frame.
    """
    calibration = calibration_of(settings)
    mountings = {name: getattr(calibration, f"body_T_{name}") for name in ("imu", "camera", "lidar")}
    mountings = {"body": np.eye(4), **mountings}
    if frame not in mountings:
        raise BagError(f"unknown frame {frame!r} of the odometry; expected one of {', '.join(mountings)}")
    return read_tum(path).of_body(mountings[frame])


def read_ground_truth(bag: Bag | None, path: str | Path | None = None) -> Trajectory | None:
    """Return the ground truth of a file (RTKLIB .pos or TUM), else of the recording's topic of the simulator, or None.

    Raises:
        BagError: the file cannot be read or has a wrong line.
    """
    if path is not None:
        if Path(path).suffix.lower() != ".pos":
            return read_tum(path)
        return read_rtklib(path)
    if bag is None or GROUND_TRUTH_TOPIC not in bag.topics:
        return None
    return decode_ground_truth(bag, bag.raw_messages([GROUND_TRUTH_TOPIC]))


def decode_ground_truth(bag: Bag, messages: Iterable[RawMessage]) -> Trajectory | None:
    """Return the ground truth of the first session from messages of a recording, or None; raises a `BagError`."""
    try:
        found = [decode(raw) for raw in messages]
        return Trajectory.rising((stamp_ns(one), decode_pose(one.pose)) for one in found)
    except MessageError as error:
        raise BagError(f"{bag.path}: ground truth holds a {error}") from None


def _checked(nanoseconds: int) -> int:
    if abs(nanoseconds) >= LAST_STAMP_NS:
        raise OverflowError("beyond the last stamp")
    return nanoseconds


def read_rtklib(path: str | Path, worst_quality: int = WORST_QUALITY) -> Trajectory:
    """Return positions east, north and up of the first one, in metres, without orientation, and their stamps in UTC.

    Lines are `date time lat lon height Q ...` or `week seconds lat lon height Q ...`, in GPS time, degrees and metres.
    Positions of a quality Q worse than `worst_quality` are left out.

    Raises:
        BagError: the file cannot be read or holds no position of that quality; names the wrong line.
    """
    stamps: list[int] = []
    geodetic: list[tuple[float, float, float]] = []
    for number, line in enumerate(read_lines(path, BagError), 1):
        if line.startswith("%") or not line.strip():
            continue
        try:
            stamp, latitude, longitude, height, quality = _parse(line.split())
        except (ValueError, IndexError, OverflowError):
            expected = "expected date time lat lon height Q"
            raise BagError(f"{path}, line {number}: {expected}, found {line.strip()[:60]!r}") from None
        if quality <= worst_quality and (not stamps or stamp > stamps[-1]):
            stamps.append(stamp)
            geodetic.append((latitude, longitude, height))
    if not stamps:
        raise BagError(f"{path} holds no position of quality {worst_quality} or better")
    positions = np.array(geodetic)
    poses = RigidTransform.from_translation(to_enu(positions, positions[0])).as_matrix()
    return Trajectory(np.array(stamps, np.int64), poses, has_orientation=False)


def _parse(fields: list[str]) -> tuple[int, float, float, float, int]:
    latitude, longitude, height = (float(field) for field in fields[2:5])
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and abs(height) < 1e5):
        raise ValueError("not a position on Earth")
    if "/" in fields[0]:
        gps_ns = int(np.datetime64(f"{fields[0].replace('/', '-')}T{fields[1]}", "ns").astype(np.int64))
    else:
        gps_ns = _checked((GPS_EPOCH_S + int(fields[0]) * 604_800) * 10**9 + round(float(fields[1]) * 1e9))
    return gps_ns - LEAP_SECONDS * 10**9, latitude, longitude, height, int(fields[5])
