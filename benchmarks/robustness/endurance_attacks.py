"""Messages that are whole and mean harm, for `endurance_fuzz.py`: each kind of attack varies with the seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

Rng = np.random.Generator
Attack = Callable[[Any, Rng], Any]

NUMBERS = [0.0, -0.0, 1e-40, 1e-3, 1.0, 1e4, 1e9, 1e18, 3e38, np.nan, np.inf, -np.inf]
SECONDS = [-(2**31), -1, 0, 1, 2**31 - 1]
NANOSECONDS = [0, 1, 10**9 - 1, 10**9, 2**32 - 1]
FLOAT32, FLOAT64 = 7, 8
SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, FLOAT32: 4, FLOAT64: 8}


def at(message: Any, stamp_ns: int) -> Any:
    """The message with another stamp."""
    stamp = replace(message.header.stamp, sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return replace(message, header=replace(message.header, stamp=stamp))


def _odd_stamp(message: Any, rng: Rng) -> Any:
    stamp = replace(message.header.stamp, sec=int(rng.choice(SECONDS)), nanosec=int(rng.choice(NANOSECONDS)))
    return replace(message, header=replace(message.header, stamp=stamp))


def _near_stamp(message: Any, rng: Rng) -> Any:
    """Twice, backwards, or out of the row by up to some seconds."""
    seconds = message.header.stamp.sec + int(rng.choice([-60, -2, -1, 0, 1, 5]))
    return replace(message, header=replace(message.header, stamp=replace(message.header.stamp, sec=seconds)))


def _long_name(message: Any, rng: Rng) -> Any:
    return replace(message, header=replace(message.header, frame_id=str(rng.choice(list("a/\u2603\0"))) * 10**6))


def _records(message: Any) -> Any:
    """(N, step) bytes of a cloud's points."""
    return np.frombuffer(bytes(message.data), np.uint8).reshape(-1, message.point_step).copy()


def _with_points(message: Any, xyz: Any, rng: Rng) -> Any:
    """A cloud of these points alone, in any numbers, order of bytes and layout that a driver may choose."""
    order, kind = rng.choice(["<", ">"]), int(rng.choice([FLOAT32, FLOAT64]))
    size, pad = SIZES[kind], int(rng.integers(0, 20))
    step = 3 * size + pad
    table = np.zeros((len(xyz), step), np.uint8)
    with np.errstate(over="ignore"):
        table[:, : 3 * size] = xyz.astype(f"{order}f{size}").view(np.uint8).reshape(len(xyz), -1)
    field = message.fields[0]
    fields = [
        replace(field, name=name, offset=i * size, datatype=kind, count=int(rng.integers(0, 2)))
        for i, name in enumerate("xyz")
    ]
    return replace(
        message,
        fields=fields,
        point_step=step,
        width=len(xyz),
        height=1,
        row_step=table.nbytes,
        is_bigendian=bool(order == ">"),
        data=table.ravel(),
    )


def _odd_points(message: Any, rng: Rng) -> Any:
    """A few odd numbers among sound ones, or nothing else."""
    xyz = rng.uniform(-20, 20, (int(rng.choice([1, 2, 3, 50, 2000])), 3))
    chosen = rng.random(xyz.shape) < rng.choice([0.01, 0.5, 1.0])
    xyz[chosen] = rng.choice(NUMBERS, int(chosen.sum()))
    return _with_points(message, xyz, rng)


def _poor_shape(message: Any, rng: Rng) -> Any:
    """Points of which no surface follows: in one spot, on a line, in a plane, on a lattice, around the sensor."""
    count = int(rng.choice([1, 3, 10, 1000]))
    shape = rng.integers(5)
    xyz = rng.uniform(-10, 10, (count, 3))
    xyz[:, shape % 3 :] = rng.uniform(-5, 5)
    if shape >= 3:
        xyz = np.round(rng.uniform(-2, 2, (count, 3))) * (shape - 2)
    return _with_points(message, xyz, rng)


def _odd_fields(message: Any, rng: Rng) -> Any:
    """Fields that lie over each other, come twice, are of other types, or outside."""
    fields = [
        replace(
            field,
            datatype=int(rng.choice([field.datatype, field.datatype, rng.integers(0, 10)])),
            offset=int(rng.choice([field.offset, field.offset, rng.integers(0, message.point_step), 2**32 - 1])),
            count=int(rng.choice([0, 1, 1, 1, 2**32 - 1])),
        )
        for field in message.fields
    ]
    return replace(message, fields=[fields[i] for i in rng.integers(0, len(fields), rng.choice([1, 5, 12, 300]))])


def _odd_rows(message: Any, rng: Rng) -> Any:
    """Rows, with padding or with sizes that do not agree."""
    records = _records(message)
    height = int(rng.choice([2, 3, 7]))
    width = len(records) // height
    padding = int(rng.choice([0, 1, 13]))
    rows = np.zeros((height, width * message.point_step + padding), np.uint8)
    rows[:, : width * message.point_step] = records[: width * height].reshape(height, -1)
    step = int(rng.choice([rows.shape[1], rows.shape[1], 0, 1, 2**32 - 1]))
    return replace(message, height=height, width=width, row_step=step, data=rows.ravel())


