"""An imported data set as a recording with its settings and its calibration beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from umf_ros.bags.presets import GROUND_TRUTH_TOPIC
from umf_ros.bags.storages import message_types
from umf_ros.core.config import Topics
from umf_ros.lab.importing.imported import Imported
from umf_ros.lab.simulation.bag_writer import BagWriter
from umf_ros.lab.simulation.messages import image_message, pose_message
from umf_ros.runs.writer import write_atomically
from umf_ros.sensors.decode import Cloud
from umf_ros.sensors.scan_files import read_image

_LAYOUT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
_FLOAT32 = 7

Entry = tuple[int, str, Callable[[], Any]]


def write_recording(found: Imported, out: Path, progress: Callable[[float], None] = lambda _: None) -> Path:
    """Write OUT.mcap, OUT.calibration.yaml and OUT.yaml; returns the last, the --config of the recording.

    Raises:
        OutputError: one of them cannot be written.
        SensorFileError: a file of the data set cannot be read.
    """
    entries = sorted(_entries(found), key=lambda entry: entry[0])
    with BagWriter(out) as bag:
        for number, (stamp, topic, make) in enumerate(entries, 1):
            bag.write(topic, make(), stamp)
            progress(number / len(entries))
    calibration, config = out.with_suffix(".calibration.yaml"), out.with_suffix(".yaml")
    notes = "".join(f"# TO BE MEASURED: {what}\n" for what in found.guessed)
    write_atomically(calibration, notes + yaml.safe_dump(found.calibration(), sort_keys=False))
    absent = {"odometry": "", "left_info": "", "right_info": ""}
    parameters = {"calibration": str(calibration.resolve()), "topics": absent}
    write_atomically(config, yaml.safe_dump({"/**": {"ros__parameters": parameters}}, sort_keys=False))
    return config


def _entries(found: Imported) -> Iterator[Entry]:
    topics = Topics()
    for topic, files in ((topics.left_image, found.left), (topics.right_image, found.right)):
        for stamp, path in files:
            yield stamp, topic, lambda stamp=stamp, path=path: image_message(read_image(path), stamp, "camera")  # type: ignore[misc]
    for stamp, read in found.scans:
        yield stamp, topics.cloud, lambda stamp=stamp, read=read: cloud_message(read(), stamp)  # type: ignore[misc]
    if found.truth is not None:
        for stamp, pose in zip(found.truth.stamps_ns.tolist(), found.truth.poses, strict=True):
            yield stamp, GROUND_TRUTH_TOPIC, lambda stamp=stamp, pose=pose: pose_message(pose, stamp, "map")  # type: ignore[misc]


def cloud_message(cloud: Cloud, stamp_ns: int, frame: str = "lidar") -> Any:
    """sensor_msgs/PointCloud2 of x, y, z and, where there is one, the intensity."""
    layout = _LAYOUT if cloud.intensity is not None else np.dtype(_LAYOUT.descr[:3])
    records = np.zeros(len(cloud.points), layout)
    records["x"], records["y"], records["z"] = cloud.points.T
    if cloud.intensity is not None:
        records["intensity"] = cloud.intensity
    types = message_types().types
    field = types["sensor_msgs/msg/PointField"]
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return types["sensor_msgs/msg/PointCloud2"](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame),
        height=1,
        width=len(records),
        fields=[
            field(name=name, offset=4 * place, datatype=_FLOAT32, count=1)
            for place, name in enumerate(layout.names or ())
        ],
        is_bigendian=False,
        point_step=layout.itemsize,
        row_step=layout.itemsize * len(records),
        data=records.view(np.uint8).reshape(-1),
        is_dense=True,
    )
