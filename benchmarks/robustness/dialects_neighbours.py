"""Neighbours of the dialects: other axes, units, stamps, encodings and jumps, on the drive of `dialects_sensors.py`."""

from __future__ import annotations

import bz2
import gzip
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from dialect_case import Case, Check, Outcome, says
from dialects_recordings import case as recorded
from dialects_recordings import changed
from dialects_sensors import (
    CLOUD,
    LEFT,
    REPLAY,
    RIGHT,
    Change,
    closures,
    cloud_of,
    cut_out,
    informed,
    judged,
    paired,
    pictured,
    records_of,
    rewrite,
    stamp_of,
    timed,
)
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, invert, make_pose, to_quaternion
from umf_ros.sensors.decode import decode_pose

ODOMETRY, STATIC = "/odom", "/tf_static"


def withheld(text: str) -> Check:
    """Return a check that a line names the fault and no closure is believed."""

    def check(outcome: Outcome) -> tuple[bool, str]:
        told, line = says(text)(outcome)
        true, false = judged(outcome)
        return told and max(true, false) <= 0, f"{true} true, {false} false; {line}"

    return check


def none_false(text: str) -> Check:
    """Return a check that a line names the fault and no closure is false."""

    def check(outcome: Outcome) -> tuple[bool, str]:
        told, line = says(text)(outcome)
        true, false = judged(outcome)
        return told and false <= 0, f"{true} true, {false} false; {line}"

    return check


def altered(topics: tuple[str, ...], alter: Callable[[Any], Any], rows: slice = slice(None)) -> Change:
    """Messages of some topics altered in place, all or those of some rows; a result is used instead."""
    counts = dict.fromkeys(topics, 0)

    def change(topic: str, message: Any) -> Iterator[tuple[int, Any]]:
        if topic in topics:
            counts[topic] += 1
            if counts[topic] - 1 in range(10**9)[rows]:
                message = alter(message) or message
        yield 0, message

    return change


def points(axes: Array) -> Change:
    """Points times a matrix (3, 3)."""

    def alter(message: Any) -> Any:
        records = records_of(message).copy()
        moved = np.stack([records[name] for name in "xyz"], axis=1) @ axes.T
        for name, column in zip("xyz", moved.T, strict=True):
            records[name] = column
        return cloud_of(records, message)

    return altered((CLOUD,), alter)


def poses(move: Callable[[Array, int], Array], w_first: bool = False) -> Change:
    """Odometry with its poses (4, 4) moved, by pose and number of the message."""
    count = [0]

    def alter(message: Any) -> None:
        pose, place, turn = message.pose.pose, message.pose.pose.position, message.pose.pose.orientation
        moved = move(decode_pose(pose), count[0])
        count[0] += 1
        place.x, place.y, place.z = map(float, moved[:3, 3])
        quaternion = np.roll(to_quaternion(moved), int(w_first))
        turn.x, turn.y, turn.z, turn.w = map(float, quaternion)

    return altered((ODOMETRY,), alter)


def jump(metres: float, degrees: float, rows: tuple[int, ...]) -> Change:
    """Odometry that jumps to the left, and turns, at some messages."""
    step = make_pose(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), [0, metres, 0])
    return poses(lambda pose, row: np.linalg.matrix_power(step, sum(row >= one for one in rows)) @ pose)


def restamped(seconds: float, relative: bool = True) -> Callable[[Any], None]:
    """Return a change of the stamp by some seconds, or to this many since the epoch."""

    def alter(message: Any) -> None:
        moved_ns = round(seconds * 1e9) + (stamp_of(message) if relative else 0)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(moved_ns, 10**9)

    return alter


def mounted(move: Callable[[Array], Array], names: tuple[str, ...] = ("lidar",)) -> Change:
    """Mountings (4, 4) on /tf_static changed."""

    def alter(message: Any) -> None:
        for one in message.transforms:
            if one.child_frame_id in names:
                shift, turn = one.transform.translation, one.transform.rotation
                turn_by = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
                moved = move(make_pose(turn_by, [shift.x, shift.y, shift.z]))
                shift.x, shift.y, shift.z = map(float, moved[:3, 3])
                turn.x, turn.y, turn.z, turn.w = map(float, to_quaternion(moved))

    return altered((STATIC,), alter)


def slashed(message: Any) -> None:
    """Frames of tf1, which begin with a slash."""
    for one in message.transforms:
        one.header.frame_id, one.child_frame_id = f"/{one.header.frame_id}", f"/{one.child_frame_id}"


