"""Recordings as other recorders, clocks and drivers leave them: the drive of a demo, on a rover of unknown make."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from dialect_case import Case, Check, Outcome, simulated
from mcap.writer import CompressionType, Writer
from zstandard import ZstdCompressor

from umf_ros.bags.reader import RawMessage, decode, message_types, open_bag
from umf_ros.core.geometry import Array, to_quaternion
from umf_ros.core.resources import find
from umf_ros.sensors.calibration import load_calibration

TOPICS = {
    "/stereo/left/image_rect": "/camera/left/image_rect",
    "/stereo/left/camera_info": "/camera/left/camera_info",
    "/stereo/right/image_rect": "/camera/right/image_rect",
    "/stereo/right/camera_info": "/camera/right/camera_info",
    "/bf_lidar/points_raw": "/points",
    "/odom": "/odom",
    "/ground_truth/pose": "/ground_truth/pose",
}
CAMERA, LIDAR, ODOMETRY = "/camera/left/image_rect", "/points", "/odom"
Change = Callable[[RawMessage], Iterable[RawMessage]]
Open = Callable[[str], "Recorder"]


class Recorder:
    """A recorder that writes mcap files; messages or the whole file are compressed on request."""

    def __init__(self, path: Path, packed: bool = False) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file, self._packed = path.open("wb"), packed
        self._writer = Writer(self._file, compression=CompressionType.LZ4)
        self._writer.start("ros2")
        self._channels: dict[str, int] = {}

    def write(self, message: RawMessage) -> None:
        """Append a message."""
        if message.topic not in self._channels:
            text = message_types().generate_msgdef(message.type, ros_version=2)[0].encode()
            schema = self._writer.register_schema(message.type, "ros2msg", text)
            self._channels[message.topic] = self._writer.register_channel(message.topic, "cdr", schema)
        data = ZstdCompressor().compress(message.data) if self._packed else message.data
        self._writer.add_message(self._channels[message.topic], message.log_ns, data, message.log_ns)

    def close(self) -> None:
        """Finish the file."""
        self._writer.finish()
        self._file.close()


@contextmanager
def recording(path: Path, packed: bool = False) -> Iterator[Recorder]:
    """Open a recorder and finish its file at the end of the block."""
    recorder = Recorder(path, packed)
    yield recorder
    recorder.close()


def encoded(kind: str, message: Any, raw: RawMessage) -> RawMessage:
    """Return a message with other contents."""
    return replace(raw, data=bytes(message_types().serialize_cdr(message, kind)))


def base(folder: Path) -> Path:
    """Return the drive with the rig on `/tf_static`, made once beside a case's folder."""
    path = folder.parent / "base.mcap"
    if path.exists():
        return path
    demo = simulated(folder.parent)
    with recording(path.with_suffix(".part")) as out:
        for number, raw in enumerate(open_bag(demo).raw_messages(TOPICS)):
            if not number:
                out.write(transforms("/tf_static", raw.log_ns))
            message = decode(raw)
            if raw.topic in ("/stereo/left/image_rect", "/stereo/left/camera_info", "/bf_lidar/points_raw"):
                message.header.frame_id = "lidar" if "lidar" in raw.topic else "camera"
            out.write(replace(encoded(raw.type, message, raw), topic=TOPICS[raw.topic]))
    return path.with_suffix(".part").rename(path)


def transforms(topic: str, log_ns: int) -> RawMessage:
    """Return the places of camera and LiDAR on the body as a message of transforms."""
    kinds = message_types().types
    rig = load_calibration(find("config/calibration/simulated.yaml"))

    def stamped(child: str, pose: Array) -> Any:
        x, y, z = (float(number) for number in pose[:3, 3])
        turn = dict(zip("xyzw", map(float, to_quaternion(pose)), strict=True))
        stamp = kinds["builtin_interfaces/msg/Time"](sec=log_ns // 10**9, nanosec=log_ns % 10**9)
        return kinds["geometry_msgs/msg/TransformStamped"](
            header=kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="base_link"),
            child_frame_id=child,
            transform=kinds["geometry_msgs/msg/Transform"](
                translation=kinds["geometry_msgs/msg/Vector3"](x=x, y=y, z=z),
                rotation=kinds["geometry_msgs/msg/Quaternion"](**turn),
            ),
        )

    kind = "tf2_msgs/msg/TFMessage"
    message = kinds[kind](transforms=[stamped("camera", rig.body_T_camera), stamped("lidar", rig.body_T_lidar)])
    return RawMessage(topic, log_ns, kind, bytes(message_types().serialize_cdr(message, kind)))


def changed(change: Change, packed: bool = False) -> Callable[[Path], None]:
    """Return a maker of `drive.mcap` with other messages."""

    def make(folder: Path) -> None:
        with recording(folder / "drive.mcap", packed) as out:
            for raw in open_bag(base(folder)).raw_messages():
                for message in change(raw):
                    out.write(message)

    return make


def later(seconds: float) -> Change:
    """Recorded at another time than the headers say."""
    return lambda raw: [replace(raw, log_ns=raw.log_ns + round(seconds * 1e9))]


