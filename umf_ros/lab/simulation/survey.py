"""A rover's samples at training resolution, pass by pass, as shards and as a sheet of pictures.

A shard is an `.npz` with, for N frames of P points at most:

- `images` (N, 224, 224) uint8: the left image, the whole picture scaled to a square
- `points` (N, P, 4) float16: x y z in the body frame (m) and intensity, real returns only, NaN at the end
- `depth` (N, 56, 56) float16: metres along the optical axis at image pixel (4 column + 2, 4 row + 2), 0 for sky
- `world_T_body` (N, 4, 4) float32; `pass_index` (N,) int32; `sun` (N, 2) float32 azimuth and elevation, deg
- `labels` (passes,) what makes each pass a revisit
- `fx fy cx cy width height baseline`: the camera at full resolution; `body_T_camera`, `body_T_lidar`
- `seed`, `family`, `aliasing`, `setting`
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import ConfigError, writing
from umf_ros.core.frames import Image
from umf_ros.core.geometry import Array, transform
from umf_ros.core.io import atomic_write
from umf_ros.lab.simulation.camera import TRAINING_SIZE, Camera, Rendering, ahead, resized
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.lidar import FIELD_OF_VIEW_DEG, RANGE_M, Lidar
from umf_ros.lab.simulation.relief import Field
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
        """The camera's picture, and the generator for everything random that comes after it."""
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


def write_shard(
    path: Path, survey: Survey, setting: str, workers: int = 2, progress: Callable[[int], None] = lambda done: None
) -> None:
    """Render a survey into a file, which appears under its name only when it is complete.

    Args:
        path: the `.npz` to write.
        survey: what to render.
        setting: its name, kept in the file.
        workers: threads that render.
        progress: called with the number of frames done.

    Raises:
        OutputError: the file cannot be written.
    """
    samples = []
    for sample in survey.samples(workers):
        samples.append(sample)
        progress(len(samples))
    save(path, _arrays(survey, samples, setting))


def seed_range(text: str) -> range:
    """The seeds of "first:last+1", or of one number.

    Raises:
        ConfigError: the text is of another form, or names no seed.
    """
    first, _, last = text.partition(":")
    try:
        seeds = range(int(first), int(last or int(first) + 1))
    except ValueError:
        raise ConfigError(f"seeds {text!r} are not of the form first:last+1") from None
    if seeds.start < 0 or not seeds:
        raise ConfigError(f"seeds {text!r} hold no world")
    return seeds


def missing_worlds(folder: Path, seeds: range, every: int) -> list[tuple[Path, int, int]]:
    """Tasks of `write_world` for the shards that are not in a folder yet."""
    paths = {seed: folder / f"world_{seed:05d}.npz" for seed in seeds}
    return [(path, seed, every) for seed, path in paths.items() if not path.exists()]


def write_world(task: tuple[Path, int, int]) -> None:
    """The shard of a seed, by its plan: a task of its own, of the file, the seed and every how manieth frame.

    Raises:
        OutputError: the file cannot be written.
    """
    path, world, every = task
    family, setting = shard_plan(world)
    write_shard(path, survey_world(world, family, setting, every=every), setting, workers=1)


