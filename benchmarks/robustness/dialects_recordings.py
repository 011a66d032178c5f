"""A drive of 46 s as other drivers, clocks and recorders write it, on a rover of unknown make."""

from __future__ import annotations

import bz2
import gzip
import re
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import numpy as np
from dialect_case import Case, Check, last_line, line_with
from scipy.spatial.transform import Rotation

from umf_ros.bags.reader import decode, message_types, open_bag
from umf_ros.core.geometry import Array, invert, make_pose, to_quaternion
from umf_ros.lab.program import Ended, umf
from umf_ros.lab.simulation.bag_writer import BagWriter
from umf_ros.sensors.calibration import load_calibration
from umf_ros.sensors.decode import decode_pose

SEED, SECONDS = 1, 46
CLOUD, ODOMETRY, STATIC = "/points", "/odom", "/tf_static"
LEFT, RIGHT = "/camera/left/image_rect", "/camera/right/image_rect"
TOPICS = {
    "/bf_lidar/points_raw": CLOUD,
    "/stereo/left/image_rect": LEFT,
    "/stereo/right/image_rect": RIGHT,
    "/stereo/left/camera_info": "/camera/left/camera_info",
    "/stereo/right/camera_info": "/camera/right/camera_info",
    **{name: name for name in (ODOMETRY, "/ground_truth/pose")},
}
"""Names that are those of no data set: the rig is that of /tf_static and camera_info."""
EPOCH_NS = 1_625_644_800_000_000_000
Entry = tuple[int, str, Any]
Change = Callable[[Entry], Entry]
"""From time of recording in ns, topic and message to those that are written."""


def base() -> Path:
    """The drive as simulated, made once."""
    path = Path(gettempdir()) / f"umf_dialects_{SEED}_{SECONDS}.mcap"
    if not path.exists():
        making = path.with_suffix(".making.mcap")
        umf("simulate", making, "--preset", "demo", "--seed", str(SEED), "--duration", str(SECONDS))
        making.rename(path)
    return path


def _static(stamp_ns: int) -> Any:
    """Mountings of the simulated rig as a tf2_msgs/TFMessage."""
    types, calibration = message_types().types, load_calibration("simulated")
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    transforms = []
    for child, pose in (("left_camera", calibration.body_T_camera), ("lidar", calibration.body_T_lidar)):
        shift = types["geometry_msgs/msg/Vector3"](**dict(zip("xyz", map(float, pose[:3, 3]), strict=True)))
        numbers = dict(zip("xyzw", map(float, to_quaternion(pose)), strict=True))
        turn = types["geometry_msgs/msg/Quaternion"](**numbers)
        transforms.append(
            types["geometry_msgs/msg/TransformStamped"](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="base_link"),
                child_frame_id=child,
                transform=types["geometry_msgs/msg/Transform"](translation=shift, rotation=turn),
            )
        )
    return types["tf2_msgs/msg/TFMessage"](transforms=transforms)


def rewrite(change: Change, folder: Path) -> None:
    """Write drive.mcap with the entries that `change` returns."""
    bag = open_bag(base())
    entries = [change((bag.start_ns, STATIC, _static(bag.start_ns)))]
    entries += [change((raw.log_ns, TOPICS[raw.topic], decode(raw))) for raw in bag.raw_messages(TOPICS)]
    with BagWriter(folder / "drive.mcap") as out:
        for log_ns, topic, message in sorted(entries, key=lambda entry: entry[0]):
            out.write(topic, message, log_ns)


def packed(compress: Callable[[bytes], bytes], name: str, folder: Path) -> None:
    """The drive in a file of a general compressor."""
    rewrite(lambda entry: entry, folder)
    (folder / name).write_bytes(compress((folder / "drive.mcap").read_bytes()))
    (folder / "drive.mcap").unlink()


def logged(at: Callable[[int], int]) -> Change:
    """Recorded at other times than the headers say, from those in ns."""
    return lambda entry: (at(entry[0]), *entry[1:])


