"""Trajectories: of odometry and ground truth, from files and recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from umf_ros.bags.presets import GROUND_TRUTH_TOPIC
from umf_ros.bags.reader import Bag
from umf_ros.bags.rtklib import read_rtklib
from umf_ros.bags.textfiles import read_lines
from umf_ros.config import Settings
from umf_ros.errors import BagError, MessageError, OutputError
from umf_ros.geometry import Array, make_pose, to_quaternion
from umf_ros.sensors.calibration import load_calibration
from umf_ros.sensors.messages import decode_pose, stamp_ns

MAX_GAP_S = 2.0
"""Nothing is interpolated across a longer gap."""


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

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def at(self, stamps_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Interpolated (K, 4, 4) poses at (K,) stamps, and (K,) whether each is known.

        Positions are interpolated linearly, rotations along the shortest arc. A pose is known between
        two poses no further apart than `MAX_GAP_S`; the others are the identity.
        """
        stamps = np.asarray(stamps_ns, np.int64)
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        if not len(self):
            return poses, np.zeros(len(stamps), bool)
        after = np.clip(np.searchsorted(self.stamps_ns, stamps), 0, len(self) - 1)
        exact = self.stamps_ns[after] == stamps
        before = np.where(exact, after, after - 1)
        known = (before >= 0) & (stamps <= self.stamps_ns[-1])
        known &= self.stamps_ns[after] - self.stamps_ns[before] <= MAX_GAP_S * 1e9
        if len(self) == 1:
            poses[known] = self.poses[0]
        elif known.any():
            # relative to the first stamp: nanoseconds since the epoch do not fit a float
            times, wanted = ((s - self.stamps_ns[0]).astype(float) for s in (self.stamps_ns, stamps[known]))
            poses[known, :3, :3] = Slerp(times, Rotation.from_matrix(self.poses[:, :3, :3]))(wanted).as_matrix()
            for axis in range(3):
                poses[known, axis, 3] = np.interp(wanted, times, self.poses[:, axis, 3])
        return poses, known

    def of_body(self, body_T_sensor: Array) -> Trajectory:
        """Poses of the body, where these are of a sensor on it (as SLAM systems give the IMU's or the camera's)."""
        return Trajectory(self.stamps_ns, self.poses @ np.linalg.inv(body_T_sensor), self.has_orientation)


def read_tum(path: str | Path) -> Trajectory:
    """Trajectory from a TUM file: `seconds x y z qx qy qz qw` per line, # for comments.

    Raises:
        BagError: the file cannot be read; names the line that is wrong.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(read_lines(path), 1):
        fields = line.split()
        if not fields or line.lstrip().startswith("#"):
            continue
        try:
            stamp, row = _to_ns(fields[0]), [float(field) for field in fields[1:]]
        except ValueError:
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
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
    poses[:, :3, 3] = values[:, :3]
    return Trajectory(np.array(stamps, np.int64), poses)


def read_odometry(path: str | Path, frame: str, settings: Settings) -> Trajectory:
    """Odometry of the body from a TUM file of the poses of `frame`: body, imu, camera or lidar.

    Raises:
        BagError: the file cannot be read, or there is no such frame.
        CalibrationError: the mounting of the frame is not known.
    """
    calibration = load_calibration(settings.calibration or settings.dataset)
    mountings = {
        "body": np.eye(4),
        "imu": calibration.body_T_imu,
        "camera": calibration.body_T_camera,
        "lidar": calibration.body_T_lidar,
    }
    if frame not in mountings:
        raise BagError(f"unknown frame {frame!r} of the odometry; expected one of {', '.join(mountings)}")
    return read_tum(path).of_body(mountings[frame])


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM file, with the stamps to the nanosecond.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = []
    for stamp, pose in zip(trajectory.stamps_ns, trajectory.poses, strict=True):
        numbers = " ".join(f"{value:.9f}" for value in (*pose[:3, 3], *to_quaternion(pose)))
        lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d} {numbers}\n")
    try:
        Path(path).write_text("".join(lines), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from None


def read_ground_truth(bag: Bag | None, path: str | Path | None = None) -> Trajectory | None:
    """Ground truth from a file (RTKLIB .pos or TUM), else from the recording, else None.

    Raises:
        BagError: the file cannot be read or is wrong.
    """
    if path is not None:
        if Path(path).suffix.lower() != ".pos":
            return read_tum(path)
        stamps, positions = read_rtklib(path)
        poses = np.stack([make_pose(np.eye(3), position) for position in positions])
        return Trajectory(stamps, poses, has_orientation=False)
    if bag is None or GROUND_TRUTH_TOPIC not in bag.topics:
        return None
    return _recorded_truth(bag)


def _recorded_truth(bag: Bag) -> Trajectory | None:
    """The first session of the truth that the simulator records as geometry_msgs/PoseStamped."""
    stamps: list[int] = []
    poses: list[Array] = []
    for _, _, message in bag.messages([GROUND_TRUTH_TOPIC]):
        try:
            stamp, pose = stamp_ns(message), decode_pose(message.pose)
        except MessageError as error:
            raise BagError(f"{bag.path}: ground truth holds a {error}") from None
        if not stamps or stamp > stamps[-1]:
            stamps.append(stamp)
            poses.append(pose)
    return Trajectory(np.array(stamps, np.int64), np.stack(poses)) if stamps else None


def _to_ns(seconds: str) -> int:
    """Nanoseconds of decimal seconds, without the rounding of a float."""
    if not seconds.replace(".", "", 1).isdigit():  # as 1.6e9, or negative
        return round(float(seconds) * 1e9)
    whole, _, fraction = seconds.partition(".")
    return int(whole or 0) * 10**9 + int(fraction[:9].ljust(9, "0"))
