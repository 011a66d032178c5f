"""Messages and small recordings for tests, made without ROS."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from umf_ros.core.config import Settings, load_settings
from umf_ros.core.geometry import Array, make_pose, to_quaternion

STORE = get_typestore(Stores.ROS2_JAZZY)
START_NS = 1_625_680_800_000_000_000
LEFT, RIGHT, CLOUD, ODOMETRY = "/stereo/left/image_rect", "/stereo/right/image_rect", "/bf_lidar/points_raw", "/odom"
LEFT_INFO, RIGHT_INFO, TRUTH = "/stereo/left/camera_info", "/stereo/right/camera_info", "/ground_truth/pose"

# what one Cube-1 point holds: 28 bytes
POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ambient_light", "point_id", "point_time_offset"],
        "formats": ["<f4", "<f4", "<f4", "<u4", "<u4", "<u4", "<u4"],
        "offsets": [0, 4, 8, 12, 16, 20, 24],
        "itemsize": 28,
    }
)
_CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

Entry = tuple[str, int, Any]


def make(kind: str, store: Any = STORE, /, **fields: Any) -> Any:
    return store.types[kind](**fields)


def header(stamp_ns: int, frame_id: str = "sensor", store: Any = STORE) -> Any:
    stamp = make("builtin_interfaces/msg/Time", store, sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    sequence = {"seq": 0} if "seq" in store.types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    return make("std_msgs/msg/Header", store, stamp=stamp, frame_id=frame_id, **sequence)


def transform(parent: str, child: str, pose: Array) -> Any:
    """A TransformStamped."""
    x, y, z = map(float, pose[:3, 3])
    turn = dict(zip("xyzw", map(float, to_quaternion(pose)), strict=True))
    moved = make(
        "geometry_msgs/msg/Transform",
        translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        rotation=make("geometry_msgs/msg/Quaternion", **turn),
    )
    kind = "geometry_msgs/msg/TransformStamped"
    return make(kind, header=header(START_NS, parent), child_frame_id=child, transform=moved)


def image(stamp_ns: int, pixels: np.ndarray, encoding: str = "mono8", store: Any = STORE, **changes: Any) -> Any:
    fields = {
        "header": header(stamp_ns, store=store),
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": pixels[0].nbytes,
        "data": np.frombuffer(pixels.tobytes(), np.uint8),
    }
    return make("sensor_msgs/msg/Image", store, **(fields | changes))


def cloud(stamp_ns: int, records: np.ndarray, store: Any = STORE, **changes: Any) -> Any:
    names = records.dtype.fields or {}
    fields = [
        make("sensor_msgs/msg/PointField", store, name=name, offset=offset, datatype=_CODES[dtype.str[1:]], count=1)
        for name, (dtype, offset) in names.items()
    ]
    first = next(iter(names.values()))[0]
    values = {
        "header": header(stamp_ns, store=store),
        "height": 1,
        "width": len(records),
        "fields": fields,
        "is_bigendian": first.str[0] == ">",
        "point_step": records.dtype.itemsize,
        "row_step": records.nbytes,
        "data": np.frombuffer(records.tobytes(), np.uint8),
        "is_dense": False,
    }
    return make("sensor_msgs/msg/PointCloud2", store, **(values | changes))


def scan(points: np.ndarray, intensity: int = 100, duration_ns: int = 0) -> np.ndarray:
    """(N,) points of the Cube-1 in the order of their measurement."""
    records = np.zeros(len(points), POINT)
    records["x"], records["y"], records["z"] = points.T
    records["intensity"] = intensity
    records["point_id"] = np.arange(len(points))
    records["point_time_offset"] = np.linspace(0, duration_ns, len(points)) if len(points) else 0
    return records


def pose(matrix: Array, store: Any = STORE) -> Any:
    x, y, z = (float(value) for value in matrix[:3, 3])
    qx, qy, qz, qw = (float(value) for value in to_quaternion(matrix))
    position = make("geometry_msgs/msg/Point", store, x=x, y=y, z=z)
    return make(
        "geometry_msgs/msg/Pose",
        store,
        position=position,
        orientation=make("geometry_msgs/msg/Quaternion", store, x=qx, y=qy, z=qz, w=qw),
    )


def odometry(stamp_ns: int, matrix: Array, store: Any = STORE) -> Any:
    zero = make("geometry_msgs/msg/Vector3", store, x=0.0, y=0.0, z=0.0)
    twist = make("geometry_msgs/msg/Twist", store, linear=zero, angular=zero)
    with_pose = make(
        "geometry_msgs/msg/PoseWithCovariance", store, pose=pose(matrix, store), covariance=np.arange(36.0)
    )
    with_twist = make("geometry_msgs/msg/TwistWithCovariance", store, twist=twist, covariance=np.zeros(36))
    return make(
        "nav_msgs/msg/Odometry",
        store,
        header=header(stamp_ns, "odom", store),
        child_frame_id="base_link",
        pose=with_pose,
        twist=with_twist,
    )


def pose_stamped(stamp_ns: int, matrix: Array, store: Any = STORE) -> Any:
    return make("geometry_msgs/msg/PoseStamped", store, header=header(stamp_ns, "map", store), pose=pose(matrix, store))


def camera_info(stamp_ns: int, focal: float, size: tuple[int, int], baseline: float = 0.0, **changes: Any) -> Any:
    width, height = size
    projection = [focal, 0, width / 2, -focal * baseline, 0, focal, height / 2, 0, 0, 0, 1, 0]
    fields = {
        "header": header(stamp_ns),
        "height": height,
        "width": width,
        "distortion_model": "plumb_bob",
        "d": np.zeros(5),
        "k": np.array([focal, 0, width / 2, 0, focal, height / 2, 0, 0, 1.0]),
        "r": np.eye(3).ravel(),
        "p": np.array(projection, float),
        "binning_x": 0,
        "binning_y": 0,
        "roi": make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    }
    return make("sensor_msgs/msg/CameraInfo", **(fields | changes))


def drive(seconds: float) -> Array:
    """`odom_T_body` of a rover that drives a curve at 1 m/s, after some seconds."""
    yaw = 0.3 * seconds
    turn = [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    return make_pose(turn, [np.sin(yaw) / 0.3, (1 - np.cos(yaw)) / 0.3, 0.0])


def traverse(duration_s: float = 2.0, store: Any = STORE, size: tuple[int, int] = (64, 48)) -> list[Entry]:
    """(topic, log_ns, message) as in S3LI: stereo at 30 Hz, scans at 4.7 Hz, odometry and truth at 20 Hz."""
    rng = np.random.default_rng(3)
    entries: list[Entry] = []
    for i in range(int(duration_s * 30)):
        stamp = START_NS + i * 33_333_333
        pixels = rng.integers(0, 255, (size[1], size[0]), np.uint8)
        entries += [(LEFT, stamp + 5_000_000, image(stamp, pixels, store=store))]
        if i % 10 != 7:  # the right camera drops some
            entries += [(RIGHT, stamp + 6_000_000, image(stamp, pixels[:, ::-1].copy(), store=store))]
    for i in range(int(duration_s * 4.7)):
        stamp = START_NS + i * 212_765_957
        points = rng.uniform((-5, 5, -5), (5, 15, 5), (200, 3))
        records = scan(points, duration_ns=200_000_000)
        entries.append((CLOUD, stamp + 213_000_000, cloud(stamp, records, store)))
    for i in range(int(duration_s * 20)):
        stamp = START_NS + i * 50_000_000
        entries.append((ODOMETRY, stamp + 1_000_000, odometry(stamp, drive(i * 0.05), store)))
        entries.append((TRUTH, stamp + 1_000_000, pose_stamped(stamp, drive(i * 0.05), store)))
    return sorted(entries, key=lambda entry: entry[1])


def write_mcap(
    path: Path,
    entries: Iterable[Entry],
    chunk_size: int = 50_000,
    change: Callable[[int, str, bytes], bytes] = lambda number, topic, data: data,
    profile: str = "ros2",
    **options: Any,
) -> Path:
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=chunk_size, **options)
        writer.start(profile)
        channels: dict[str, int] = {}
        for i, (topic, log_ns, message) in enumerate(entries):
            if topic not in channels:
                text, _ = STORE.generate_msgdef(message.__msgtype__, ros_version=2)
                schema = writer.register_schema(message.__msgtype__, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(STORE.serialize_cdr(message, message.__msgtype__))
            writer.add_message(channels[topic], log_ns, change(i, topic, data), log_ns)
        writer.finish()
    return path


def write_db3(path: Path, entries: Iterable[Entry]) -> Path:
    with Ros2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        _write(writer, entries, STORE, STORE.serialize_cdr)
    return path


def write_ros1(path: Path, entries: Iterable[Entry]) -> Path:
    """Write entries made of the messages of `Stores.ROS1_NOETIC`."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(path) as writer:
        _write(writer, entries, store, store.serialize_ros1)
    return path


