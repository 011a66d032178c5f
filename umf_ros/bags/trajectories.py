"""Trajectories of odometry and ground truth, from files and recordings."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable
from decimal import Decimal
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from umf_ros.bags.presets import GROUND_TRUTH_TOPIC
from umf_ros.bags.reader import Bag, RawMessage, decode
from umf_ros.core.config import Settings
from umf_ros.core.errors import BagError, MessageError
from umf_ros.core.geometry import Array, to_enu
from umf_ros.core.io import read_lines
from umf_ros.core.trajectory import Trajectory
from umf_ros.sensors.calibration import calibration_of
from umf_ros.sensors.decode import LAST_STAMP_NS, decode_pose, stamp_ns

logger = logging.getLogger(__name__)
KITTI, FEW_POSES, PIECES = 12, 9, 100
"""Numbers in a line of KITTI's poses; poses whose rotation may be equal by chance; pieces of a path, by hand."""
ALONG, CLEARLY, CURVED = 0.8, 0.2, 0.05
"""By hand: share of the motion along one axis of a rover's body, by how much a right order of w is better, and width of
a path by its length, of one that turns."""
GPS_EPOCH_S, LEAP_SECONDS = 315_964_800, 18
"""1980-01-06 in POSIX seconds; GPS time is ahead of UTC by this much since 2017."""
WORST_QUALITY = 2
"""Worst accepted quality: 1 is a fixed, 2 a floating ambiguity; others err by metres."""


def read_tum(path: str | Path) -> Trajectory:
    """Return the trajectory from a text file: `stamp x y z qx qy qz qw` per line, or `stamp x y z` without rotations.

    Stamps are seconds, milli-, micro- or nanoseconds. Numbers are separated by blanks, commas or semicolons; a line of
    names before them gives their order, else further columns are left out. # and % begin comments. Lines with NaN are
    left out. Rotations that never change while the positions do are unknown.

    Raises:
        BagError: the file cannot be read; names the wrong line.
    """
    columns, is_named = list[int](), False
    found: list[tuple[int, Decimal, list[float]]] = []
    for number, line in enumerate(read_lines(path, BagError), 1):
        if names := _named_columns(line) if "q" in line.lower() else None:
            columns, is_named = names, True
        if not line.strip() or names or line.lstrip()[0] in "#%":
            continue
        fields = _split(line)
        columns = columns or list(range(4 if len(fields) == 4 else 8))
        if len(fields) <= max(columns) or (len(fields) == KITTI and not is_named):
            expected = "8 numbers (stamp x y z qx qy qz qw; KITTI's poses have no stamps)"
            raise BagError(f"{path}, line {number}: expected {expected}, found {len(fields)}")
        try:
            stamp, row = Decimal(fields[columns[0]]), [float(fields[column]) for column in columns[1:]]
            found.append((number, stamp if stamp.is_finite() else Decimal(""), row))
        except (ValueError, ArithmeticError):
            raise BagError(f"{path}, line {number}: expected numbers, found {line.strip()[:60]!r}") from None
    known = [one for one in found if np.isfinite(one[2]).all()]
    if not known:
        raise BagError(f"{path} holds no pose")
    if len(known) < len(found):
        logger.warning("%s: %d lines without a pose (NaN) are left out", path, len(found) - len(known))
    return _as_trajectory(path, known, is_named)


def _named_columns(line: str) -> list[int] | None:
    """Return the columns of stamp, x, y, z, qx, qy, qz, qw in a line of their names; None of other lines."""
    names = [re.sub("[^a-z]", "", name) for name in _split(re.sub(r"\[[^][]*\]|^\s*[#%]", "", line.lower()))[:100]]
    times = [k for k, name in enumerate(names) if name == "t" or name.startswith(("time", "stamp", "sec"))]
    places = [[k for k, name in enumerate(names) if name[:1] != "q" and name.endswith(axis)] for axis in "xyz"]
    turns = [[k for k, name in enumerate(names) if name[:1] == "q" and name.endswith(axis)] for axis in "xyzw"]
    chosen = [times, *places, *turns]
    return [one[0] for one in chosen] if all(chosen) else None


def _split(line: str) -> list[str]:
    if re.search(r"\d,\d", line) and (";" in line or len(line.split()) > 3):
        line = line.replace(",", ".")  # decimal commas
    return re.split(" ?[,;] ?| ", " ".join(line.strip(" \t\r\n,;").split()))