def altered(topics: tuple[str, ...], alter: Callable[[Any, int], object], rows: slice = slice(None)) -> Change:
    """Messages of some topics altered in place, all or those of some rows, by message and number."""
    counts = dict.fromkeys(topics, -1)

    def change(entry: Entry) -> Entry:
        if entry[1] in topics:
            counts[entry[1]] += 1
            if counts[entry[1]] in range(10**9)[rows]:
                alter(entry[2], counts[entry[1]])
        return entry

    return change


def poses(move: Callable[[Array, int], Array], w_first: bool = False) -> Change:
    """Odometry with its poses (4, 4) moved, by pose and number of the message."""

    def alter(message: Any, number: int) -> None:
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        moved = move(decode_pose(message.pose.pose), number)
        place.x, place.y, place.z = map(float, moved[:3, 3])
        turn.x, turn.y, turn.z, turn.w = map(float, np.roll(to_quaternion(moved), int(w_first)))

    return altered((ODOMETRY,), alter)


def jump(metres: float, degrees: float, rows: tuple[int, ...]) -> Change:
    """Odometry that jumps to the left, and turns, at some messages."""
    step = make_pose(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), [0, metres, 0])
    return poses(lambda pose, row: np.linalg.matrix_power(step, sum(row >= one for one in rows)) @ pose)


def restamped(topic: str, row: int, seconds: float, relative: bool = True) -> Change:
    """One message whose stamp is changed by some seconds, or is this many since the epoch."""

    def alter(message: Any, _: int) -> None:
        stamp = message.header.stamp
        moved_ns = round(seconds * 1e9) + (stamp.sec * 10**9 + stamp.nanosec if relative else 0)
        stamp.sec, stamp.nanosec = divmod(moved_ns, 10**9)

    return altered((topic,), alter, slice(row, row + 1))


def mounted(name: str) -> Change:
    """A mounting on /tf_static inverted."""

    def alter(message: Any, _: int) -> None:
        for one in message.transforms:
            if one.child_frame_id == name:
                shift, turn = one.transform.translation, one.transform.rotation
                by = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
                moved = invert(make_pose(by, [shift.x, shift.y, shift.z]))
                shift.x, shift.y, shift.z = map(float, moved[:3, 3])
                turn.x, turn.y, turn.z, turn.w = map(float, to_quaternion(moved))

    return altered((STATIC,), alter)


def delayed(topics: tuple[str, ...], frames: int) -> Change:
    """Pictures of some frames before, under the stamps of now."""
    held: dict[str, list[Any]] = {topic: [] for topic in topics}

    def change(entry: Entry) -> Entry:
        _, topic, message = entry
        if topic in topics:
            held[topic].append(message.data)
            message.data = held[topic][max(0, len(held[topic]) - 1 - frames)]
        return entry

    return change


def twist_only(message: Any, _: int) -> None:
    """No pose, and a bias of the angular rate."""
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    place.x = place.y = place.z = turn.x = turn.y = turn.z = turn.w = 0.0
    message.twist.twist.angular.z += 0.003


def wide_pair(message: Any, _: int) -> None:
    """A right camera 20 m away."""
    message.p = np.array(message.p, float)
    message.p[3] = -579.5 * 20


def metric_grey(message: Any, _: int) -> None:
    """An image of floats from 0 to 1."""
    pixels = message.data.reshape(message.height, message.width).astype("<f4") / 255
    message.encoding, message.step = "32FC1", pixels[0].nbytes
    message.data = np.frombuffer(pixels.tobytes(), np.uint8)


def judged(ended: Ended) -> tuple[int, int]:
    """Return the numbers of true and of false closures."""
    found = re.search(r"(\d+) true and (\d+) false", " ".join(ended.lines))
    return (int(found[1]), int(found[2])) if found else (-1, -1)


@cache
def plain() -> int:
    """True closures of the drive as it is."""
    with TemporaryDirectory() as folder:
        rewrite(lambda entry: entry, Path(folder))
        return judged(umf(*REPLAY, folder=Path(folder)))[0]


def _closes(text: str, ended: Ended, _: Path) -> tuple[bool, str]:
    """Nine in ten of the drive's closures, none false, and a line that names the fault where there is one."""
    (true, false), line = judged(ended), line_with(ended, text) if text else ""
    right = true >= 0.9 * plain() > 0 == false and bool(line) == bool(text)
    return right, f"{true} of {plain()}, {false} false; {line or last_line(ended)}"


