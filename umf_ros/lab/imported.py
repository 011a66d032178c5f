"""A data set's files as a recording: what a format finds, and how it is written."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from umf_ros.bags.presets import GROUND_TRUTH_TOPIC
from umf_ros.bags.reader import RawMessage, message_types
from umf_ros.core.config import Topics
from umf_ros.core.errors import OutputError
from umf_ros.core.frames import StereoCamera
from umf_ros.core.geometry import Array, make_pose, to_quaternion
from umf_ros.core.io import write_atomically
from umf_ros.core.trajectory import Trajectory
from umf_ros.lab.scan_files import SensorFileError, read_image
from umf_ros.lab.simulation.bag_writer import (
    BagWriter,
    camera_info_message,
    image_message,
    packed_cloud,
    pose_message,
    transforms_message,
)
from umf_ros.sensors.calibration import TO_BE_MEASURED
from umf_ros.sensors.decode import CLOUD, IMAGE, TYPES, Cloud
from umf_ros.sensors.tf import TOPIC as TRANSFORMS
from umf_ros.sensors.tf import TYPE as TRANSFORMS_TYPE

POSE = "geometry_msgs/msg/PoseStamped"

OPTICAL = make_pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""`body_T_camera` where the camera is the body: x ahead, y left, z up."""


@dataclass
class Imported:
    """Files by stamp, and how the sensors are built and mounted.

    Attributes:
        camera: entry `camera` or `raw_camera` of a calibration file, by its name.
        body_T_camera, body_T_lidar: mountings.
        left, right: stamps in ns and image files, in order.
        scans: stamps in ns and what reads each scan, in order.
        truth: poses of the body, or None.
        guessed: values that the data set does not give, in words.
    """

    camera: dict[str, Any]
    body_T_camera: Array = field(default_factory=lambda: OPTICAL)
    body_T_lidar: Array = field(default_factory=lambda: np.eye(4))
    left: list[tuple[int, Path]] = field(default_factory=list)
    right: list[tuple[int, Path]] = field(default_factory=list)
    scans: list[tuple[int, Callable[[], Cloud]]] = field(default_factory=list)
    truth: Trajectory | None = None
    guessed: list[str] = field(default_factory=list)

    def calibration(self) -> dict[str, Any]:
        """The content of a calibration file."""
        poses = {"body_T_lidar": self.body_T_lidar, "body_T_imu": np.eye(4)}
        poses |= {"body_T_camera": self.body_T_camera} if self.left else {}
        told = (self.camera if self.left else {}) | {name: pose_entry(pose) for name, pose in poses.items()}
        return told | {"lidar_time_offset_s": 0.0, "min_intensity": 0.0, "max_height_m": 0.0}

    def check(self, source: Path) -> Imported:
        """The same, if it holds anything.

        Raises:
            SensorFileError: there is neither an image nor a scan.
        """
        if not self.left and not self.scans:
            raise SensorFileError(f"{source} holds neither images nor scans of this format")
        return self


def pose_entry(pose: Array) -> dict[str, list[float]]:
    """A pose as a calibration file has it."""
    numbers = pose[:3, 3], to_quaternion(pose)
    return dict(zip(("translation", "quaternion"), ([float(v) for v in values] for values in numbers), strict=True))


def with_notes(notes: Iterable[str], content: dict[str, Any], flow: bool | None = None) -> str:
    """YAML under comments; with `flow` false each value has a line of its own."""
    return "".join(f"# {note}\n" for note in notes) + yaml.safe_dump(content, sort_keys=False, default_flow_style=flow)


_LAYOUT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])

TOPICS = Topics(
    left_image="/camera/left/image",
    right_image="/camera/right/image",
    left_info="/camera/left/camera_info",
    right_info="/camera/right/camera_info",
    cloud="/lidar/points",
    odometry="",
)
"""Of an imported recording: those of no known data set, whose calibration it does not have."""


def check_absent(*paths: Path) -> None:
    """Raise an `OutputError` if one of some files, which a person may have changed, would be overwritten."""
    for path in paths:
        if path.exists():
            raise OutputError(f"{path} is there already: nothing was written; move it, or name another folder")


Entry = tuple[int, str, str, Callable[[], Any]]
"""Stamp in ns, topic and type of a message, and what makes it."""