def _as_trajectory(path: str | Path, found: list[tuple[int, Decimal, list[float]]], is_named: bool) -> Trajectory:
    """Return the poses of lines (number, stamp, x y z qx qy qz qw); w may be first unless the order `is_named`."""
    size = float(np.median([abs(float(stamp)) for _, stamp, _ in found]))
    unit = next(unit for unit, limit in ((10**9, 1e11), (10**6, 1e14), (1000, 1e17), (1, np.inf)) if size < limit)
    kept = [one for k, one in enumerate(found) if one[1:] != found[k - 1][1:] or not k]  # written twice
    stamps, values = [int(stamp * unit) for _, stamp, _ in kept], np.array([row for *_, row in kept])
    for (number, stamp, _), before, now in zip(kept, [-LAST_STAMP_NS, *stamps], stamps, strict=False):
        if not before < now < LAST_STAMP_NS:
            why = "is not later than the one before" if now <= before else "is later than any time of ROS"
            raise BagError(f"{path}, line {number}: the stamp {stamp} {why}")
    positions, turns = values[:, :3], values[:, 3:]
    if not turns.any() or (len(turns) > FEW_POSES and not np.ptp(turns, axis=0).any()):
        poses = RigidTransform.from_translation(positions).as_matrix()
        return Trajectory(np.array(stamps, np.int64), poses, has_orientation=False)
    wrong = np.flatnonzero(np.abs(np.linalg.norm(turns, axis=1) - 1) > 0.01)
    if len(wrong):
        raise BagError(f"{path}, line {kept[wrong[0]][0]}: not a pose (no unit quaternion)")
    if not is_named and _is_w_first(positions, turns):
        logger.warning("%s: quaternions are read with w first, as the motion shows; a header qx qy qz qw decides", path)
        turns = np.roll(turns, -1, axis=1)
    poses = RigidTransform.from_components(positions, Rotation.from_quat(turns)).as_matrix()
    return Trajectory(np.array(stamps, np.int64), poses)


def _is_w_first(positions: Array, quaternions: Array) -> bool:
    """Return whether the body moves along one axis of its own if w is first in quaternions (N, 4), and not if last."""
    rows = np.unique(np.linspace(0, len(positions) - 1, PIECES + 1).astype(int))
    moved = np.diff(positions[rows], axis=0)
    lengths = np.linalg.norm(moved, axis=1, keepdims=True)
    far = (len(lengths) * lengths > 0.2 * lengths.sum())[:, 0]  # no mean: a single pose has no steps
    directions = moved[far] / lengths[far]
    orders = (np.roll(quaternions, -first, axis=1)[rows[:-1][far]] for first in (0, 1))
    seen = [Rotation.from_quat(turns).inv().apply(directions) for turns in orders]
    last, first = (np.linalg.eigvalsh(one.T @ one / max(len(one), 1))[-1] for one in seen)
    return len(directions) > FEW_POSES and bool(first > max(ALONG, last + CLEARLY))


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
    if frame in calibration.lacks:
        raise BagError(f"the odometry is of the {frame}, and the calibration has no body_T_{frame}")
    found = read_tum(path)
    if len(found) < 2:
        raise BagError(f"{path} holds a single pose, which is no odometry")
    sizes_m = np.linalg.svd(found.poses[:, :3, 3] - found.poses[:, :3, 3].mean(axis=0), compute_uv=False)
    if not found.has_orientation and sizes_m[1:].max(initial=0) > CURVED * sizes_m[0]:
        raise BagError(f"{path} has no rotations (none, or the same in every line): odometry needs them")
    return found.of_body(mountings[frame])


def read_ground_truth(bag: Bag | None, path: str | Path | None = None) -> Trajectory | None:
    """Return the ground truth of a file (RTKLIB .pos or TUM), else of the recording's topic of the simulator, or None.

    Raises:
        BagError: the file cannot be read or has a wrong line.
    """
    if path is not None:
        return read_rtklib(path) if Path(path).suffix.lower() == ".pos" else read_tum(path)
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
        gps_ns = (GPS_EPOCH_S + int(fields[0]) * 604_800) * 10**9 + round(float(fields[1]) * 1e9)
    if abs(gps_ns) >= LAST_STAMP_NS:
        raise OverflowError("beyond the last stamp")
    return gps_ns - LEAP_SECONDS * 10**9, latitude, longitude, height, int(fields[5])