def _tells(text: str, is_withheld: bool, ended: Ended, _: Path) -> tuple[bool, str]:
    """A line that names the fault, and no false closure; none at all where they have to be withheld."""
    (true, false), line = judged(ended), line_with(ended, text)
    right = bool(line) and false <= 0 and (true <= 0 or not is_withheld)
    return right, f"{true} true, {false} false; {line or last_line(ended)}"


def _case(name: str, change: Change, expected: str, check: Check) -> Case:
    return Case(name, partial(rewrite, change), REPLAY, expected, check)


def _right(name: str, change: Change, text: str = "") -> Case:
    expected = "all closures, none false" + (f"; a line: {text}" if text else "")
    return _case(name, change, expected, partial(_closes, text))


def _withheld(name: str, change: Change, text: str) -> Case:
    return _case(name, change, f"none believed; a line: {text}", partial(_tells, text, True))


def _told(name: str, change: Change, text: str) -> Case:
    return _case(name, change, f"none false; a line: {text}", partial(_tells, text, False))


def _refused(end: str, compress: Callable[[bytes], bytes]) -> Case:
    def names(ended: Ended, _: Path) -> tuple[bool, str]:
        return bool(line_with(ended, end)), last_line(ended)

    return Case(f"11 {end}", partial(packed, compress, f"a.mcap.{end}"), ("replay", f"a.mcap.{end}"), end, names)


REPLAY = ("replay", "drive.mcap", "--out", "runs")
CASES = [
    _right("00 as it is", lambda entry: entry),
    _withheld("01 LiDAR's mounting inverted", mounted("lidar"), "LiDAR's mounting is off"),
    _told("01 camera's mounting inverted", mounted("left_camera"), "camera's mounting is off"),
    _withheld("01 odometry w first", poses(lambda pose, _: pose, w_first=True), "odometry"),
    _told("01 odometry in millimetres", poses(lambda p, _: make_pose(p[:3, :3], 1e3 * p[:3, 3])), "position jump"),
    _right("05 logged at once", logged(lambda log_ns: EPOCH_NS)),
    _right("05 logged at half speed", logged(lambda log_ns: 2 * log_ns - EPOCH_NS)),
    _right("05 logged in 1970", logged(lambda log_ns: log_ns - EPOCH_NS)),
    _right("05 logged a year later", logged(lambda log_ns: log_ns + 365 * 86_400 * 10**9)),
    _right("05 scan of stamp 0", restamped(CLOUD, 60, 0, relative=False)),
    _right("05 odometry of stamp 0", restamped(ODOMETRY, 60, 0, relative=False)),
    _right("05 first odometry of stamp 0", restamped(ODOMETRY, 0, 0, relative=False)),
    _right("05 first scan an hour ahead", restamped(CLOUD, 0, 3600)),
    _right("05 scan 3 s behind", restamped(CLOUD, 60, -3)),
    _right(
        "07 baseline of 20 m", altered((TOPICS["/stereo/right/camera_info"],), wide_pair), "left camera is used alone"
    ),
    _right("08 twist only with a biased gyroscope", altered((ODOMETRY,), twist_only)),
    _refused("gz", gzip.compress),
    _refused("bz2", bz2.compress),
    _right("13 32FC1", altered((LEFT, RIGHT), metric_grey)),
    _right("14 jump of 0.5 m", jump(0.5, 0, (600,))),
    _right("14 jump of 1.9 m", jump(1.9, 0, (600,))),
    _right("14 jump of 20 deg", jump(0, 20, (600,))),
    _right("14 jump of 1 m during a scan of a match", jump(1, 0, (135,))),
    _right("14 jump of 8 deg during a scan of a match", jump(0, 8, (135,))),
    _right("14 two jumps of 1 m", jump(1, 0, (400, 700))),
    _told("20 left image late", delayed((LEFT,), 1), "images"),
    _told("20 both images late", delayed((LEFT, RIGHT), 2), "the camera's clock is about"),
]
