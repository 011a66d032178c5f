"""Simulated LiDAR on the rig of the rover."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Image, StereoCamera
from umf_ros.core.geometry import Array, from_quaternion, invert, make_pose
from umf_ros.core.resources import find
from umf_ros.lab.simulation.camera import Camera, cast, resized
from umf_ros.lab.simulation.relief import Field
from umf_ros.lab.simulation.world import ROCK, World
from umf_ros.sensors.calibration import Calibration, load_calibration


@dataclass(frozen=True, slots=True)
class Layout:
    """Topics and encoding of a data set's cameras.

    Attributes:
        calibration: file of the sensors, relative to the share folder.
        images: topics of the left and the right image.
        infos: topics of their camera_info; empty where there is none.
        encoding: of the images.
        rendered: width and height at which pictures are rendered before they are enlarged; None: those published.
        scan_behind_ns: by which the stamps of the scans are too early.
        right_lost: share of the right images that do not arrive.
        dummies: whether a pulse without a return is sent as a point at 1 m.
    """

    calibration: str
    images: tuple[str, str]
    infos: tuple[str, str] | None
    encoding: str
    rendered: tuple[int, int] | None = None
    scan_behind_ns: int = 0
    right_lost: float = 0.02
    dummies: bool = True

    def load(self) -> Calibration:
        """Calibration of the sensors."""
        return load_calibration(find(self.calibration))


ETNA = Layout(
    "config/calibration/simulated.yaml",
    ("/stereo/left/image_rect", "/stereo/right/image_rect"),
    ("/stereo/left/camera_info", "/stereo/right/camera_info"),
    "mono8",
)
VULCANO = Layout(
    "config/calibration/simulated_vulcano.yaml",
    ("/g319c_left/image_raw", "/g319c_right/image_raw"),
    None,
    "bayer_rggb8",
)

_COLOUR = (1.12, 1.0, 0.8)
"""Brightness of brown ground through the red, green and blue filter."""


@dataclass(frozen=True, slots=True)
class Eye:
    """One camera and where it is mounted."""

    camera: Camera
    body_T_camera: Array


def eyes(world: World, layout: Layout, calibration: Calibration) -> tuple[Eye, Eye]:
    """The left and the right camera of a layout in a world."""
    if calibration.rectifier is None:
        camera = Camera(world, _coarse(calibration.camera, layout))
        shift = make_pose(np.eye(3), [calibration.camera.baseline, 0, 0])
        mounting = calibration.body_T_camera
        return Eye(camera, mounting), Eye(camera, mounting @ shift)
    content = yaml.safe_load(find(layout.calibration).read_text(encoding="utf-8"))
    pair, mounting = content["raw_camera"], _pose(content["body_T_camera"])
    left, right = (_raw_camera(world, pair[side], layout) for side in ("left", "right"))
    return Eye(left, mounting), Eye(right, mounting @ _pose(pair["left_T_right"]))


def mosaic(image: Image) -> Image:
    """The picture through a colour filter that repeats red green / green blue."""
    gains = np.full(image.shape, _COLOUR[1], np.float32)
    gains[::2, ::2], gains[1::2, 1::2] = _COLOUR[0], _COLOUR[2]
    return np.clip(image * gains, 0, 255).astype(np.uint8)


def _raw_camera(world: World, values: dict[str, Any], layout: Layout) -> Camera:
    pinhole = {name: value for name, value in values.items() if name != "distortion"}
    return Camera(world, _coarse(StereoCamera(**pinhole, baseline=0.0), layout), values["distortion"])


def _coarse(camera: StereoCamera, layout: Layout) -> StereoCamera:
    return resized(camera, *layout.rendered) if layout.rendered else camera


def _pose(values: dict[str, list[float]]) -> Array:
    return from_quaternion(values["translation"], values["quaternion"])


LINES, PULSES = 100, 174
POINTS = LINES * PULSES
PERIOD_NS = 212_765_957
"""Time of a scan: 4.7 scans a second."""
FIELD_OF_VIEW_DEG = (70.0, 30.0)
RANGE_M = 100.0


@dataclass(frozen=True, slots=True)
class Scan:
    """All pulses of one scan, in the order they were sent.

    Attributes:
        points: (POINTS, 3) float32, m, LiDAR frame (x right, y forward, z up) at each pulse's time;
            a pulse without a return is a point at 1 m.
        intensity: (POINTS,) uint32, 0 without a return.
        ambient: (POINTS,) uint32, light of the background.
        offset_ns: (POINTS,) uint32 after the start of the scan.
    """

    points: Field
    intensity: NDArray[np.uint32]
    ambient: NDArray[np.uint32]
    offset_ns: NDArray[np.uint32]

    def returns(self) -> Scan:
        """The pulses that came back."""
        kept = self.intensity > 0
        return Scan(self.points[kept], self.intensity[kept], self.ambient[kept], self.offset_ns[kept])

    def usable(self, min_intensity: float, max_height_m: float) -> NDArray[np.bool_]:
        """(POINTS,) which pulses are returns worth using."""
        return (self.intensity > min_intensity) & (np.abs(self.points[:, 2]) < max_height_m)


def pulse_directions() -> Field:
    """(POINTS, 3) float32 unit directions in the LiDAR frame."""
    half_width, half_height = np.radians(FIELD_OF_VIEW_DEG) / 2
    azimuth, line = np.meshgrid(np.linspace(-1, 1, PULSES), np.linspace(-half_height, half_height, LINES))
    elevation = line * np.sqrt(np.clip(1 - (azimuth / 1.02) ** 2, 0, 1))
    azimuth = azimuth * half_width
    directions = [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)]
    return np.stack(directions, -1).reshape(-1, 3).astype(np.float32)


def pulse_times() -> NDArray[np.uint32]:
    """(POINTS,) uint32 nanoseconds after the start of the scan."""
    return np.linspace(0, PERIOD_NS * 0.995, POINTS).astype(np.uint32)


class Lidar:
    """Scans a world."""

    def __init__(self, world: World) -> None:
        self.world = world
        self._directions, self._times = pulse_directions(), pulse_times()

    def scan(self, world_T_start: Array, rng: np.random.Generator, world_T_end: Array | None = None) -> Scan:
        """One scan while the LiDAR moves.

        Args:
            world_T_start: pose of the LiDAR at the scan's stamp.
            rng: source of noise and dropouts.
            world_T_end: pose at the end of the scan; None for a LiDAR that stands still.
        """
        origins, directions = self._swept(world_T_start, world_T_end)
        hits = cast(self.world, origins, directions)
        distance = hits.distance
        facing = np.abs(np.einsum("ij,ij->i", hits.normal, directions))
        # at 12 m half of the light comes back, and less from dark or slanted ground
        strength = 5200 * self._reflectance(hits.geometry, hits.primitive) * facing / (1 + (distance / 12) ** 2)
        strength = np.nan_to_num(strength) * np.exp(0.12 * rng.standard_normal(POINTS))
        returned = np.isfinite(distance) & (distance > 1.0) & (distance < RANGE_M) & (strength > 4)
        returned &= rng.random(POINTS) < 0.985
        noisy = distance + 0.02 * (1 + np.minimum(distance, RANGE_M) / 60) * rng.standard_normal(POINTS)
        range_m = np.where(returned, noisy, 1.0).astype(np.float32)
        intensity = np.where(returned, np.clip(strength, 1, 4095), 0).astype(np.uint32)
        ambient = rng.poisson(60 if self.world.traits.sky > 0 else 15, POINTS).astype(np.uint32)
        return Scan(self._directions * range_m[:, None], intensity, ambient, self._times)

    def motion_free(self, scan: Scan, start_T_end: Array) -> Field:
        """(POINTS, 3) float32: the points in the LiDAR frame at the scan's stamp, given the motion over the scan."""
        rotation, shift = _line_poses(start_T_end)
        lines = scan.points.reshape(LINES, PULSES, 3)
        return (np.einsum("lij,lpj->lpi", rotation, lines) + shift[:, None]).reshape(-1, 3).astype(np.float32)

    def _swept(self, world_T_start: Array, world_T_end: Array | None) -> tuple[Field, Field]:
        """Origins and directions in the world, the LiDAR's motion taken line by line."""
        if world_T_end is None:
            directions = np.einsum("ij,nj->ni", world_T_start[:3, :3].astype(np.float32), self._directions)
            return np.broadcast_to(world_T_start[:3, 3].astype(np.float32), directions.shape), directions
        rotation, shift = _line_poses(invert(world_T_start) @ world_T_end)
        rotation = (world_T_start[:3, :3] @ rotation).astype(np.float32)
        origins = shift @ world_T_start[:3, :3].T + world_T_start[:3, 3]
        directions = np.einsum("lij,lpj->lpi", rotation, self._directions.reshape(LINES, PULSES, 3)).reshape(-1, 3)
        return np.repeat(origins.astype(np.float32), PULSES, axis=0), directions

    def _reflectance(self, geometry: NDArray[np.uint32], primitive: NDArray[np.uint32]) -> Field:
        traits = self.world.traits
        reflectance = np.full(len(geometry), traits.albedo, np.float32)
        rocks = np.flatnonzero(geometry == ROCK)
        reflectance[rocks] *= np.exp(1.6 * self.world.solids[ROCK].brightness[primitive[rocks]])
        return reflectance


def _line_poses(start_T_end: Array) -> tuple[Array, Array]:
    """Rotation (LINES, 3, 3) and shift (LINES, 3) of each line against the start of the scan."""
    fraction = (np.arange(LINES) + 0.5) / LINES
    turn = Rotation.from_matrix(start_T_end[:3, :3]).as_rotvec()
    return Rotation.from_rotvec(fraction[:, None] * turn).as_matrix(), fraction[:, None] * start_T_end[:3, 3]
