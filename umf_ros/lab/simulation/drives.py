"""Simulated drives with known poses, as frames for the detector, from shards or made on the spot."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.progress import track
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, Image, Keyframe, ScanMotion, StereoCamera
from umf_ros.core.geometry import Array, make_pose, relative, rotation_angle, transform
from umf_ros.core.io import atomic_write
from umf_ros.detector import make_keyframe
from umf_ros.embedding import Embedder
from umf_ros.lab.simulation.camera import TRAINING_SIZE, resized
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.route import SETTINGS, plan_passes
from umf_ros.lab.simulation.survey import Survey
from umf_ros.lab.simulation.world import World, ground
from umf_ros.sensors.calibration import Calibration, load_calibration

Made = TypeVar("Made")
SPEED_M_S = 1.0
STEP_M = 2.4  # between frames
SCALE_ERROR, TURN_ERROR_RAD_M = 0.01, 0.001  # of the odometry, per metre driven
DEPTH_STRIDE = 4
FAR_M = 40.0


@dataclass(frozen=True)
class SurveyedDrive:
    """Frames of one world in the order they were taken.

    Attributes:
        seed: of the world.
        name: seed, family and aliasing.
        frames: with odometry that drifts.
        truth: (N, 4, 4) `world_T_body`.
        depths: (N, 56, 56) metres along the optical axis, 0 for sky.
    """

    seed: int
    name: str
    frames: list[Frame]
    truth: Array
    depths: Array

    @property
    def path_length(self) -> Array:
        """Metres (N,) driven up to each frame."""
        return path_length(self.truth)

    def overlap(self, query: int, match: int) -> float:
        """Share of what the query's camera sees (nearer than 40 m) that the match's camera sees too."""
        camera, body_T_camera = self.frames[query].camera, self.frames[query].body_T_camera
        seen, points = _unproject(self.depths[query], camera, body_T_camera)
        if not seen:
            return 0.0
        pixels, depth = camera.project(transform(relative(self.truth[match], self.truth[query]), points), body_T_camera)
        cells = np.floor(pixels / DEPTH_STRIDE).astype(int)
        inside = (depth > 0.5) & (cells >= 0).all(axis=1) & (cells < self.depths.shape[1]).all(axis=1)
        there = self.depths[match][cells[inside, 1], cells[inside, 0]].astype(float)
        return float((np.abs(there - depth[inside]) < 0.1 * depth[inside] + 0.3).sum()) / seen

    def error(self, query: int, match: int, match_T_query: Array) -> tuple[float, float]:
        """Distance in metres and angle in degrees of an estimated pose from the truth."""
        gap = relative(relative(self.truth[match], self.truth[query]), match_T_query)
        return float(np.linalg.norm(gap[:3, 3])), float(np.degrees(rotation_angle(gap)))


def kept_in(path: Path | None, make: Callable[[], Made]) -> Made:
    """The content of a file, which is made where it is missing; without a path, it is made and not kept."""
    if path is None:
        return make()
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as part:
            part.write_bytes(pickle.dumps(make()))
    found: Made = pickle.loads(path.read_bytes())
    return found


def kept(folder: Path | None, seed: int, family: str, aliasing: float) -> SurveyedDrive:
    """The same as `simulate`, from a file in the folder where an earlier call left it."""
    path = None if folder is None else folder / f"{seed}_{family}_{aliasing:g}_{STEP_M:g}.pkl"
    return kept_in(path, lambda: simulate(seed, family, aliasing))


def simulate(seed: int, family: str, aliasing: float, step_m: float = STEP_M) -> SurveyedDrive:
    """Three passes through a fresh world: the second and third with offsets, turned headings and another sun."""
    chosen = replace(SETTINGS["hard"], aliasing=aliasing)
    trail = ground(seed, family, aliasing).trail
    passes = plan_passes(trail, ("first", "offset", "offset"), chosen, step_m, seed)
    world = World(seed, family, aliasing, np.concatenate([drive.path for drive in passes]))
    calibration = load_calibration("simulated")
    samples = list(Survey(world, passes, calibration))
    truth = np.array([sample.world_T_body for sample in samples], float)
    frames = _frames([sample.image for sample in samples], [s.points for s in samples], truth, calibration, seed)
    return SurveyedDrive(
        seed, f"{seed} {family} {aliasing:g}", frames, truth, np.array([sample.depth for sample in samples])
    )


def embedded(drive: SurveyedDrive, embedder: Embedder) -> list[Keyframe]:
    """A keyframe for every frame of a drive."""
    frames = track(drive.frames, f"embedding {drive.name}", transient=True)
    return [make_keyframe(frame, embedder, metres) for frame, metres in zip(frames, drive.path_length, strict=True)]


def path_length(poses: Array) -> Array:
    """Metres (N,) driven up to each of the poses (N, 4, 4)."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def worlds(first: int, count: int) -> Iterator[tuple[int, str, float]]:
    """Seeds, families and aliasing of worlds: families in turn, every second one repeats itself fully."""
    for number in range(count):
        yield first + number, FAMILIES[number % len(FAMILIES)], (1.0, 0.6)[number % 2]


def _frames(
    images: Iterable[Image], points: Iterable[Any], truth: Array, calibration: Calibration, seed: int
) -> list[Frame]:
    camera = resized(calibration.camera, *TRAINING_SIZE)
    odometry = _drifting(truth, np.random.default_rng([seed, 17]))
    frames = []
    for image, cloud, distance, odom in zip(images, points, path_length(truth), odometry, strict=True):
        returns = cloud[np.isfinite(cloud[:, 0])].astype(np.float32)
        frames.append(
            Frame(
                stamp_ns=10**9 + round(distance / SPEED_M_S * 1e9),
                camera=camera,
                body_T_camera=calibration.body_T_camera,
                body_T_lidar=calibration.body_T_lidar,
                left=image,
                points=returns[:, :3],
                intensity=returns[:, 3],
                odom_T_body=odom,
                motion=ScanMotion.none(len(returns)),
            )
        )
    return frames


def _drifting(truth: Array, rng: np.random.Generator) -> list[Array]:
    """Odometry: every step a little too long or short and turned, with a bias of its own for the whole drive."""
    scale, bias = 1 + SCALE_ERROR * rng.standard_normal(), TURN_ERROR_RAD_M * rng.standard_normal(3)
    odometry = [truth[0]]
    for before, after in pairwise(truth):
        step = relative(before, after)
        length = float(np.linalg.norm(step[:3, 3]))
        turn = length * bias + np.sqrt(length) * TURN_ERROR_RAD_M * rng.standard_normal(3)
        moved = make_pose(step[:3, :3] @ Rotation.from_rotvec(turn).as_matrix(), scale * step[:3, 3])
        odometry.append(odometry[-1] @ moved)
    return odometry


def _unproject(depths: Array, camera: StereoCamera, body_T_camera: Array) -> tuple[int, Array]:
    rows, columns = np.nonzero((depths > 0.5) & (depths < FAR_M))
    depth = depths[rows, columns].astype(float)
    u, v = columns * DEPTH_STRIDE + DEPTH_STRIDE // 2, rows * DEPTH_STRIDE + DEPTH_STRIDE // 2
    ray = np.column_stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))])
    return len(depth), transform(body_T_camera, ray * depth[:, None])