def save(path: Path, arrays: dict[str, Array]) -> None:
    """Write an `.npz` in one step.

    Raises:
        OutputError: the file cannot be written.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as part, part.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def _arrays(survey: Survey, samples: list[SurveyFrame], setting: str) -> dict[str, Array]:
    world, calibration = survey.world, survey.calibration
    most = max(len(sample.points) for sample in samples)
    points = np.full((len(samples), most, 4), np.nan, np.float16)
    for row, sample in zip(points, samples, strict=True):
        row[: len(sample.points)] = sample.points
    camera = calibration.camera
    facts = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height", "baseline")}
    facts |= {"seed": world.seed, "family": world.family, "aliasing": world.aliasing, "setting": setting}
    return {
        "images": np.stack([sample.image for sample in samples]),
        "points": points,
        "depth": np.stack([sample.depth for sample in samples]),
        "world_T_body": np.stack([sample.world_T_body for sample in samples]),
        "pass_index": np.array([sample.pass_index for sample in samples], np.int32),
        "sun": np.array([sample.sun for sample in samples], np.float32),
        "labels": np.array([drive.label for drive in survey.passes]),
        "body_T_camera": calibration.body_T_camera,
        "body_T_lidar": calibration.body_T_lidar,
        **{name: np.array(value) for name, value in facts.items()},
    }


FRAMES, SCANS, COLUMNS = 24, 6, 6
_TILE = (344, 256)
_BIRD_REACH_M = 40.0


def contact_sheet(survey: Survey, path: Path) -> None:
    """Write 24 frames, each place of the first pass above its revisit, and 6 scans from the side and from above.

    Raises:
        OutputError: the picture cannot be written.
    """
    camera = Camera(survey.world, survey.calibration.camera)
    tiles = [_frame(survey, camera, index) for index in range(FRAMES)]
    scans = [_scan(survey, index) for index in range(SCANS)]
    rows = [np.hstack(tiles[row : row + COLUMNS]) for row in range(0, FRAMES, COLUMNS)]
    sheet = np.vstack([*(cv2.cvtColor(row, cv2.COLOR_GRAY2BGR) for row in rows), np.hstack(scans)])
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".png", sheet)[1].tobytes())


def _frame(survey: Survey, camera: Camera, index: int) -> Image:
    """The frame of a place on the sheet: even rows show the first pass, odd rows the revisit."""
    row, column = divmod(index, COLUMNS)
    drive = survey.passes[row % 2]
    step = int((row // 2 * COLUMNS + column) / (FRAMES // 2) * len(drive.path))
    rng = np.random.default_rng([survey.world.seed, 16, index])
    image = camera.take(
        survey.pose(row % 2, step) @ survey.calibration.body_T_camera, drive.sun, rng, drive.exposure
    ).image
    return np.asarray(cv2.resize(image, _TILE, interpolation=cv2.INTER_AREA), np.uint8)


def _scan(survey: Survey, index: int) -> Image:
    drive = survey.passes[0]
    sample = survey.sample(0, index * len(drive.path) // SCANS)
    body_T_lidar = np.linalg.inv(survey.calibration.body_T_lidar)
    points = transform(body_T_lidar, sample.points[:, :3].astype(np.float64))
    return np.vstack([_ahead(points), _from_above(sample.points.astype(np.float32))])


def _ahead(points: Field) -> Image:
    """The LiDAR's view, near in red and far in blue."""
    canvas = np.zeros((160, _TILE[0], 3), np.uint8)
    distance = np.linalg.norm(points, axis=1)
    azimuth = np.degrees(np.arctan2(points[:, 0], points[:, 1]))
    elevation = np.degrees(np.arcsin(points[:, 2] / distance))
    scale = _TILE[0] / (FIELD_OF_VIEW_DEG[0] + 4)
    column, row = _TILE[0] / 2 + azimuth * scale, 80 - elevation * scale
    _dots(canvas, column, row, _colours(1 - np.log(distance) / np.log(RANGE_M)))
    return canvas


def _from_above(points: Field) -> Image:
    """The scan in the body frame from above, the rover at the bottom, high in red and low in blue."""
    canvas = np.zeros((_TILE[1], _TILE[0], 3), np.uint8)
    scale = _TILE[1] / _BIRD_REACH_M
    x, y = _TILE[0] / 2 - points[:, 1] * scale, _TILE[1] - points[:, 0] * scale
    _dots(canvas, x, y, _colours(points[:, 2] / 6 + 0.4))
    return canvas


def _colours(value: Field) -> Image:
    if len(value) == 0:
        return np.empty((0, 3), np.uint8)
    scaled = np.clip(value * 255, 0, 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(scaled[:, None], cv2.COLORMAP_TURBO)[:, 0], np.uint8)


def _dots(canvas: Image, column: Field, row: Field, colours: Image) -> None:
    for across in (0, 1):
        for along in (0, 1):
            u, v = (column + across).astype(int), (row + along).astype(int)
            inside = (u >= 0) & (u < canvas.shape[1]) & (v >= 0) & (v < canvas.shape[0])
            canvas[v[inside], u[inside]] = colours[inside]