def without_lidar(message: Any) -> None:
    """No transform of the LiDAR, the last one."""
    message.transforms.pop()


def delayed(topics: tuple[str, ...], frames: int) -> Change:
    """Pictures of some frames before, under the stamps of now."""
    held: dict[str, list[Any]] = {topic: [] for topic in topics}

    def change(topic: str, message: Any) -> Iterator[tuple[int, Any]]:
        if topic in topics:
            held[topic].append(message.data)
            message.data = held[topic][max(0, len(held[topic]) - 1 - frames)]
        yield 0, message

    return change


def rings(count: int) -> Change:
    """Scans in so many bands of elevation, with one stamp."""

    def change(topic: str, message: Any) -> Iterator[tuple[int, Any]]:
        if topic != CLOUD:
            yield 0, message
            return
        records = records_of(message)
        up = np.arctan2(records["z"], np.hypot(records["x"], records["y"]))
        labels = np.argsort(np.argsort(up)) * count // len(records)
        for number in range(count):
            yield number * 1_000_000, cloud_of(records[labels == number], message)

    return change


def numbers(message: Any, pose: float, twist: float | None = None) -> None:
    """Odometry whose numbers are all one number."""
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    place.x = place.y = place.z = turn.x = turn.y = turn.z = turn.w = pose
    if twist is not None:
        for part in (message.twist.twist.linear, message.twist.twist.angular):
            part.x = part.y = part.z = twist


def biased(message: Any) -> None:
    """Only a twist, with a bias of the angular rate."""
    numbers(message, 0.0)
    message.twist.twist.angular.z += 0.003


def both(info: Any, is_right: bool) -> None:
    """Binning by 2 of a region of the sensor."""
    cut_out(info)
    info.binning_x = info.binning_y = 2
    for name in ("x_offset", "y_offset", "width", "height"):
        setattr(info.roi, name, 2 * getattr(info.roi, name))
    info.width, info.height, info.k[:6], info.p[:8] = info.width * 2, info.height * 2, info.k[:6] * 2, info.p[:8] * 2


def sizeless(info: Any, is_right: bool) -> None:
    """No size of the image."""
    info.width = info.height = 0


def empty(names: str, of_right: bool) -> Change:
    """Matrices of zeros, of the right camera alone or of both."""

    def alter(info: Any, is_right: bool) -> None:
        for name in names if is_right or not of_right else "":
            setattr(info, name, np.zeros_like(getattr(info, name)))

    return informed(alter)


def packed(compress: Callable[[bytes], bytes], name: str, folder: Path) -> None:
    """The drive in a file of a general compressor."""
    rewrite(lambda topic, message: iter([(0, message)]), folder)
    (folder / name).write_bytes(compress((folder / "drive.mcap").read_bytes()))
    (folder / "drive.mcap").unlink()


_COMPRESSIONS: dict[str, Callable[[bytes], bytes]] = {"gz": gzip.compress, "bz2": bz2.compress}


def _about(axis: str, degrees: float) -> Array:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def _case(name: str, change: Change, check: Check, expected: str) -> Case:
    return Case(f"n{name}", partial(rewrite, change), REPLAY, expected, check)


def _right(name: str, change: Change, text: str = "") -> Case:
    return _case(name, change, closures(text), "all closures, none false" + (f"; a line: {text}" if text else ""))


def _withheld(name: str, change: Change, text: str) -> Case:
    return _case(name, change, withheld(text), f"none believed; a line: {text}")


def _told(name: str, change: Change, text: str) -> Case:
    return _case(name, change, none_false(text), f"none false; a line: {text}")


