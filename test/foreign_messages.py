"""The drive of `recordings.traverse` as other drivers would have recorded it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
from recordings import CLOUD, LEFT, RIGHT, Entry, cloud, make, traverse
from rosbags.typesys.store import Typestore

from umf_ros.bags.reader import message_types

STORE: Typestore = message_types()
LIVOX = "livox_ros_driver2/msg/CustomMsg"
OUSTER = np.dtype(
    {
        "names": ["x", "y", "z", "reflectivity", "t"],
        "formats": ["<f4", "<f4", "<f4", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20],
        "itemsize": 32,
    }
)
HESAI = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("timestamp", "<f8")])
VELODYNE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("time", "<f4")])


def pixels_of(message: Any) -> np.ndarray:
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width)


def points_of(message: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) m and their times (N,) ns after the stamp, of a cloud of `recordings`."""
    from recordings import POINT

    records = np.frombuffer(message.data, POINT)
    return np.column_stack([records["x"], records["y"], records["z"]]), records["point_time_offset"].astype(np.int64)


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def compressed(message: Any, kind: str = "png") -> Any:
    _, data = cv2.imencode(f".{kind}", pixels_of(message))
    return make(
        "sensor_msgs/msg/CompressedImage", header=message.header, format=f"mono8; {kind} compressed", data=data.ravel()
    )


def livox(message: Any) -> Any:
    points, times = points_of(message)
    of = STORE.types["livox_ros_driver2/msg/CustomPoint"]
    rows = [
        of(offset_time=int(time), x=float(x), y=float(y), z=float(z), reflectivity=100, tag=0, line=0)
        for (x, y, z), time in zip(points, times, strict=True)
    ]
    return STORE.types[LIVOX](
        header=message.header, timebase=0, point_num=len(rows), lidar_id=0, rsvd=np.zeros(3, np.uint8), points=rows
    )


def relaid(message: Any, layout: np.dtype[Any]) -> Any:
    """The cloud with the fields of another driver."""
    points, times = points_of(message)
    records = np.zeros(len(points), layout)
    records["x"], records["y"], records["z"] = points.T
    records["reflectivity" if "reflectivity" in layout.names else "intensity"] = 100
    if "t" in layout.names:
        records["t"] = times
    elif "time" in layout.names:
        records["time"] = times * 1e-9
    else:
        records["timestamp"] = (stamp_of(message) + times) * 1e-9
    return cloud(stamp_of(message), records)


def drive(images: Any = None, clouds: Any = None, seconds: float = 3.0) -> Iterable[Entry]:
    """The drive, its images and clouds as these functions make them."""
    for topic, at, message in traverse(seconds):
        if topic in (LEFT, RIGHT) and images is not None:
            yield f"{topic}/compressed" if images is compressed else topic, at, images(message)
        elif topic == CLOUD and clouds is not None:
            yield topic, at, clouds(message)
        else:
            yield topic, at, message
