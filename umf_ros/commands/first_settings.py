"""A first parameter file and a first calibration for a recording that was looked at."""

from __future__ import annotations

import numpy as np

from umf_ros.commands.inspection import Inspected
from umf_ros.core.config import Topics
from umf_ros.core.errors import MessageError
from umf_ros.core.geometry import Array, make_pose, to_quaternion
from umf_ros.sensors.decode import decode_camera_info
from umf_ros.sensors.tf import TOPIC, StaticTransforms

OPTICAL = make_pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""`body_T_camera` of a camera that looks ahead, at the origin: what stands in for a mounting nobody told."""
BODIES = ("base_link", "base_footprint", "body", "imu_link")
GUESS = "TO BE MEASURED: a guess"
RAW = "  # the images look raw: rectify them, or see raw_camera in config/calibration/s3li_vulcano.yaml"


def write_settings(found: Inspected, calibration: str) -> str:
    """A first parameter file: the topics, and the calibration beside it."""
    defaults = Topics().model_dump()
    topics = {name: topic for name, topic in found.topics.model_dump().items()}
    lines = ["# What umf inspect found; docs/parameters.md lists everything that may stand here.", "/**:"]
    lines += ["  ros__parameters:", f"    calibration: {calibration}", "    topics:"]
    lines += [f'      {name}: "{topic}"' for name, topic in topics.items() if topic or defaults[name]]
    return "\n".join(lines) + "\n"


def write_calibration(found: Inspected, transforms: StaticTransforms) -> str:
    """A first calibration: intrinsics of the camera_info, mountings of /tf_static, and what has to be measured."""
    lines = ["# Written by umf inspect. Metres, quaternions x y z w; poses in the body frame (x ahead, y left, z up)."]
    lines += _camera_lines(found)
    frames = [found.frames.get(name, "") for name in ("cloud", "left_image")]
    bodies = [name for frame in frames for name in BODIES if frame and transforms.find(name, frame) is not None]
    body = bodies[0] if bodies else ""
    for key, name, usual in (("body_T_camera", "left_image", OPTICAL), ("body_T_lidar", "cloud", np.eye(4))):
        frame = found.frames.get(name, "")
        known = transforms.find(body, frame) if body and frame else None
        note = f"of {frame} in {body}, from {TOPIC}" if known is not None else GUESS
        lines += _pose_lines(key, usual if known is None else known, note)
    lines += _pose_lines("body_T_imu", np.eye(4), "only for --odometry-frame imu")
    lines += ["lidar_time_offset_s: 0.0  # from a scan's stamp to the moment its points are brought to"]
    lines += ["min_intensity: 0", "max_height_m: 0  # both off"]
    return "\n".join(lines) + "\n"


def _camera_lines(found: Inspected) -> list[str]:
    left, right = found.info.get("left"), found.info.get("right")
    if left is None:
        width, height = found.image_size or (640, 480)
        focal = 0.8 * width
        numbers = {"width": width, "height": height, "fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2}
        return [f"camera:  # {GUESS}", *_mapping(numbers | {"baseline": 0.0})]
    try:
        camera = decode_camera_info(left, right)
    except MessageError:
        camera = decode_camera_info(left)
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "baseline")}
    raw = np.any(np.asarray(left.d, float)) and "rect" not in found.topics.left_image
    return [f"camera:{RAW if raw else ''}", *_mapping(numbers)]


def _mapping(numbers: dict[str, float]) -> list[str]:
    return [f"  {name}: {value:.10g}" for name, value in numbers.items()]


def _pose_lines(name: str, pose: Array, note: str) -> list[str]:
    shift, turn = ([f"{value:.9g}" for value in values] for values in (pose[:3, 3], to_quaternion(pose)))
    return [f"{name}:  # {note}", f"  translation: [{', '.join(shift)}]", f"  quaternion: [{', '.join(turn)}]"]
