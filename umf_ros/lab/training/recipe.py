"""A recipe: a whole training in one resumable command, from the simulation of its worlds to its last stage."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError, field_validator

from umf_ros.core.config import Group, problems
from umf_ros.core.errors import ConfigError
from umf_ros.core.io import read_values
from umf_ros.core.resources import find
from umf_ros.core.tasks import spread
from umf_ros.lab.simulation.survey import write_world
from umf_ros.lab.training.networks import RunSettings
from umf_ros.lab.training.trainer import parse_run
from umf_ros.networks.config import locate_weights


class Recipe(Group):
    """Worlds to simulate, and the stages of the training."""

    training: str = Field(description="seeds of the training worlds, as first:last+1")
    validation: str = Field(description="seeds of the validation worlds")
    every: int = Field(1, ge=1, description="every n-th sample of the training worlds")
    start: str = Field("", description="weights of the first stage; empty: none")
    common: dict[str, Any] = Field({}, description="settings of all stages")
    stages: list[dict[str, Any]] = Field(min_length=1, description="further settings of each stage")

    @field_validator("training", "validation")
    @classmethod
    def _seeds(cls, value: str) -> str:
        if not re.fullmatch(r"\d+:\d+", value) or not seeds(value):
            raise ValueError("expected seeds as first:last+1")
        return value


def seeds(text: str) -> range:
    """Return the seeds of "first:last+1"."""
    first, last = text.split(":")
    return range(int(first), int(last))


def read_recipe(name: str) -> Recipe:
    """Return a recipe from `config/training` or from a YAML file.

    Raises:
        ConfigError: there is no such file, or it is no recipe.
        UmfError: there is no recipe of this name.
    """
    path = Path(name) if name.endswith(".yaml") else find(f"config/training/{name}.yaml")
    try:
        return Recipe.model_validate(read_values(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {problems(error)}") from None


def simulate_worlds(recipe: Recipe, folder: Path, workers: int | None, report: Callable[[int, int], None]) -> None:
    """Simulate the worlds that are not in `folder` yet.

    Args:
        recipe: names the seeds.
        folder: gets `train` and `validation`.
        workers: processes; None: one for each core.
        report: called with the number of worlds done, and of all that were missing.

    Raises:
        OutputError: the folder cannot be written.
    """
    wanted = [(folder / "validation" / f"world_{seed:05d}.npz", seed, 1) for seed in seeds(recipe.validation)]
    wanted += [(folder / "train" / f"world_{seed:05d}.npz", seed, recipe.every) for seed in seeds(recipe.training)]
    missing = [task for task in wanted if not task[0].exists()]
    count = workers or len(os.sched_getaffinity(0))
    spread(write_world, missing, count, done=lambda done: report(done, len(missing)))


def stages(recipe: Recipe, folder: Path, **overrides: object) -> list[tuple[Path, RunSettings]]:
    """Return the folder and the settings of each stage; each starts from the weights of the one before.

    Args:
        recipe: the recipe.
        folder: of the whole training.
        overrides: settings of every stage; None is skipped.

    Raises:
        ConfigError: unknown name or wrong value.
    """
    data = {"train": str(folder / "worlds/train"), "validation": str(folder / "worlds/validation")}
    chosen = {name: value for name, value in overrides.items() if value is not None}
    start = str(locate_weights(Path(recipe.start))) if recipe.start else ""
    found: list[tuple[Path, RunSettings]] = []
    for number, own in enumerate(recipe.stages, 1):
        settings = parse_run({**data, "start": start, **recipe.common, **own, **chosen})
        found.append((folder / f"stage_{number}", settings))
        start = str(found[-1][0] / f"{settings.weights_name}.safetensors")
    return found
