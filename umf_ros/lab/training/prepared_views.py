"""Views of frames prepared for training, and their augmentation."""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import cv2
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
from umf_ros.core.frames import Image
from umf_ros.core.geometry import transform
from umf_ros.lab.datasets.sample import Places, Sample, SampleSequence
from umf_ros.lab.datasets.views import Augmentation, View, ViewMaker
from umf_ros.lab.training.batches import Draw, places_drawn
from umf_ros.lab.training.objective import generator
from umf_ros.networks.config import NetworkConfig


@dataclass(frozen=True, slots=True)
class CameraLook:
    """Response of one camera to the light.

    Attributes:
        gamma: exponent of the response; 1 leaves the picture as it is.
        toe: strength of the S-curve around middle grey, 0 for none.
        vignetting: share of the light that is lost in the corners.
        blur_px: standard deviation of the point spread, pixels.
        noise: standard deviation at middle grey, of full scale.
        quality: of JPEG, 100 for none.
        zoom: share of the width and of the height that is seen.
        exposure: standard deviation of the logarithm of the exposure from picture to picture.
        lamps: share of the light that comes from the rover's own lamps, 1 at night.
        shadow: chance of a shadow that was not there before, for each picture.
        glare: chance of the sun in or near the view, for each picture.
        dust: number of specks on the lens, which stay where they are.
        lens: seed of the specks.
    """

    gamma: float = 1.0
    toe: float = 0.0
    vignetting: float = 0.0
    blur_px: float = 0.0
    noise: float = 0.0
    quality: int = 100
    zoom: float = 1.0
    exposure: float = 0.0
    lamps: float = 0.0
    shadow: float = 0.0
    glare: float = 0.0
    dust: int = 0
    lens: int = 0

    def take(self, image: Image, rng: np.random.Generator) -> Image:
        """The picture (h, w) as this camera takes it, at the same size."""
        height, width = image.shape
        light = self._crop(image).astype(np.float32) / 255
        light *= np.float32(np.exp(self.exposure * rng.standard_normal()))
        light *= _falloff(height, width, self.vignetting)
        light = self._disturb(light, rng)
        if self.blur_px > 0:
            light = cv2.GaussianBlur(light, (0, 0), self.blur_px).astype(np.float32)
        values = np.clip(light, 0, 1) ** np.float32(self.gamma)
        values += np.float32(self.toe) * (values * values * (3 - 2 * values) - values)
        spread = self.noise * np.sqrt(0.25 + 1.5 * values)  # shot noise grows with the light
        values += (spread * rng.standard_normal(values.shape, dtype=np.float32)).astype(np.float32)
        taken = (np.clip(values, 0, 1) * 255).astype(np.uint8)
        return taken if self.quality >= 100 else _compress(taken, self.quality)

    def _disturb(self, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The light (h, w) under lamps, with a moved shadow, against the sun, through specks of dust."""
        y, x = (
            axis.astype(np.float32) for axis in np.ogrid[-1 : 1 : light.shape[0] * 1j, -1 : 1 : light.shape[1] * 1j]
        )
        if self.lamps > 0:
            cone = 1.6 * np.exp(-(x**2) / 0.5 - (y - 0.4) ** 2 / 0.4)
            light = light * (1 - self.lamps + self.lamps * cone)
        if rng.random() < self.shadow:
            angle, offset, edge = rng.uniform(0, 2 * np.pi), rng.uniform(-0.6, 0.6), rng.uniform(0.02, 0.2)
            inside = 1 / (1 + np.exp((x * np.cos(angle) + y * np.sin(angle) - offset) / edge))
            light = light * (1 - rng.uniform(0.3, 0.7) * inside)
        if rng.random() < self.glare:
            across, up = rng.uniform(-1.2, 1.2), rng.uniform(-1.2, -0.2)
            light = light + rng.uniform(0.4, 1.5) * np.exp(-np.hypot(x - across, y - up) / rng.uniform(0.15, 0.8))
        specks = np.random.default_rng(self.lens)
        for _ in range(self.dust):
            (across, down), size, cover = specks.uniform(-1, 1, 2), specks.uniform(0.03, 0.2), specks.uniform(0.3, 0.9)
            speck = cover * np.exp(-((((x - across) ** 2 + (y - down) ** 2) / size**2) ** 2))
            light = light * (1 - speck) + 0.5 * speck * light.mean()
        return np.asarray(light, np.float32)

    def _crop(self, image: Image) -> Image:
        if self.zoom >= 1:
            return image
        height, width = image.shape
        rows, columns = round(height * self.zoom), round(width * self.zoom)
        top, left = (height - rows) // 2, (width - columns) // 2
        inner = image[top : top + rows, left : left + columns]
        return cv2.resize(inner, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.uint8)


def draw_look(rng: np.random.Generator) -> CameraLook:
    """A camera at random, from a good one to a poor one, sometimes dusty, by night, or against the sun."""
    plain = CameraLook(
        gamma=float(np.exp(rng.normal(0, 0.3))),
        toe=float(rng.uniform(-0.3, 0.8)),
        vignetting=float(rng.choice([0.0, rng.uniform(0.1, 0.6)])),
        blur_px=float(rng.choice([0.0, rng.uniform(0.4, 1.6)])),
        noise=float(rng.uniform(0.0, 0.04)),
        quality=100 if rng.random() < 0.5 else int(rng.integers(25, 90)),
        zoom=float(rng.choice([1.0, rng.uniform(0.6, 1.0)])),
        exposure=float(rng.uniform(0.05, 0.25)),
    )
    night, hot, dusty = rng.random(3) < SELDOM
    return replace(
        plain,
        noise=float(rng.uniform(0.05, 0.12)) if hot or night else plain.noise,
        lamps=float(rng.uniform(0.5, 1.0)) if night else 0.0,
        shadow=0.0 if night else float(rng.uniform(0, 0.5)),
        glare=0.0 if night else float(rng.choice([0.0, rng.uniform(0.1, 0.5)])),
        dust=int(rng.integers(1, 12)) if dusty else 0,
        lens=int(rng.integers(2**31)),
    )


SELDOM = (0.12, 0.12, 0.3)
"""Chances that a camera sees by night, is hot (thermal noise), or dusty."""


def _falloff(height: int, width: int, lost: float) -> np.ndarray:
    """(height, width) float32 share of the light that arrives, 1 in the middle."""
    y, x = np.linspace(-1, 1, height, dtype=np.float32), np.linspace(-1, 1, width, dtype=np.float32)
    return np.float32(1) - np.float32(lost / 2) * (x[None] ** 2 + y[:, None] ** 2)


def _compress(image: Image, quality: int) -> Image:
    _, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)


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
