"""A rover with S3LI's sensors on a drive through a world, and the drive as a recording on S3LI's topics."""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from umf_ros.core.errors import ConfigError, writing
from umf_ros.core.frames import Frame, Image, ScanMotion
from umf_ros.core.geometry import Array, relative, transform
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.lab.simulation import motion_sensors
from umf_ros.lab.simulation.bag_writer import (
    Recorder,
    camera_info_message,
    cloud_message,
    fix_message,
    image_message,
    imu_message,
    odometry_message,
    pose_message,
)
from umf_ros.lab.simulation.camera import Rendering, Sun, ahead
from umf_ros.lab.simulation.lidar import PERIOD_NS, Lidar, Scan, eyes, mosaic
from umf_ros.lab.simulation.motion_sensors import Motion, drifting
from umf_ros.lab.simulation.presets import Preset
from umf_ros.lab.simulation.route import NIGHT, Route
from umf_ros.lab.simulation.world import World, ground

START_NS = 1_625_644_800 * 10**9
"""Every drive starts on the day S3LI Etna was recorded: 2021-07-07 08:00 UTC."""
ODOMETRY_HZ = 25.0
SHORTEST_S = 2.0
FASTEST_HZ = 30.0
_EXPOSURE_S = 0.006
_JITTER_S = 0.003


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
        world: World | None = None,
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
            world: the world itself, where it is at hand and clear of rocks on the route; goes before the above.

        Raises:
            ConfigError: negative seed, unknown family, or a duration or image rate that cannot be.
        """
        if image_rate_hz is not None and not 0.1 <= image_rate_hz <= FASTEST_HZ:
            raise ConfigError(f"image rate {image_rate_hz:g} Hz is not between 0.1 and {FASTEST_HZ:g}")
        family, aliasing = family or preset.family, preset.aliasing if aliasing is None else aliasing
        self.preset, self.seed = preset, seed
        world_seed = seed if world_seed is None else world_seed
        relief = world.relief if world else ground(world_seed, family, aliasing, preset.pan)
        self.route: Route = preset.route(relief, seed)
        self.motion = Motion(relief, self.route, preset.speed_m_s, preset.tilt_deg, seed)
        self.duration_s = self._checked(duration_s)
        self.world = world or World(world_seed, family, aliasing, preset.clearing(relief, seed), relief)
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
        size, raw = self.calibration.image_size, self.preset.layout.encoding.startswith("bayer")
        image: Any = picture.image
        if image.shape[::-1] != size:
            # equal neighbours pack well, and binning takes them together again
            image = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if raw else cv2.INTER_LINEAR)
        return mosaic(image) if raw else image

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
        arrived = rng.random(len(stamps)) >= self.preset.layout.right_lost
        return [Exposure(int(at), i, bool(right)) for i, (at, right) in enumerate(zip(stamps, arrived, strict=True))]

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


Event = tuple[int, int, str, Any]
"""Time of recording in ns, rank of its stream, topic and message."""

CLOUD_TOPIC = "/bf_lidar/points_raw"
_IMAGE_DELAY_NS, _CLOUD_DELAY_NS, _ODOMETRY_DELAY_NS = 9_000_000, 4_000_000, 2_000_000


def record(
    simulator: Simulator,
    bag: Recorder,
    workers: int = 2,
    truth: bool = False,
    progress: Callable[[int], None] = lambda done: None,
    sensors_only: bool = False,
) -> None:
    """Simulate a drive into a bag; the bytes do not depend on the number of workers.

    Args:
        simulator: the drive.
        bag: what to write to.
        workers: threads that render.
        truth: add depth (32FC1, m), semantic (mono8) and instance (32SC1) maps of the left image.
        progress: called with the number of scans done.
        sensors_only: leave out odometry, ground truth and positions by satellites.

    Raises:
        OutputError: the bag cannot be written; nothing is left of it.
    """
    bag.note("simulation", describe(simulator))
    _ = simulator.world.scene  # once, before several threads ask for it
    with ThreadPoolExecutor(workers) as pool:
        done = 0
        for log_ns, _, topic, message in heapq.merge(
            *_streams(simulator, pool, truth, sensors_only), key=lambda event: event[:2]
        ):
            bag.write(topic, message, log_ns)
            if topic == CLOUD_TOPIC:
                done += 1
                progress(done)


def write_side_files(simulator: Simulator, bag: Path) -> None:
    """Write what S3LI keeps beside its bags: the odometry as a TUM file, the positions as an RTKLIB `.pos` file.

    Raises:
        OutputError: a file cannot be written.
    """
    run = simulator.odometry
    stamps = np.array([stamp_ns(time_s) for time_s in run.times_s], np.int64)
    write_tum(bag.with_suffix(".odometry.tum"), Trajectory(stamps, run.poses))
    text = motion_sensors.rtklib_text(
        motion_sensors.measure_gnss(simulator.motion, simulator.duration_s, simulator.seed), START_NS
    )
    with writing(bag.with_suffix(".pos")):
        bag.with_suffix(".pos").write_text(text, encoding="ascii")


def describe(simulator: Simulator) -> dict[str, str]:
    """Facts about the simulated drive, as text; the legs are labels with first and last metre and stamp."""
    legs = [
        {
            "label": label,
            "from_m": round(start, 1),
            "to_m": round(end, 1),
            "from_ns": stamp_ns(simulator.motion.reached(start)),
            "to_ns": stamp_ns(simulator.motion.reached(end)),
        }
        for label, start, end in simulator.route.legs()
    ]
    world = simulator.world
    return {
        "seed": str(simulator.seed),
        "family": world.family,
        "aliasing": str(world.aliasing),
        "legs": json.dumps(legs),
        "drift": json.dumps(asdict(simulator.preset.drift)),
    }


def _streams(simulator: Simulator, pool: ThreadPoolExecutor, truth: bool, sensors_only: bool) -> list[Iterator[Event]]:
    sensors = [_images(simulator, pool, truth), _clouds(simulator, pool), _imu(simulator)]
    return sensors if sensors_only else [*sensors, _odometry(simulator), _ground_truth(simulator), _fixes(simulator)]


def _images(simulator: Simulator, pool: ThreadPoolExecutor, truth: bool) -> Iterator[Event]:
    layout, camera = simulator.preset.layout, simulator.calibration.camera
    pairs = ahead(pool, simulator.stereo, simulator.exposures)
    for exposure, pair in zip(simulator.exposures, pairs, strict=True):
        stamp, log_ns = exposure.stamp_ns, exposure.stamp_ns + _IMAGE_DELAY_NS
        for side, picture in enumerate(pair):
            if picture is None:
                continue
            frame = ("left_camera", "right_camera")[side]
            image = simulator.published(picture)
            yield log_ns, 0, layout.images[side], image_message(image, stamp, frame, layout.encoding)
            if layout.infos:
                yield log_ns, 0, layout.infos[side], camera_info_message(camera, stamp, frame, right=side == 1)
        if truth:
            yield from _maps(pair[0], stamp, log_ns)


def _maps(picture: Rendering, stamp: int, log_ns: int) -> Iterator[Event]:
    for name, values, encoding in (
        ("depth", picture.depth, "32FC1"),
        ("semantic", picture.semantic, "mono8"),
        ("instance", picture.instance, "32SC1"),
    ):
        yield log_ns, 0, f"/ground_truth/{name}", image_message(values, stamp, "left_camera", encoding)


def _clouds(simulator: Simulator, pool: ThreadPoolExecutor) -> Iterator[Event]:
    layout = simulator.preset.layout
    scans = ahead(pool, simulator.scan, range(len(simulator.scan_stamps_ns)))
    for stamp, scan in zip(simulator.scan_stamps_ns, scans, strict=True):
        sent, stated = scan if layout.dummies else scan.returns(), int(stamp) - layout.scan_behind_ns
        yield int(stamp) + PERIOD_NS + _CLOUD_DELAY_NS, 1, CLOUD_TOPIC, cloud_message(sent, stated)


def _imu(simulator: Simulator) -> Iterator[Event]:
    data = motion_sensors.measure_imu(
        simulator.motion, simulator.calibration.body_T_imu, simulator.duration_s, simulator.seed
    )
    for time_s, rate, force in zip(data.times_s, data.rate, data.force, strict=True):
        stamp = stamp_ns(time_s)
        yield stamp, 2, "/imu/data", imu_message(rate, force, stamp)


def _odometry(simulator: Simulator) -> Iterator[Event]:
    run = simulator.odometry
    for time_s, pose, twist, deviations in zip(run.times_s, run.poses, run.twists, run.deviations, strict=True):
        stamp = stamp_ns(time_s)
        message = odometry_message(pose, twist, deviations, stamp, ("odom", "base_link"))
        yield stamp + _ODOMETRY_DELAY_NS, 3, "/odom", message


def _ground_truth(simulator: Simulator) -> Iterator[Event]:
    times = simulator.odometry.times_s
    for time_s, pose in zip(times, simulator.motion.poses(times), strict=True):
        stamp = stamp_ns(time_s)
        yield stamp, 4, "/ground_truth/pose", pose_message(pose, stamp, "world")


def _fixes(simulator: Simulator) -> Iterator[Event]:
    track = motion_sensors.measure_gnss(simulator.motion, simulator.duration_s, simulator.seed)
    for time_s, geodetic, deviation in zip(track.times_s, track.geodetic, track.deviation_m, strict=True):
        stamp = stamp_ns(time_s)
        yield stamp, 5, "/gnss/fix", fix_message(geodetic, float(deviation), stamp)