def _odd_times(message: Any, rng: Rng) -> Any:
    """Bytes of noise in one column: where times and intensities are, among others."""
    records = _records(message)
    first = int(rng.integers(0, message.point_step))
    column = records[:, first : first + 4]
    column[:] = rng.integers(0, 256, column.shape) if rng.random() < 0.5 else rng.choice([0, 127, 128, 255])
    return replace(message, data=records.ravel())


def _odd_pixels(message: Any, rng: Rng) -> Any:
    """An image of the right size without any, or nothing but, contrast."""
    value = rng.choice([0, 1, 127, 255])
    data = np.full(len(message.data), value, np.uint8)
    if rng.random() < 0.5:
        data[:: int(rng.choice([2, 3, 7]))] = 255 - value
    return replace(message, data=data)


def _odd_encoding(message: Any, rng: Rng) -> Any:
    """Encodings of all kinds, sized as they should be, in rows with padding."""
    kinds = {"mono8": 1, "8UC1": 1, "mono16": 2, "bgr8": 3, "rgba8": 4, "yuv422": 2, "yuyv": 2, "bayer_rggb8": 1}
    kinds |= {"16UC1": 2, "32FC1": 4, "nv12": 2, "MONO8": 1}
    encoding = str(rng.choice(list(kinds)))
    height, width = (int(side) for side in rng.choice([1, 2, 3, message.height, message.width], 2))
    if rng.random() < 0.7:
        height, width = message.height, message.width
    step = width * kinds[encoding] + int(rng.choice([0, 0, 5]))
    data = rng.integers(0, 256, step * height, np.uint8)
    return replace(message, encoding=encoding, height=height, width=width, step=step, data=data, is_bigendian=1)


def _other_camera(message: Any, rng: Rng) -> Any:
    """Another camera, one that can be built or not, in the middle of the drive."""
    scale = float(rng.choice([0.01, 0.5, 0.99, 1.0, 2.0, 100.0]))
    matrix = np.array(message.p, float) * scale
    matrix[int(rng.integers(12))] = float(rng.choice([*NUMBERS, *matrix]))
    size = (
        {"width": message.width, "height": message.height} if rng.random() < 0.8 else {"width": 1, "height": 2**32 - 1}
    )
    return replace(message, p=matrix, k=np.array(message.k, float) * scale, **size)


def _odd_pose(message: Any, rng: Rng) -> Any:
    """A pose that is none, or one far away."""
    inner = message.pose.pose
    position = {axis: float(rng.choice([0.0, 1e-300, 1e3, 9e6, 1e7, 1e200, np.nan, np.inf])) for axis in "xyz"}
    turn = dict(zip("xyzw", rng.choice([0.0, 0.5, 0.995, 1.0, -1.0, 1e-200, 1e200, np.nan], 4).tolist(), strict=True))
    if rng.random() < 0.6:
        turn = dict(zip("xyzw", (0.0, 0.0, 0.0, float(rng.choice([1.0, -1.0, 0.9901, 1.0099]))), strict=True))
    pose = replace(inner, position=replace(inner.position, **position), orientation=replace(inner.orientation, **turn))
    return replace(message, pose=replace(message.pose, pose=pose))


def _odd_covariance(message: Any, rng: Rng) -> Any:
    return replace(message, pose=replace(message.pose, covariance=rng.choice([*NUMBERS, -1.0, 1e308], 36)))


def _jump(message: Any, rng: Rng) -> Any:
    """Somewhere else, as a filter that is set anew."""
    inner = message.pose.pose
    shift = {axis: getattr(inner.position, axis) + float(rng.choice([0, 0, 3, -50, 1e5])) for axis in "xyz"}
    pose = replace(inner, position=replace(inner.position, **shift))
    return replace(message, pose=replace(message.pose, pose=pose))


EVERY: list[Attack] = [_odd_stamp, _near_stamp, _near_stamp, _long_name]
ATTACKS: dict[str, list[Attack]] = {
    "sensor_msgs/msg/PointCloud2": [_odd_points, _poor_shape, _odd_fields, _odd_rows, _odd_times],
    "sensor_msgs/msg/Image": [_odd_pixels, _odd_encoding],
    "sensor_msgs/msg/CameraInfo": [_other_camera],
    "nav_msgs/msg/Odometry": [_odd_pose, _odd_covariance, _jump],
}


def attacked(message: Any, rng: Rng) -> Any:
    """A message of a recording as somebody who means harm would send it."""
    own = ATTACKS[message.__msgtype__]
    attacks = own if rng.random() < 0.8 else EVERY
    return attacks[int(rng.integers(len(attacks)))](message, rng)
