"""Training shards: one world's passes at training resolution in one file.

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

from collections.abc import Callable
from pathlib import Path

import numpy as np

from umf_ros.core.errors import writing
from umf_ros.core.geometry import Array
from umf_ros.core.io import atomic_write
from umf_ros.lab.simulation.survey import Survey, SurveyFrame, shard_plan, survey_world


def write_shard(
    path: Path,
    survey: Survey,
    setting: str,
    workers: int = 2,
    progress: Callable[[int], None] = lambda done: None,
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