DOWN, OPTICAL = np.diag([1.0, -1, -1]), np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
MOUNTING = "LiDAR's mounting is off"
ALONE = "the left camera is used alone"
EPOCH_NS = 1_625_644_800_000_000_000
CASES = [
    _withheld("01 LiDAR backwards", points(_about("z", 180)), MOUNTING),
    _withheld("01 LiDAR pitched by 30 deg", points(_about("y", 30)), MOUNTING),
    _withheld("01 LiDAR left-handed in x", points(np.diag([-1.0, 1, 1])), "left-handed"),
    _told("01 points in millimetres", points(1000 * np.eye(3)), "points have to be in metres"),
    _withheld("01 mounting inverted", mounted(invert), MOUNTING),
    _told("01 camera mounting inverted", mounted(invert, ("camera", "left_camera")), "camera's mounting is off"),
    _withheld("01 odometry w first", poses(lambda pose, _: pose, w_first=True), "odometry"),
    _told("01 odometry in millimetres", poses(lambda p, _: make_pose(p[:3, :3], 1e3 * p[:3, 3])), "position jump"),
    _withheld("01 odometry of the camera", poses(lambda p, _: p @ make_pose(OPTICAL.T, np.zeros(3))), "odometry"),
    _right("03 ns_epoch_f8", timed("timestamp", "<f8", lambda offsets, stamp: stamp + offsets)),
    _right("03 ms_u2", timed("time", "<u2", lambda offsets, stamp: offsets // 10**6)),
    _right("03 s_of_day_f8", timed("timestamp", "<f8", lambda o, s: (s % (86400 * 10**9) + o) * 1e-9)),
    _right("03 end_s_f4", timed("time", "<f4", lambda offsets, stamp: (offsets - offsets.max()) * 1e-9)),
    _right("03 us_i4", timed("offset_time", "<i4", lambda offsets, stamp: offsets // 1000)),
    recorded("n05 logged at once", changed(lambda raw: [replace(raw, log_ns=EPOCH_NS)])),
    recorded("n05 logged at half speed", changed(lambda raw: [replace(raw, log_ns=2 * raw.log_ns - EPOCH_NS)])),
    recorded("n05 logged in 1970", changed(lambda raw: [replace(raw, log_ns=raw.log_ns - EPOCH_NS)])),
    _right("05 scan of stamp 0", altered((CLOUD,), restamped(0, relative=False), slice(60, 61))),
    _right("05 odometry of stamp 0", altered((ODOMETRY,), restamped(0, relative=False), slice(60, 61))),
    _right("05 first odometry of stamp 0", altered((ODOMETRY,), restamped(0, relative=False), slice(0, 1))),
    _right("05 first scan an hour ahead", altered((CLOUD,), restamped(3600), slice(0, 1))),
    _right("05 scan 3 s behind", altered((CLOUD,), restamped(-3), slice(60, 61))),
    _right("06 binning and ROI", informed(both)),
    _right("06 no size", informed(sizeless)),
    _right("07 right P of zeros", empty("p", of_right=True), ALONE),
    _right("07 right K of zeros", empty("k", of_right=True)),
    _right("07 P of zeros", empty("p", of_right=False), ALONE),
    _right("07 baseline of 20 m", paired({}, {3: -579.5 * 20}), ALONE),
    _told("08 pose of NaN", altered((ODOMETRY,), lambda message: numbers(message, np.nan)), "is not finite"),
    _told(
        "08 nothing filled", altered((ODOMETRY,), lambda message: numbers(message, 0.0, 0.0)), "not a unit quaternion"
    ),
    _right("08 twist only with a biased gyroscope", altered((ODOMETRY,), biased)),
    _right("10 frames with a slash", altered((STATIC,), slashed)),
    _told("10 no LiDAR", altered((STATIC,), without_lidar), "does not say where lidar is"),
    *(
        Case(
            f"n11 {end}", partial(packed, make, f"a.mcap.{end}"), ("replay", f"a.mcap.{end}"), f"names {end}", says(end)
        )
        for end, make in _COMPRESSIONS.items()
    ),
    *(_case(f"12 {count} bands", rings(count), closures(), "all closures, none false") for count in (2, 16)),
    _right("13 mono16 of 10 bits at the top", pictured("mono16", lambda grey: grey.astype("<u2") // 4 * 256)),
    _right("13 rgb16", pictured("rgb16", lambda grey: np.repeat(grey[..., None].astype("<u2") * 257, 3, axis=2))),
    _right("13 bgra8", pictured("bgra8", lambda grey: np.repeat(grey[..., None], 4, axis=2))),
    _right("13 32FC1", pictured("32FC1", lambda grey: grey.astype("<f4") / 255)),
    _right("13 bayer_gbrg8", pictured("bayer_gbrg8", lambda grey: grey)),
    _right("14 jump of 0.5 m", jump(0.5, 0, (600,))),
    _right("14 jump of 1.9 m", jump(1.9, 0, (600,))),
    _right("14 jump of 20 deg", jump(0, 20, (600,))),
    _right("14 jump of 1 m during a scan of a match", jump(1, 0, (135,))),
    _right("14 jump of 8 deg during a scan of a match", jump(0, 8, (135,))),
    _right("14 two jumps of 1 m", jump(1, 0, (400, 700))),
    _told("20 left image late", delayed((LEFT,), 1), "images"),
    _right("20 right image two frames late", delayed((RIGHT,), 2)),
    _told("20 both images late", delayed((LEFT, RIGHT), 2), "the camera's clock is about"),
]
