"""A rover's samples at training resolution, pass by pass."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Image
from umf_ros.core.geometry import Array, transform
from umf_ros.lab.simulation.camera import TRAINING_SIZE, Camera, Rendering, resized
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.lidar import Lidar
from umf_ros.lab.simulation.pool import ahead
from umf_ros.lab.simulation.route import SETTINGS, Pass, plan_passes, stand, thinned
from umf_ros.lab.simulation.world import World, ground
from umf_ros.sensors.calibration import Calibration, load_calibration

DEPTH_STRIDE = 4


@dataclass(frozen=True, slots=True)
class SurveyFrame:
    """One frame for training; arrays as in a shard."""

    image: Image
    points: NDArray[np.float16]
    depth: NDArray[np.float16]
    world_T_body: Array
    pass_index: int
    sun: tuple[float, float]


class Survey:
    """Drives a rover over the passes of one world and yields training samples."""

    def __init__(self, world: World, passes: list[Pass], calibration: Calibration | None = None) -> None:
        """Place the rover; its sensors are those of the simulated rig where none are given."""
        self.world, self.passes, self.calibration = world, passes, calibration or load_calibration("simulated")
        self._camera = Camera(world, resized(self.calibration.camera, *TRAINING_SIZE))
        self._lidar = Lidar(world)

    def __len__(self) -> int:
        return sum(len(drive.path) for drive in self.passes)

    def __iter__(self) -> Iterator[SurveyFrame]:
        return self.samples()

    def samples(self, workers: int = 2) -> Iterator[SurveyFrame]:
        """All samples in order, the same for any number of rendering threads."""
        tasks = [(index, step) for index, drive in enumerate(self.passes) for step in range(len(drive.path))]
        with ThreadPoolExecutor(workers) as pool:
            yield from ahead(pool, lambda task: self.sample(*task), tasks)

    def pose(self, index: int, step: int) -> Array:
        """True `world_T_body` of one sample of a numbered pass."""
        drive, here = self.passes[index], slice(step, step + 1)
        x, y = drive.path[here].T
        return stand(self.world.relief, x, y, drive.yaw[here], drive.tilt[here])[0]

    def image(self, index: int, step: int) -> Image:
        """The image alone of one sample of a numbered pass."""
        return self._take(index, step)[0].image

    def _take(self, index: int, step: int) -> tuple[Rendering, np.random.Generator]:
        """What the camera sees, and what draws everything random that comes after it."""
        drive = self.passes[index]
        rng = np.random.default_rng([self.world.seed, 4, index, step])
        world_T_camera = self.pose(index, step) @ self.calibration.body_T_camera
        return self._camera.take(world_T_camera, drive.sun, rng, drive.exposure), rng

    def sample(self, index: int, step: int) -> SurveyFrame:
        """One sample of a numbered pass."""
        drive, calibration = self.passes[index], self.calibration
        pose = self.pose(index, step)
        picture, rng = self._take(index, step)
        scan = self._lidar.scan(pose @ calibration.body_T_lidar, rng)
        kept = scan.usable(calibration.min_intensity, calibration.max_height_m)
        in_body = transform(calibration.body_T_lidar, scan.points[kept])
        points = np.column_stack([in_body, scan.intensity[kept]]).astype(np.float16)
        depth = picture.depth[2::DEPTH_STRIDE, 2::DEPTH_STRIDE].astype(np.float16)
        sun = (drive.sun.azimuth_deg, drive.sun.elevation_deg)
        return SurveyFrame(picture.image, points, depth, pose.astype(np.float32), index, sun)


def survey_world(
    seed: int, family: str, setting: str, calibration: Calibration | None = None, every: int = 1
) -> Survey:
    """The passes that a shard holds: two or three, at `every` times 1.2 or 1.6 m steps."""
    chosen = SETTINGS[setting]
    rng = np.random.default_rng([seed, 5])
    labels, step = _itinerary(rng)
    relief = ground(seed, family, chosen.aliasing)
    passes = plan_passes(relief.trail, labels, chosen, step, seed)
    world = World(seed, family, chosen.aliasing, np.concatenate([drive.path for drive in passes]), relief)
    return Survey(world, [thinned(drive, every) for drive in passes], calibration)


def _itinerary(rng: np.random.Generator) -> tuple[tuple[str, ...], float]:
    choice = rng.random()
    if choice < 0.4:
        return ("first", "offset"), 1.2
    if choice < 0.8:
        return ("first", "offset", "offset"), 1.6
    return ("first", "offset", "opposite"), 1.6


def shard_plan(seed: int) -> tuple[str, str]:
    """Family and setting of a seed's shard: families in turn, two of three hard."""
    return FAMILIES[seed % len(FAMILIES)], "easy" if seed % 3 == 2 else "hard"
