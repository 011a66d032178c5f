"""Views of frames prepared for training, and their augmentation."""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from umf_ros.baselines.place_network import (
    EMPTY_MAPS,
    IMAGE_SIZE,
    MEASURED,
    POINTS,
    VOXELS,
    ImageTrunk,
    PlaceInput,
    Sense,
    measured,
    some_points,
)
from umf_ros.core.errors import OutputError
from umf_ros.core.geometry import transform
from umf_ros.lab.datasets.sample import Places, Sample, SampleSequence
from umf_ros.lab.datasets.views import Augmentation, View, ViewMaker
from umf_ros.lab.training.batches import Draw, places_drawn
from umf_ros.lab.training.objective import generator
from umf_ros.networks.config import NetworkConfig

CONFIG = NetworkConfig(image_size=IMAGE_SIZE, fine_voxels=VOXELS)
NO_CELL = np.iinfo(np.uint16).max
PLAIN = 0
"""Variant of a sample that is not augmented; odd ones are upright, even ones mirrored."""

Row = NDArray[Any]

FIELDS: dict[Sense, list[tuple[str, str, tuple[int, ...]]]] = {
    "image": [("maps", "<f2", EMPTY_MAPS)],
    "voxels": [("voxels", "<f2", (VOXELS, MEASURED)), ("cells", "<u2", (VOXELS,))],
    "points": [("points", "<f4", (POINTS, 3))],
}
"""Of a kept row, besides whether it was made and whether there was anything to see."""


@dataclass(frozen=True, slots=True)
class PlaceBatch:
    """Views and where they were taken; row i and row B/2 + i are a pair."""

    input: PlaceInput
    places: Places

    def to(self, device: torch.device) -> Self:
        """The batch on another device."""
        return replace(self, input=self.input.to(device))


class PreparedViews:
    """Views of samples, made when they are first asked for.

    Args:
        reads: what the network reads; nothing else is prepared.
        trunk: of its image branch; copied, so that what is kept does not follow what is learned.
        variants: augmentations of every sample, and as many of it mirrored.
        seed: of the augmentations.
        folder: where views are kept for other runs; None: on disk too, but for this run alone.
    """

    def __init__(
        self, reads: frozenset[Sense], trunk: ImageTrunk | None, variants: int, seed: int, folder: Path | None
    ) -> None:
        self._reads, self._variants, self._seed, self._folder = reads, variants, seed, folder
        self._trunk = None if trunk is None else deepcopy(trunk).cpu()
        self._maker = ViewMaker(CONFIG, Augmentation(), keep_slope=False)
        self._kept: dict[tuple[str, int, Sense], Row] = {}

    def plain(self, world: SampleSequence, indices: Sequence[int] | range) -> PlaceInput:
        """Samples of a world as they are."""
        return self._stack([(world, index, PLAIN) for index in indices])

    def batch(self, sequences: Sequence[SampleSequence], draws: list[Draw], rng: np.random.Generator) -> PlaceBatch:
        """Samples in one of their variants each."""
        variants = [1 + 2 * int(rng.integers(self._variants)) + draw.mirror for draw in draws]
        asked = [(sequences[draw.sequence], draw.index, variant) for draw, variant in zip(draws, variants, strict=True)]
        return PlaceBatch(self._stack(asked), places_drawn(draws, sequences))

    def _stack(self, asked: list[tuple[SampleSequence, int, int]]) -> PlaceInput:
        rows: dict[Sense, list[Row]] = {sense: [self._row(*one, sense) for one in asked] for sense in self._reads}
        count = len(asked)
        images, scans, points = (rows.get(sense, []) for sense in FIELDS)
        cells = np.stack([row["cells"] for row in scans]) if scans else np.full((count, 1), NO_CELL, np.uint16)
        longest = max(1, int((cells != NO_CELL).sum(1).max()))
        there = torch.from_numpy(cells[:, :longest] != NO_CELL)
        return PlaceInput(
            maps=_floats(images, "maps", (count, *EMPTY_MAPS)),
            image_present=_present(images, count),
            voxels=_floats(scans, "voxels", (count, 1, MEASURED))[:, :longest],
            cells=torch.from_numpy(cells[:, :longest].astype(np.int64)) * there,
            mask=there,
            points=_floats(points, "points", (count, POINTS, 3)),
            cloud_present=_present(scans or points, count),
        )

    def _row(self, world: SampleSequence, index: int, variant: int, sense: Sense) -> Row:
        """Stored input of one modality in one view."""
        rows = self._rows(world, variant, sense)
        if not rows["made"][index]:
            for name, value in self._see(self._view(world, index, variant, sense), sense).items():
                rows[name][index] = value
            rows["made"][index] = True  # last: after an interruption this row is made again
        found: Row = rows[index]
        return found

    def _view(self, world: SampleSequence, index: int, variant: int, sense: Sense) -> View:
        sample = _only(world.sample(index), sense)
        if variant == PLAIN:
            return self._maker.plain(sample)
        rng = generator(self._seed, zlib.crc32(world.name.encode()), index, purpose=variant)
        return self._maker.varied(sample, rng, mirror=variant % 2 == 0)

    def _see(self, view: View, sense: Sense) -> dict[str, Any]:
        """Fields of a row that are not zero."""
        if sense == "image":
            if not view.image_present or self._trunk is None:
                return {}
            with torch.no_grad():
                return {"maps": self._trunk.early(torch.from_numpy(view.image)[None, None])[0].numpy(), "present": True}
        if sense == "voxels":
            cells = np.where(view.scan.fine_mask, view.scan.fine_index, NO_CELL)
            return {"voxels": measured(view.scan).numpy(), "cells": cells, "present": view.scan.fine_mask.any()}
        if view.sample.points is None:
            return {}
        upright = transform(np.linalg.inv(view.body_T_view), view.sample.points).astype(np.float32)
        points = some_points(upright, np.random.default_rng(self._seed))
        return {} if points is None else {"points": points, "present": True}

    def _rows(self, world: SampleSequence, variant: int, sense: Sense) -> Row:
        """(samples,) of a world, on disk."""
        key = world.name, variant, sense
        if key not in self._kept:
            kind = np.dtype([("made", "?"), ("present", "?"), *FIELDS[sense]])
            name = f"{world.name.replace('/', '_')}_{len(world)}_{self._seed}_{variant}.{sense}"
            self._kept[key] = _on_disk(self._folder, name, kind, len(world))
        return self._kept[key]


def _only(sample: Sample, sense: Sense) -> Sample:
    if sense == "image":
        return replace(sample, points=None, intensity=None)
    return replace(sample, image=None)


def _on_disk(folder: Path | None, name: str, kind: np.dtype[Any], count: int) -> Row:
    """Rows that take space only where they are written, and that processes share; zeros at first.

    Raises:
        OutputError: the folder cannot be written.
    """
    try:
        if folder is None:
            with tempfile.TemporaryFile() as stream:
                return np.memmap(stream, kind, "w+", shape=(count,))
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / name
        there = path.is_file() and path.stat().st_size == kind.itemsize * count
        return np.memmap(path, kind, "r+" if there else "w+", shape=(count,))
    except OSError as error:
        raise OutputError(f"cannot keep prepared views in {folder or 'a temporary file'}: {error.strerror}") from None


def _floats(rows: list[Row], name: str, shape: tuple[int, ...]) -> Tensor:
    if not rows:
        return torch.zeros(shape)
    return torch.from_numpy(np.stack([row[name] for row in rows]).astype(np.float32))


def _present(rows: list[Row], count: int) -> Tensor:
    return torch.tensor([bool(row["present"]) for row in rows] or [False] * count)
