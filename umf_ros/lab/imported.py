"""A data set's files as a recording: what a format finds, and how it is written."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from umf_ros.bags.presets import GROUND_TRUTH_TOPIC
from umf_ros.core.config import Topics
from umf_ros.core.errors import OutputError
from umf_ros.core.geometry import Array, make_pose, to_quaternion
from umf_ros.core.io import write_atomically
from umf_ros.core.trajectory import Trajectory
from umf_ros.lab.scan_files import SensorFileError, read_image
from umf_ros.lab.simulation.bag_writer import BagWriter, image_message, packed_cloud, pose_message
from umf_ros.sensors.decode import Cloud

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
        poses = {"body_T_camera": self.body_T_camera, "body_T_lidar": self.body_T_lidar, "body_T_imu": np.eye(4)}
        told: dict[str, Any] = {**self.camera, **{name: pose_entry(pose) for name, pose in poses.items()}}
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


_LAYOUT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])

TOPICS = Topics(
    left_image="/camera/left/image",
    right_image="/camera/right/image",
    left_info="",
    right_info="",
    cloud="/lidar/points",
    odometry="",
)
"""Of an imported recording: those of no known data set, whose calibration it does not have."""


def check_absent(*paths: Path) -> None:
    """Raise an `OutputError` if one of some files, which a person may have changed, would be overwritten."""
    for path in paths:
        if path.exists():
            raise OutputError(f"{path} is there already: nothing was written")


Entry = tuple[int, str, Callable[[], Any]]


def write_recording(found: Imported, out: Path, progress: Callable[[float], None] = lambda _: None) -> Path:
    """Write OUT.mcap, OUT.calibration.yaml and OUT.yaml; returns the last, the --config of the recording.

    Raises:
        OutputError: one of them is there already, or cannot be written.
        SensorFileError: a file of the data set cannot be read.
    """
    calibration, config = out.with_suffix(".calibration.yaml"), out.with_suffix(".yaml")
    check_absent(out, calibration, config)
    entries = sorted(_entries(found), key=lambda entry: entry[0])
    with BagWriter(out) as bag:
        for number, (stamp, topic, make) in enumerate(entries, 1):
            bag.write(topic, make(), stamp)
            progress(number / len(entries))
    notes = "".join(f"# TO BE MEASURED: {what}\n" for what in found.guessed)
    write_atomically(calibration, notes + yaml.safe_dump(found.calibration(), sort_keys=False))
    parameters = {"calibration": str(calibration.resolve()), "topics": TOPICS.model_dump()}
    write_atomically(config, yaml.safe_dump({"/**": {"ros__parameters": parameters}}, sort_keys=False))
    return config


def _entries(found: Imported) -> Iterator[Entry]:
    for topic, files in ((TOPICS.left_image, found.left), (TOPICS.right_image, found.right)):
        for stamp, path in files:
            yield stamp, topic, lambda stamp=stamp, path=path: image_message(read_image(path), stamp, "camera")  # type: ignore[misc]
    for stamp, read in found.scans:
        yield stamp, TOPICS.cloud, lambda stamp=stamp, read=read: cloud_message(read(), stamp)  # type: ignore[misc]
    if found.truth is not None:
        for stamp, pose in zip(found.truth.stamps_ns.tolist(), found.truth.poses, strict=True):
            yield stamp, GROUND_TRUTH_TOPIC, lambda stamp=stamp, pose=pose: pose_message(pose, stamp, "map")  # type: ignore[misc]


def cloud_message(cloud: Cloud, stamp_ns: int) -> Any:
    """sensor_msgs/PointCloud2 of x, y, z and, where there is one, the intensity."""
    layout = _LAYOUT if cloud.intensity is not None else np.dtype(_LAYOUT.descr[:3])
    records = np.zeros(len(cloud.points), layout)
    records["x"], records["y"], records["z"] = cloud.points.T
    if cloud.intensity is not None:
        records["intensity"] = cloud.intensity
    return packed_cloud(records, stamp_ns, is_dense=True)