def stamped_wrongly(topics: tuple[str, ...], ahead_s: float, count: int = 1) -> Change:
    """Some messages in the middle with a stamp ahead of time."""
    seen = dict.fromkeys(topics, 0)

    def change(raw: RawMessage) -> Iterable[RawMessage]:
        if raw.topic in topics:
            seen[raw.topic] += 1
            if 40 <= seen[raw.topic] < 40 + count:
                message = decode(raw)
                stamp = message.header.stamp
                moved_ns = stamp.sec * 10**9 + stamp.nanosec + round(ahead_s * 1e9)
                stamp.sec, stamp.nanosec = divmod(moved_ns, 10**9)
                return [encoded(raw.type, message, raw)]
        return [raw]

    return change


def odometry(fill: Callable[[Any], None]) -> Change:
    """Odometry whose pose is changed by a function."""

    def change(raw: RawMessage) -> Iterable[RawMessage]:
        if raw.topic != ODOMETRY:
            return [raw]
        message = decode(raw)
        fill(message.pose.pose)
        return [encoded(raw.type, message, raw)]

    return change


def no_position(pose: Any) -> None:
    """Leave the position empty."""
    pose.position.x = pose.position.y = pose.position.z = 0.0


def no_pose(pose: Any, w: float = 1.0) -> None:
    """Leave position and orientation empty."""
    no_position(pose)
    turn = pose.orientation
    turn.x, turn.y, turn.z, turn.w = 0.0, 0.0, 0.0, w


def no_orientation(pose: Any) -> None:
    """Leave the orientation empty."""
    turn = pose.orientation
    turn.x, turn.y, turn.z, turn.w = 0.0, 0.0, 0.0, 1.0


def in_namespace(raw: RawMessage) -> Iterable[RawMessage]:
    """Topics of a robot in a namespace, the transforms included."""
    return [raw if raw.topic.startswith("/ground_truth") else replace(raw, topic="/a200_0000" + raw.topic)]


def on_tf(raw: RawMessage) -> Iterable[RawMessage]:
    """Static transforms repeated on /tf beside the odometry, as tf1's publishers do."""
    if raw.topic == "/tf_static":
        return []
    return [raw, transforms("/tf", raw.log_ns)] if raw.topic == ODOMETRY else [raw]


def packed_as_a_whole(folder: Path) -> None:
    """One zstd frame around an ordinary mcap."""
    with base(folder).open("rb") as file, (folder / "drive.mcap.zstd").open("wb") as out:
        ZstdCompressor().copy_stream(file, out)


def in_parallel(folder: Path) -> None:
    """One recorder for each sensor, in one folder."""
    outs: dict[str, Recorder] = {}
    for raw in open_bag(base(folder)).raw_messages():
        name = "camera" if raw.topic.startswith("/camera") else "lidar" if raw.topic == LIDAR else "robot"
        if name not in outs:
            outs[name] = Recorder(folder / "drive" / f"{name}_0.mcap")
        outs[name].write(raw)
    for one in outs.values():
        one.close()


def closes(least: float = 0.9) -> Check:
    """Return a check of a replay: no false closure, and at least a share of the right ones of the drive as it is."""

    def check(outcome: Outcome) -> tuple[bool, str]:
        said = re.search(r"(\d+) true and (\d+) false", " ".join(outcome.lines))
        if said is None:
            return False, outcome.in_short
        true, false = int(said[1]), int(said[2])
        error = re.search(r"trajectory error [^;]*?optimised", " ".join(outcome.lines))
        return false == 0 and true >= least * RIGHT, f"{true} true, {false} false, {error[0] if error else ''}"

    return check


RIGHT = 28
"""Right closures of the drive as it is, by `umf replay`."""


def case(name: str, make: Callable[[Path], object], file: str = "drive.mcap", least: float = 0.9) -> Case:
    """Return a case whose replay has to close the loops of the drive."""
    arguments = "replay", file, "--out", "results"
    return Case(name, make, arguments, f"at least {np.ceil(least * RIGHT):.0f} true, 0 false", closes(least))


CASES = [
    case("00 as it is", changed(lambda raw: [raw])),
    case("01 compressed messages", changed(lambda raw: [raw], packed=True)),
    case("01 compressed file", packed_as_a_whole, "drive.mcap.zstd"),
    case("02 parallel recorders", in_parallel, "drive"),
    case("03 namespace", changed(in_namespace)),
    case("03 transforms on /tf", changed(on_tf)),
    case("04 twist only", changed(odometry(no_pose))),
    case("04 quaternion of zeros", changed(odometry(lambda pose: no_pose(pose, 0.0)))),
    case("04 heading only", changed(odometry(no_position))),
    case("04 position only", changed(odometry(no_orientation))),
    *(
        case(f"08 {what} {ahead_s:g} s ahead", changed(stamped_wrongly(topics, ahead_s)))
        for what, topics in {"scan": (LIDAR,), "odometry": (ODOMETRY,), "image": (CAMERA,)}.items()
        for ahead_s in (2.0, 3600.0)
    ),
    case("08 three scans ahead", changed(stamped_wrongly((LIDAR,), 3600.0, 3)), least=0.7),
    case("08 a pair of images ahead", changed(stamped_wrongly((CAMERA, CAMERA.replace("left", "right")), 3600.0))),
    *(
        case(f"24 {name}", changed(later(seconds)))
        for name, seconds in {"a year later": 365 * 86400.0, "TAI": 37.0, "no clock": 100 - 1.6256e9}.items()
    ),
]
