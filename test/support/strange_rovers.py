"""Rovers of strange kinds: their sensors and their rigs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, Image, ScanMotion
from umf_ros.lab.simulation.lidar import ETNA


@dataclass(frozen=True)
class Rover:
    """Differences from the rover that the network was trained on.

    Attributes:
        family: the worlds it drives in.
        height_m: of the camera; down_deg: its tilt.
        focal_px: of 688 columns.
        gamma: of its response; dark: how much the corners lose.
        every: of the LiDAR's pulses, one is kept; right_deg: none further to the right.
        unit: of the intensity, against the Cube-1's; 0: it has none.
        noise_m: more of each range.
    """

    family: str
    height_m: float
    down_deg: float
    focal_px: float
    gamma: float
    dark: float
    every: int
    right_deg: float
    unit: float
    noise_m: float


ROVERS = (
    Rover("canyon", 0.55, 4.0, 420.0, 0.6, 0.5, 3, 35.0, 0.01, 0.01),
    Rover("mounds", 2.1, 18.0, 330.0, 1.6, 0.3, 2, 10.0, 0.0, 0.02),
    Rover("moon", 1.0, 0.0, 800.0, 1.0, 0.0, 5, 35.0, 16.0, 0.04),
)


class StrangeSensors:
    """Turns the frames of the simulated rig into those of a rover's sensors.

    Args:
        rover: whose.
        seed: of the noise.
    """

    def __init__(self, rover: Rover, seed: int) -> None:
        self._rover, self._rng = rover, np.random.default_rng([seed, 77])

    def see(self, frame: Frame) -> Frame:
        """The frame as they would have taken it."""
        if frame.left is not None:
            right = None if frame.right is None else self._exposed(frame.right)
            frame = replace(frame, left=self._exposed(frame.left), right=right)
        return frame if frame.points is None else self._swept(frame)

    def _exposed(self, image: Image) -> Image:
        rows, columns = (np.linspace(-1, 1, count) for count in image.shape)
        corner = 1 - self._rover.dark * (rows[:, None] ** 2 + columns**2) / 2
        return (255 * (image / 255 * corner) ** self._rover.gamma).astype(np.uint8)

    def _swept(self, frame: Frame) -> Frame:
        assert frame.points is not None and frame.intensity is not None
        rover, points = self._rover, frame.points
        bearing = np.degrees(np.arctan2(-points[:, 1], points[:, 0]))
        kept = np.flatnonzero((np.arange(len(points)) % rover.every == 0) & (bearing < rover.right_deg))
        away = points[kept] - frame.body_T_lidar[:3, 3].astype(np.float32)
        longer = rover.noise_m * self._rng.standard_normal((len(kept), 1)) / np.linalg.norm(away, axis=1, keepdims=True)
        moved = frame.motion
        return replace(
            frame,
            points=(points[kept] + longer * away).astype(np.float32),
            intensity=frame.intensity[kept] * rover.unit if rover.unit else None,
            motion=moved and ScanMotion(moved.moments_s[kept], moved.rates, moved.noise),
        )


def calibration_of(rover: Rover, path: Path) -> Path:
    """The simulated rig's calibration with the rover's camera in it, written to a file."""
    content = yaml.safe_load(Path(__file__).parents[2].joinpath(ETNA.calibration).read_text(encoding="utf-8"))
    content["camera"] |= {"fx": rover.focal_px, "fy": rover.focal_px}
    mount = content["body_T_camera"]
    lower = rover.height_m - mount["translation"][2]
    for name in ("body_T_camera", "body_T_lidar", "body_T_imu"):
        content[name]["translation"][2] += lower
    tilted = Rotation.from_euler("y", rover.down_deg, degrees=True) * Rotation.from_quat(mount["quaternion"])
    mount["quaternion"] = tilted.as_quat().tolist()
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path