class DataSetFile:
    """Files of a data set, read like one file of a recording: each message is made when it is asked for.

    Attributes:
        path: the folder.
        types, counts: type and number of messages by topic.
        start_ns, end_ns: stamps of the first and the last message.
        warning: empty.
    """

    def __init__(self, path: Path, found: Imported) -> None:
        self.path, self.warning = path, ""
        self._entries = sorted(_entries(found), key=lambda entry: entry[:2])
        self.types = {topic: kind for _, topic, kind, _ in self._entries}
        self.counts = Counter(topic for _, topic, *_ in self._entries)
        self.start_ns, self.end_ns = self._entries[0][0], self._entries[-1][0]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield messages of some topics in the order of their stamps; an unreadable file raises a `SensorFileError`."""
        for stamp_ns, topic, kind, make in self._entries:
            if topic in topics:
                yield RawMessage(topic, stamp_ns, kind, bytes(message_types().serialize_cdr(make(), kind)))


def write_recording(found: Imported, out: Path, progress: Callable[[float], None] = lambda _: None) -> Path:
    """Write OUT.mcap, OUT.calibration.yaml and OUT.yaml; returns the last, the --config of the recording.

    Raises:
        OutputError: one of them is there already, or cannot be written.
        SensorFileError: a file of the data set cannot be read.
    """
    calibration, config = out.with_suffix(".calibration.yaml"), out.with_suffix(".yaml")
    check_absent(out, calibration, config)
    entries = sorted(_entries(found), key=lambda entry: entry[:2])
    with BagWriter(out) as bag:
        for number, (stamp, topic, _, make) in enumerate(entries, 1):
            bag.write(topic, make(), stamp)
            progress(number / len(entries))
    notes = [f"{TO_BE_MEASURED}: {what}" for what in found.guessed]
    write_atomically(calibration, with_notes(notes, found.calibration()))
    parameters = {"calibration": str(calibration.resolve()), "topics": TOPICS.model_dump()}
    write_atomically(config, with_notes((), {"/**": {"ros__parameters": parameters}}, flow=False))
    return config


def _entries(found: Imported) -> Iterator[Entry]:
    """Messages of a data set; how the sensors are built and mounted only where that is known, of rectified images."""
    cameras = {TOPICS.left_image: found.left, TOPICS.right_image: found.right}
    for topic, files in cameras.items():
        for stamp, path in files:
            yield stamp, topic, IMAGE, partial(_image, path, stamp)
    for stamp, read in found.scans:
        yield stamp, TOPICS.cloud, CLOUD, partial(_cloud, read, stamp)
    if found.truth is not None:
        for stamp, pose in zip(found.truth.stamps_ns.tolist(), found.truth.poses, strict=True):
            yield stamp, GROUND_TRUTH_TOPIC, POSE, partial(pose_message, pose, stamp, "map")
    if found.guessed or (found.left and "camera" not in found.camera):
        return
    first_ns = min(files[0][0] for files in (found.left, found.right, found.scans) if files)
    mounted = {"camera": found.body_T_camera} if found.left else {}
    mounted |= {"lidar": found.body_T_lidar} if found.scans else {}
    yield first_ns, TRANSFORMS, TRANSFORMS_TYPE, partial(transforms_message, mounted, first_ns)
    infos = TOPICS.left_info, TOPICS.right_info
    for topic, files, right in zip(infos, cameras.values(), (False, True), strict=True):
        if files:
            camera = StereoCamera(**found.camera["camera"])
            make = partial(camera_info_message, camera, first_ns, "camera", right)
            yield first_ns, topic, TYPES["left_info"][0], make


def _image(path: Path, stamp_ns: int) -> Any:
    return image_message(read_image(path), stamp_ns, "camera")


def _cloud(read: Callable[[], Cloud], stamp_ns: int) -> Any:
    return cloud_message(read(), stamp_ns)


def cloud_message(cloud: Cloud, stamp_ns: int) -> Any:
    """sensor_msgs/PointCloud2 of x, y, z and, where there is one, the intensity."""
    layout = _LAYOUT if cloud.intensity is not None else np.dtype(_LAYOUT.descr[:3])
    records = np.zeros(len(cloud.points), layout)
    records["x"], records["y"], records["z"] = cloud.points.T
    if cloud.intensity is not None:
        records["intensity"] = cloud.intensity
    return packed_cloud(records, stamp_ns, is_dense=True)
