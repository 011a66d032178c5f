"""Write simulated measurements as ROS messages into a recording."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_typestore

from umf_ros.bags.reader import message_types
from umf_ros.core.errors import OutputError, writing
from umf_ros.core.frames import StereoCamera
from umf_ros.core.geometry import Array, to_quaternion
from umf_ros.core.io import atomic_write

_COUNTS = ("intensity", "ambient_light", "point_id", "point_time_offset")
CLOUD_TYPE = np.dtype([*((axis, "<f4") for axis in "xyz"), *((name, "<u4") for name in _COUNTS)])
"""The 28 bytes of a Blickfeld point; the time is in ns after the stamp of the message."""

_TYPES = message_types().types
_DATATYPES = {"f": 7, "u": 6}
"""Of float32 and uint32 in a PointField."""


def _new(kind: str, **values: Any) -> Any:
    return _TYPES[kind](**values)


def _header(stamp_ns: int, frame: str) -> Any:
    sec, nanosec = divmod(int(stamp_ns), 10**9)
    stamp = _new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _vector(values: Array) -> Any:
    return _new("geometry_msgs/msg/Vector3", x=float(values[0]), y=float(values[1]), z=float(values[2]))


def _pose(pose: Array) -> Any:
    position = _new("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, pose[:3, 3]), strict=True)))
    turn = _new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, to_quaternion(pose)), strict=True)))
    return _new("geometry_msgs/msg/Pose", position=position, orientation=turn)


def image_message(image: NDArray[Any], stamp_ns: int, frame: str, encoding: str = "mono8") -> Any:
    """sensor_msgs/Image of a (H, W) picture whose type fits the encoding."""
    height, width = image.shape
    return _new(
        "sensor_msgs/msg/Image",
        header=_header(stamp_ns, frame),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=width * image.itemsize,
        data=np.ascontiguousarray(image).view(np.uint8).reshape(-1),
    )


def camera_info_message(camera: StereoCamera, stamp_ns: int, frame: str, right: bool) -> Any:
    """sensor_msgs/CameraInfo of one of a rectified pair; the right one's P[3] is -fx * baseline."""
    k = [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]
    shift = -camera.fx * camera.baseline if right else 0.0
    p = [camera.fx, 0, camera.cx, shift, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
    whole = _new("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return _new(
        "sensor_msgs/msg/CameraInfo",
        header=_header(stamp_ns, frame),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=np.array(k, float),
        r=np.eye(3).ravel(),
        p=np.array(p, float),
        binning_x=0,
        binning_y=0,
        roi=whole,
    )


def packed_cloud(records: NDArray[Any], stamp_ns: int, is_dense: bool) -> Any:
    """sensor_msgs/PointCloud2 in the frame `lidar` of records, whose fields are of four bytes."""
    fields = [
        _new("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=_DATATYPES[kind.kind], count=1)
        for name, (kind, offset, *_) in (records.dtype.fields or {}).items()
    ]
    return _new(
        "sensor_msgs/msg/PointCloud2",
        header=_header(stamp_ns, "lidar"),
        height=1,
        width=len(records),
        fields=fields,
        is_bigendian=False,
        point_step=records.itemsize,
        row_step=records.itemsize * len(records),
        data=records.view(np.uint8).reshape(-1),
        is_dense=is_dense,
    )


def cloud_message(scan: Any, stamp_ns: int) -> Any:
    """sensor_msgs/PointCloud2 of all pulses of a `lidar.Scan`; those without a return: points at 1 m, intensity 0."""
    records = np.empty(len(scan.points), CLOUD_TYPE)
    records["x"], records["y"], records["z"] = scan.points.T
    records["intensity"], records["ambient_light"] = scan.intensity, scan.ambient
    records["point_id"] = np.arange(len(records))
    records["point_time_offset"] = scan.offset_ns
    return packed_cloud(records, stamp_ns, is_dense=False)


def imu_message(rate: Array, force: Array, stamp_ns: int) -> Any:
    """sensor_msgs/Imu without an orientation."""
    unknown = np.zeros(9)
    unknown[0] = -1
    return _new(
        "sensor_msgs/msg/Imu",
        header=_header(stamp_ns, "imu"),
        orientation=_new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=unknown,
        angular_velocity=_vector(rate),
        angular_velocity_covariance=np.eye(3).ravel() * 4e-6,
        linear_acceleration=_vector(force),
        linear_acceleration_covariance=np.eye(3).ravel() * 4e-4,
    )


def odometry_message(pose: Array, twist: Array, deviations: Array, stamp_ns: int, frames: tuple[str, str]) -> Any:
    """nav_msgs/Odometry; `deviations` are those of position (m) and heading (rad), `frames` parent and child."""
    variance = np.repeat(np.asarray(deviations) ** 2, 3)
    variance[3:5] = 1e-6  # gravity keeps roll and pitch
    return _new(
        "nav_msgs/msg/Odometry",
        header=_header(stamp_ns, frames[0]),
        child_frame_id=frames[1],
        pose=_new("geometry_msgs/msg/PoseWithCovariance", pose=_pose(pose), covariance=np.diag(variance).ravel()),
        twist=_new(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=_new("geometry_msgs/msg/Twist", linear=_vector(twist[:3]), angular=_vector(twist[3:])),
            covariance=np.eye(6).ravel() * 1e-3,
        ),
    )


def pose_message(pose: Array, stamp_ns: int, frame: str) -> Any:
    """geometry_msgs/PoseStamped."""
    return _new("geometry_msgs/msg/PoseStamped", header=_header(stamp_ns, frame), pose=_pose(pose))


def transforms_message(mounted: Mapping[str, Array], stamp_ns: int) -> Any:
    """tf2_msgs/TFMessage of the poses (4, 4) of frames on `base_link`."""
    found = []
    for name, pose in mounted.items():
        shift, turn = _vector(pose[:3, 3]), _pose(pose).orientation
        moved = _new("geometry_msgs/msg/Transform", translation=shift, rotation=turn)
        header = _header(stamp_ns, "base_link")
        found.append(_new("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=name, transform=moved))
    return _new("tf2_msgs/msg/TFMessage", transforms=found)


def fix_message(geodetic: Array, deviation_m: float, stamp_ns: int) -> Any:
    """sensor_msgs/NavSatFix of latitude, longitude (deg) and height (m)."""
    return _new(
        "sensor_msgs/msg/NavSatFix",
        header=_header(stamp_ns, "gnss"),
        status=_new("sensor_msgs/msg/NavSatStatus", status=2, service=1),
        latitude=float(geodetic[0]),
        longitude=float(geodetic[1]),
        altitude=float(geodetic[2]),
        position_covariance=np.diag([1.0, 1.0, 4.0]).ravel() * deviation_m**2,
        position_covariance_type=2,
    )


class Recorder(Protocol):
    """A recording in the making."""

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Append a message that is recorded at `stamp_ns`."""

    def note(self, name: str, facts: dict[str, str]) -> None:
        """Keep facts about the recording, where there is room for them."""


class _FileWriter:
    """A file in the making: it gets its name when the context ends well; when it ends in an error nothing is left."""

    def __init__(self, path: Path) -> None:
        self.path, self._opened = path, ExitStack()
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        self._unfinished = self._opened.enter_context(atomic_write(path))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._opened.__exit__(*error)


class Ros1Writer(_FileWriter):
    """Writes a ROS 1 bag with LZ4 chunks, as S3LI's are; the drive's clock is shifted to the day of the recording.

    `header.seq` counts the messages of each topic.
    """

    def __init__(self, path: Path, shift_ns: int = 0, watch: Callable[[str, Any], None] = lambda *_: None) -> None:
        """Write to `path`, which must not exist; `watch` sees every topic and message.

        Raises:
            OutputError: the folder cannot be written.
        """
        super().__init__(path)
        self._shift_ns, self._watch = shift_ns, watch
        self._noetic = get_typestore(Stores.ROS1_NOETIC)
        self._connections: dict[str, tuple[Any, Iterator[int]]] = {}
        self._writer = Writer1(self._unfinished)
        self._writer.set_compression(Writer1.CompressionFormat.LZ4)
        with writing(path):
            self._writer.open()
        self._opened.callback(self._writer.close)

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Append a message with a header; raises an `OutputError` when the disk is full."""
        self._watch(topic, message)
        store, kind = message_types(), message.__msgtype__
        if topic not in self._connections:
            connection = self._writer.add_connection(topic, kind, typestore=self._noetic)
            self._connections[topic] = connection, count()
        connection, numbers = self._connections[topic]
        data = bytearray(store.cdr_to_ros1(store.serialize_cdr(message, kind), kind))
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec + self._shift_ns
        struct.pack_into("<III", data, 0, next(numbers), *divmod(stamp, 10**9))
        with writing(self.path):
            self._writer.write(connection, stamp_ns + self._shift_ns, bytes(data))

    def note(self, name: str, facts: dict[str, str]) -> None:
        """Do nothing: these bags hold no facts."""


class BagWriter(_FileWriter):
    """Writes an mcap file that ROS 2 tools and players open; its messages are those of rosbags' ROS 2 Jazzy store."""

    def __init__(self, path: str | Path) -> None:
        """Open `path` for writing; an older file there is replaced at the end.

        Raises:
            OutputError: the folder cannot be written.
        """
        path = Path(path)
        if path.is_dir():
            raise OutputError(f"cannot write {path}: it is a folder")
        super().__init__(path)
        self._channels: dict[str, tuple[int, str]] = {}
        self._counts: dict[str, int] = {}
        with self._opened:
            stream = self._unfinished.open("wb")
            self._opened.callback(stream.close)
            self._writer = Writer(stream, compression=CompressionType.LZ4)
            self._writer.start("ros2", "umf_ros")
            self._opened.callback(self._writer.finish)
            self._opened = self._opened.pop_all()

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Append a message.

        Args:
            topic: its topic; every message of a topic has the same type.
            message: an instance of one of the store's types.
            stamp_ns: time of recording.

        Raises:
            OutputError: the disk is full, or the topic holds another type.
        """
        channel, kind = self._channels.get(topic) or self._add_channel(topic, message.__msgtype__)
        if kind != message.__msgtype__:
            raise OutputError(f"{topic} holds {kind}, not {message.__msgtype__}")
        sequence = self._counts[topic] = self._counts.get(topic, -1) + 1
        data = bytes(message_types().serialize_cdr(message, kind))
        with writing(self.path):
            self._writer.add_message(channel, stamp_ns, data, stamp_ns, sequence)

    def note(self, name: str, facts: dict[str, str]) -> None:
        """Keep facts about the recording in the file, as an mcap metadata record."""
        with writing(self.path):
            self._writer.add_metadata(name, facts)

    def _add_channel(self, topic: str, kind: str) -> tuple[int, str]:
        definition, _ = message_types().generate_msgdef(kind)
        schema = self._writer.register_schema(kind, "ros2msg", definition.encode())
        self._channels[topic] = self._writer.register_channel(topic, "cdr", schema), kind
        return self._channels[topic]