def _write(writer: Any, entries: Iterable[Entry], store: Any, serialize: Callable[[Any, str], Any]) -> None:
    connections: dict[str, Any] = {}
    for topic, log_ns, message in entries:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
        writer.write(connections[topic], log_ns, serialize(message, message.__msgtype__))


CALIBRATION = """
camera: {width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0, baseline: 0.2}
body_T_camera: {translation: [0.3, 0.1, 0.5], quaternion: [-0.5, 0.5, -0.5, 0.5]}
body_T_lidar: {translation: [0.2, 0.0, 0.6], quaternion: [0.0, 0.0, -0.70710678, 0.70710678]}
body_T_imu: {translation: [0.0, 0.0, 0.0], quaternion: [0.0, 0.0, 0.0, 1.0]}
lidar_time_offset_s: 0.1
min_intensity: 15
max_height_m: 20
"""


def small_settings(folder: Path, **overrides: Any) -> Settings:
    """Settings for the recordings of `traverse`."""
    path = folder / "calibration.yaml"
    path.write_text(CALIBRATION)
    return load_settings(None, calibration=str(path), **overrides)


def part_of(bag: Path, path: Path, first_s: float, last_s: float = math.inf) -> Path:
    """Some seconds of a recording, with all that comes once at its start."""
    with bag.open("rb") as source, path.open("wb") as target:
        writer = McapWriter(target)
        writer.start("ros2")
        channels: dict[int, int] = {}
        start_ns = None
        for schema, channel, message in make_reader(source).iter_messages():
            start_ns = message.log_time if start_ns is None else start_ns
            if schema is None or not first_s <= (message.log_time - start_ns) * 1e-9 < last_s:
                continue
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return path
