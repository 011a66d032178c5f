"""A drive of 46 s as other drivers write it: times of points, images, camera_info, and scans in parts."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import cv2
import numpy as np
from dialect_case import Case, Check, Outcome, says, umf

from umf_ros.bags.reader import decode, message_types, open_bag
from umf_ros.core.geometry import to_quaternion
from umf_ros.lab.imported import write_recording
from umf_ros.lab.importing import euroc
from umf_ros.lab.simulation.bag_writer import BagWriter
from umf_ros.sensors.calibration import RawCamera, load_calibration

SEED, SECONDS = 1, 46
CLOUD, LEFT, RIGHT = "/points", "/camera/left/image_rect", "/camera/right/image_rect"
TOPICS = {
    "/bf_lidar/points_raw": CLOUD,
    "/stereo/left/image_rect": LEFT,
    "/stereo/right/image_rect": RIGHT,
    "/stereo/left/camera_info": "/camera/left/camera_info",
    "/stereo/right/camera_info": "/camera/right/camera_info",
    **{name: name for name in ("/odom", "/ground_truth/pose")},
}
"""Names that are those of no data set: the rig is that of /tf_static and camera_info."""
BASELINE_M = 0.2003247
Change = Callable[[str, Any], Iterator[tuple[int, Any]]]
"""Yields what is written in place of a message of a topic: ns after its time of recording, and a message."""


def base() -> Path:
    """The drive as simulated, made once."""
    path = Path(gettempdir()) / f"umf_dialects_{SEED}_{SECONDS}.mcap"
    if not path.exists():
        name = path.with_suffix(".making.mcap").name
        umf(path.parent, "simulate", name, "--preset", "demo", "--seed", str(SEED), "--duration", str(SECONDS))
        (path.parent / name).rename(path)
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
    """Write drive.mcap with the messages that `change` yields."""
    bag = open_bag(base())
    entries = [(bag.start_ns, "/tf_static", one) for _, one in change("/tf_static", _static(bag.start_ns))]
    for raw in bag.raw_messages(TOPICS):
        topic = TOPICS[raw.topic]
        entries += [(raw.log_ns + after, topic, message) for after, message in change(topic, decode(raw))]
    with BagWriter(folder / "drive.mcap") as out:
        for log_ns, topic, message in sorted(entries, key=lambda entry: entry[0]):
            out.write(topic, message, log_ns)


def stamp_of(message: Any) -> int:
    """Stamp of a message in ns."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


_KINDS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}


def records_of(message: Any) -> np.ndarray:
    """Points of a cloud as a structured array."""
    fields = {field.name: (_KINDS[field.datatype], field.offset) for field in message.fields}
    kinds, offsets = zip(*fields.values(), strict=True)
    layout: Any = {"names": [*fields], "formats": kinds, "offsets": offsets, "itemsize": message.point_step}
    return np.frombuffer(message.data, np.dtype(layout))


def cloud_of(records: np.ndarray, like: Any, after_ns: int = 0) -> Any:
    """A cloud of these points, stamped some ns after another."""
    types, codes = message_types().types, {kind: code for code, kind in _KINDS.items()}
    names: Any = records.dtype.fields
    fields = [
        types["sensor_msgs/msg/PointField"](name=name, offset=offset, datatype=codes[kind.str.strip("|")], count=1)
        for name, (kind, offset, *_) in names.items()
    ]
    seconds, nanoseconds = divmod(stamp_of(like) + after_ns, 10**9)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types["sensor_msgs/msg/PointCloud2"](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=like.header.frame_id),
        height=1,
        width=len(records),
        fields=fields,
        is_bigendian=False,
        point_step=records.dtype.itemsize,
        row_step=records.nbytes,
        data=np.frombuffer(records.tobytes(), np.uint8),
        is_dense=False,
    )


def timed(name: str, kind: str, times: Callable[[np.ndarray, int], Any], later_ns: int = 0) -> Change:
    """Times of points under a name, in a type, as made of ns after the stamp and the stamp; a scan stamped later."""

    def change(topic: str, message: Any) -> Iterator[tuple[int, Any]]:
        if topic == CLOUD:
            before = records_of(message)
            after = np.zeros(len(before), [*((axis, "<f4") for axis in "xyz"), ("intensity", "<f4"), (name, kind)])
            for axis in ("x", "y", "z", "intensity"):
                after[axis] = before[axis]
            after[name] = times(before["point_time_offset"].astype(np.int64), stamp_of(message))
            message = cloud_of(after, message, later_ns)
        yield 0, message

    return change


