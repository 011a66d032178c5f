"""A rover with S3LI's sensors on a drive through a world."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from umf_ros.core.errors import ConfigError
from umf_ros.core.frames import Frame, Image, ScanMotion
from umf_ros.core.geometry import Array, relative, transform
from umf_ros.lab.simulation.camera import Rendering
from umf_ros.lab.simulation.lidar import PERIOD_NS, Lidar, Scan, eyes, mosaic
from umf_ros.lab.simulation.motion_sensors import Motion, drifting
from umf_ros.lab.simulation.presets import Preset
from umf_ros.lab.simulation.route import NIGHT, Route
from umf_ros.lab.simulation.shading import Sun
from umf_ros.lab.simulation.world import World, ground

START_NS = 1_625_644_800 * 10**9
"""Every drive starts on the day S3LI Etna was recorded: 2021-07-07 08:00 UTC."""
ODOMETRY_HZ = 25.0
SHORTEST_S = 2.0
FASTEST_HZ = 30.0
_EXPOSURE_S = 0.006
_JITTER_S = 0.003
_DROPPED_RIGHT = 0.02


@dataclass(frozen=True, slots=True)
class Exposure:
    """One time the cameras fire.

    Attributes:
        stamp_ns: when.
        number: counts from 0.
        right: whether the right image arrives.
    """

    stamp_ns: int
    number: int
    right: bool


class Simulator:
    """Simulates one drive; every measurement depends on the arguments alone, not on what was asked before.

    Attributes:
        world: where.
        route: the path.
        motion: where the rover is when.
        duration_s: length of the recording.
        scan_stamps_ns: start of each scan.
        exposures: when the cameras fire.
        odometry: what the odometry says.
    """

    def __init__(
        self,
        preset: Preset,
        seed: int,
        duration_s: float | None = None,
        image_rate_hz: float | None = None,
        family: str | None = None,
        aliasing: float | None = None,
        world_seed: int | None = None,
    ) -> None:
        """Build the world and plan the drive.

        Args:
            preset: what to drive.
            seed: route, light and noise.
            duration_s: cut the recording here; None drives the whole route.
            image_rate_hz: images per second; None takes one near each scan.
            family: kind of world; None takes the preset's.
            aliasing: 0 to 1; None takes the preset's.
            world_seed: of the world, where several drives go through one; None takes `seed`.

        Raises:
            ConfigError: negative seed, unknown family, or a duration or image rate that cannot be.
        """
        if image_rate_hz is not None and not 0.1 <= image_rate_hz <= FASTEST_HZ:
            raise ConfigError(f"image rate {image_rate_hz:g} Hz is not between 0.1 and {FASTEST_HZ:g}")
        family, aliasing = family or preset.family, preset.aliasing if aliasing is None else aliasing
        self.preset, self.seed = preset, seed
        world_seed = seed if world_seed is None else world_seed
        relief = ground(world_seed, family, aliasing, preset.pan)
        self.route: Route = preset.route(relief, seed)
        self.motion = Motion(relief, self.route, preset.speed_m_s, preset.tilt_deg, seed)
        self.duration_s = self._checked(duration_s)
        self.world = World(world_seed, family, aliasing, preset.clearing(relief, seed), relief)
        self.calibration = preset.layout.load()
        self._eyes, self._lidar = eyes(self.world, preset.layout, self.calibration), Lidar(self.world)
        self._sun = self._morning()
        nights = [start for label, start, _ in self.route.legs() if label == NIGHT]
        self._sunset_m = min(nights, default=np.inf)
        self.scan_stamps_ns = START_NS + PERIOD_NS * np.arange(int((self.duration_s - 0.3) * 1e9 / PERIOD_NS))
        self.exposures = self._exposures(image_rate_hz)
        self.odometry = drifting(self.motion, preset.drift, np.arange(0, self.duration_s, 1 / ODOMETRY_HZ), seed)

    def pose(self, stamp_ns: int) -> Array:
        """True (4, 4) `world_T_body` at a time."""
        return self.motion.pose(_seconds(stamp_ns))

    def sun(self, stamp_ns: int) -> Sun:
        """Where the sun stands at a time; the hours pass quickly."""
        driven = float(self.motion.path_length(_seconds(stamp_ns)))
        sun = self._sun.moved(driven / self.route.length_m * self.preset.sun_deg)
        return sun.set_for(driven - self._sunset_m) if driven > self._sunset_m else sun

    def scan(self, number: int) -> Scan:
        """The numbered scan, taken while the rover moves."""
        start, end = self._lidar_poses(number)
        return self._lidar.scan(start, np.random.default_rng([self.seed, 11, number]), end)

    def stereo(self, exposure: Exposure) -> tuple[Rendering, Rendering | None]:
        """Left and right picture of an exposure; no right one where it is dropped."""
        return self.picture(exposure), self.picture(exposure, right=True) if exposure.right else None

    def picture(self, exposure: Exposure, right: bool = False) -> Rendering:
        """One picture of an exposure, with the truth behind it."""
        rng = np.random.default_rng([self.seed, 12, exposure.number, int(right)])
        eye = self._eyes[int(right)]
        turning = self.motion.angular(_seconds(exposure.stamp_ns))[0] @ eye.body_T_camera[:3, :3]
        # a turn about the camera's y axis moves the picture along x, and the other way round
        smear = turning[[1, 0]] * eye.camera.intrinsics.fx * _EXPOSURE_S
        pose = self.pose(exposure.stamp_ns) @ eye.body_T_camera
        return eye.camera.take(pose, self.sun(exposure.stamp_ns), rng, 1.0, smear)

    def published(self, picture: Rendering) -> Image:
        """The image as the camera's driver sends it."""
        return mosaic(picture.image) if self.preset.layout.encoding.startswith("bayer") else picture.image

    def frames(self) -> Iterator[Frame]:
        """Synchronised frames, one per scan, without a file in between; needs one exposure per scan."""
        for number, exposure in zip(range(len(self.scan_stamps_ns)), self.exposures, strict=True):
            frame, (left, right) = self.scan_frame(number), self._rectified(exposure)
            moved = relative(self.pose(frame.stamp_ns), self.pose(exposure.stamp_ns))
            yield replace(
                frame,
                body_T_camera=moved @ frame.body_T_camera,
                left=left,
                right=right,
                image_stamp_ns=exposure.stamp_ns,
            )

    def scan_frame(self, number: int) -> Frame:
        """The frame of the numbered scan, without images."""
        kept, stamp = self.calibration, int(self.scan_stamps_ns[number])
        scan, (start, end) = self.scan(number), self._lidar_poses(number)
        usable = scan.usable(kept.min_intensity, kept.max_height_m)
        points = self._lidar.motion_free(scan, relative(start, end))
        return Frame(
            stamp_ns=stamp,
            camera=kept.camera,
            body_T_camera=kept.body_T_camera,
            body_T_lidar=kept.body_T_lidar,
            points=transform(kept.body_T_lidar, points[usable]),
            intensity=scan.intensity[usable].astype(np.float32),
            odom_T_body=self.odometry_at(stamp),
            motion=ScanMotion.none(int(usable.sum())),
        )

    def _rectified(self, exposure: Exposure) -> tuple[Image, Image | None]:
        left, right = self.stereo(exposure)
        rectifier = self.calibration.rectifier
        if rectifier is None:
            return left.image, right.image if right else None
        return rectifier.apply(left.image, 0), rectifier.apply(right.image, 1) if right else None

    def odometry_at(self, stamp_ns: int) -> Array:
        """Odometry at any time: the last sample, moved on by the true motion since."""
        time_s = _seconds(stamp_ns)
        last = int(np.searchsorted(self.odometry.times_s, time_s, side="right")) - 1
        since = relative(self.motion.pose(self.odometry.times_s[last]), self.motion.pose(time_s))
        return self.odometry.poses[last] @ since

    def _lidar_poses(self, number: int) -> tuple[Array, Array]:
        stamp, mounting = int(self.scan_stamps_ns[number]), self.calibration.body_T_lidar
        return self.pose(stamp) @ mounting, self.pose(stamp + PERIOD_NS) @ mounting

    def _morning(self) -> Sun:
        return Sun.drawn(18, 40, np.random.default_rng([self.seed, 13]))

    def _exposures(self, rate_hz: float | None) -> list[Exposure]:
        rng = np.random.default_rng([self.seed, 14])
        if rate_hz is None:
            jitter = np.clip(_JITTER_S * rng.standard_normal(len(self.scan_stamps_ns)), -0.009, 0.009)
            stamps = np.maximum(self.scan_stamps_ns + (jitter * 1e9).astype(np.int64), START_NS)
        else:
            stamps = START_NS + (np.arange(0, self.duration_s - 0.3, 1 / rate_hz) * 1e9).astype(np.int64)
        arrived = rng.random(len(stamps)) >= _DROPPED_RIGHT
        return [
            Exposure(int(stamp), i, bool(right)) for i, (stamp, right) in enumerate(zip(stamps, arrived, strict=True))
        ]

    def _checked(self, duration_s: float | None) -> float:
        longest = self.motion.duration_s
        if duration_s is None:
            return longest
        if not SHORTEST_S <= duration_s <= longest:
            raise ConfigError(
                f"duration {duration_s:g} s is not between {SHORTEST_S:g} and {longest:.0f} s, the whole drive"
            )
        return duration_s


def stamp_ns(time_s: float) -> int:
    """Stamp of a time on the drive's own clock, which starts at 0."""
    return START_NS + round(float(time_s) * 1e9)


def _seconds(stamp: int) -> float:
    """The drive's own time at a stamp."""
    return (stamp - START_NS) * 1e-9