def parted(count: int, by_azimuth: bool) -> Change:
    """Scans in so many messages, each with its own stamp and times from there; sectors, or in their order of time."""

    def change(topic: str, message: Any) -> Iterator[tuple[int, Any]]:
        if topic != CLOUD:
            yield 0, message
            return
        records = records_of(message)
        records = records[np.argsort(records["point_time_offset"], kind="stable")]
        times = records["point_time_offset"].astype(np.int64)
        labels = np.arange(len(records)) * count // len(records)
        if by_azimuth:
            turn = np.argsort(np.argsort(np.arctan2(records["y"], records["x"])))
            labels = turn * count // len(records)
        for number in range(count):
            part, first = records[labels == number].copy(), int(times[labels == number].min(initial=2**62))
            start = number * 1_000_000 if by_azimuth else first
            part["point_time_offset"] = (times[labels == number] - start).astype(np.int64) % 2**32
            yield start, cloud_of(part, message, start)

    return change


def pictured(encoding: str, make: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Images in another encoding, as made of grey bytes (H, W)."""

    def change(topic: str, message: Any) -> Iterator[tuple[int, Any]]:
        if topic in (LEFT, RIGHT):
            pixels = make(message.data.reshape(message.height, message.width))
            message.encoding, message.step = encoding, pixels[0].nbytes
            message.data = np.frombuffer(pixels.tobytes(), np.uint8)
        yield 0, message

    return change


def informed(alter: Callable[[Any, bool], None]) -> Change:
    """camera_info as altered; told whether it is the right one."""

    def change(topic: str, message: Any) -> Iterator[tuple[int, Any]]:
        if topic.endswith("camera_info"):
            message.k, message.p = np.array(message.k, float), np.array(message.p, float)
            alter(message, "right" in topic)
        yield 0, message

    return change


def binned(info: Any, of_image: bool) -> None:
    """Binning by 2; K and P are those of the sensor, or of the image."""
    info.width, info.height, info.binning_x, info.binning_y = info.width * 2, info.height * 2, 2, 2
    if not of_image:
        info.k[:6] *= 2
        info.p[:8] *= 2


def cut_out(info: Any) -> None:
    """A region of a sensor that is 100 columns wider and 60 rows higher."""
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 40, 30, info.width, info.height
    info.width, info.height = info.width + 100, info.height + 60
    info.k[2], info.k[5], info.p[2], info.p[6] = info.k[2] + 40, info.k[5] + 30, info.p[2] + 40, info.p[6] + 30


def paired(left: dict[int, float], right: dict[int, float]) -> Change:
    """P of both cameras with some entries replaced; times fx where they are those of a baseline."""

    def alter(info: Any, is_right: bool) -> None:
        for place, value in (right if is_right else left).items():
            info.p[place] = value * (info.p[0] if place == 3 and abs(value) == BASELINE_M else 1)

    return informed(alter)


def unchanged(topic: str, message: Any) -> Iterator[tuple[int, Any]]:
    """The message itself."""
    yield 0, message


def late_info(topic: str, message: Any) -> Iterator[tuple[int, Any]]:
    """camera_info that are recorded after the images of their stamp."""
    yield (30_000_000 if topic.endswith("camera_info") else 0), message


def judged(outcome: Outcome) -> tuple[int, int]:
    """Return the numbers of true and of false closures."""
    found = re.search(r"(\d+) true and (\d+) false", " ".join(outcome.lines))
    return (int(found[1]), int(found[2])) if found else (-1, -1)


@cache
def plain() -> int:
    """True closures of the drive as it is."""
    with TemporaryDirectory() as folder:
        case = Case("plain", partial(rewrite, unchanged), REPLAY, "", lambda outcome: (True, str(judged(outcome)[0])))
        return int(case.run(Path(folder))[1])


def closures(text: str = "", least: float = 0.9) -> Check:
    """Return a check of the true closures, at least a share of those of the drive, the false ones, and of a line."""

    def check(outcome: Outcome) -> tuple[bool, str]:
        (true, false), expected = judged(outcome), plain()
        told, line = says(text)(outcome) if text else (True, "")
        return true >= least * expected > 0 == false and told, f"{true} of {expected}, {false} false; {line}"

    return check


REPLAY = ("replay", "drive.mcap", "--out", "runs")


def _case(name: str, change: Change, text: str = "") -> Case:
    expected = "all closures, none false" + (f"; a line: {text}" if text else "")
    return Case(name, partial(rewrite, change), REPLAY, expected, closures(text))


def _times(
    name: str, field: str, kind: str, times: Callable[[np.ndarray, int], Any], text: str = "", later_ns: int = 0
) -> Case:
    return _case(f"07 {name}", timed(field, kind, times, later_ns), text)


def _fisheye(folder: Path) -> str:
    """Import a EuRoC folder with a fisheye, and compare its rectified rays with OpenCV's own model, px."""
    names = ("fx", "fy", "cx", "cy")
    numbers, lens = (190.98, 190.97, 254.93, 256.90), (0.00348, 0.00072, -0.00205, 0.0002)
    for name, shift in (("cam0", 0.0), ("cam1", 0.1)):
        place = folder / "mav0" / name
        (place / "data").mkdir(parents=True)
        cv2.imwrite(str(place / "data" / "1520530308199447626.png"), np.zeros((512, 512), np.uint8))
        (place / "data.csv").write_text("#timestamp [ns],filename\n1520530308199447626,1520530308199447626.png\n")
        (place / "sensor.yaml").write_text(
            f"T_BS:\n  data: [1, 0, 0, {shift}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\nresolution: [512, 512]\n"
            f"camera_model: pinhole\nintrinsics: {list(numbers)}\n"
            f"distortion_model: equidistant\ndistortion_coefficients: {list(lens)}\n"
        )
    write_recording(euroc(folder), folder / "made.mcap")
    calibration = load_calibration(folder / "made.calibration.yaml")
    rectifier, camera = calibration.rectifier, calibration.camera
    assert rectifier is not None
    pinhole = RawCamera(width=512, height=512, distortion=(), **dict(zip(names, numbers, strict=True)))
    worst = 0.0
    for degrees in (0, 10, 20, 30, 45):
        ray = np.array([[[np.tan(np.radians(degrees)), 0.1, 1.0]]])
        pixel = cv2.fisheye.projectPoints(ray, np.zeros(3), np.zeros(3), pinhole.matrix((512, 512)), np.array(lens))[0]
        u, v = np.meshgrid(np.arange(512), np.arange(512))
        spot = 250 * np.exp(-((u - pixel[0, 0, 0]) ** 2 + (v - pixel[0, 0, 1]) ** 2) / 18)
        seen = rectifier.apply(spot.astype(np.uint8), 0).astype(float)
        seen[seen < 30] = 0
        found = np.array([(u * seen).sum(), (v * seen).sum()]) / seen.sum()
        x, y, z = rectifier.raw_T_rectified[:3, :3].T @ ray.ravel()
        right = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        worst = max(worst, float(np.linalg.norm(found - right)))
    return f"{worst:.2f} px off"


def _below_a_pixel(outcome: Outcome) -> tuple[bool, str]:
    return float(outcome.said.split()[0]) < 1, outcome.said


SWEEP_NS = 200_000_000
ALONE = "the left camera is used alone"
CASES: list[Case] = [
    _case("19 plain", unchanged),
    _case("19 late camera_info", late_info),
    _times("us_epoch", "timestamp", "<f8", lambda offsets, stamp: (stamp + offsets) * 1e-3),
    _times("ms_epoch", "timestamp", "<f8", lambda offsets, stamp: (stamp + offsets) * 1e-6),
    _times("us_u4", "t", "<u4", lambda offsets, stamp: offsets // 1000),
    _times("ms_f4", "time", "<f4", lambda offsets, stamp: offsets * 1e-6),
    _times("us_f8", "time_stamp", "<f8", lambda offsets, stamp: offsets * 1e-3),
    _times("end_u4", "ts", "<u4", lambda offsets, stamp: (offsets - SWEEP_NS) % 2**32, later_ns=SWEEP_NS),
    _times("ptp", "timestamp", "<f8", lambda offsets, stamp: (stamp + offsets) * 1e-9 + 37),
    _times("s_epoch_f4", "timestamp", "<f4", lambda offsets, stamp: (stamp + offsets) * 1e-9, "too coarse"),
    _times("constant", "time", "<f4", lambda offsets, stamp: 0 * offsets, "are all equal"),
    Case("12 equidistant", lambda folder: None, _fisheye, "below 1 px", _below_a_pixel),
    _case("05 binning", informed(lambda info, _: binned(info, False))),
    _case("05 mako", informed(lambda info, _: binned(info, True))),
    _case("05 roi", informed(lambda info, _: cut_out(info))),
    _case("06 no_tx", paired({}, {3: 0.0}), ALONE),
    _case("06 negative", paired({}, {3: BASELINE_M}), ALONE),
    _case("06 both", paired({3: -BASELINE_M}, {}), "is taken as the baseline"),
    _case("06 left", paired({3: BASELINE_M}, {3: 0.0})),
    _case("06 metres", paired({}, {3: -0.2}), ALONE),
    _case("06 skew", paired({1: -52.4}, {1: -52.4}), "not that of a rectified camera"),
    _case("parts 4 in time", parted(4, False)),
    _case("parts 10 in time", parted(10, False)),
    _case("parts 4 sectors", parted(4, True)),
    _case("images mono16 of 12 bits", pictured("mono16", lambda grey: grey.astype("<u2") * 16)),
    _case("images 8UC3", pictured("8UC3", lambda grey: np.repeat(grey[..., None], 3, axis=2))),
    _case("images bayer_rggb16", pictured("bayer_rggb16", lambda grey: grey.astype("<u2") * 16)),
    _case("images 16UC1 of 10 bits", pictured("16UC1", lambda grey: grey.astype("<u2") * 4)),
]
