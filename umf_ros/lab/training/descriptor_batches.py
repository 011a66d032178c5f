"""Batches for other methods' networks: what each of them reads of a sample, varied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from umf_ros.embedding.place_inputs import PreparedView, some_points, stack, stack_images
from umf_ros.geometry import transform
from umf_ros.lab.datasets.labels import Places
from umf_ros.lab.datasets.sample import Sample, SampleSequence
from umf_ros.lab.datasets.views import Augmentation, View, ViewMaker
from umf_ros.lab.training.objective import generator
from umf_ros.lab.training.sampler import Draw, places_drawn
from umf_ros.lab.training.settings import DescriptorSettings
from umf_ros.networks.config import NetworkConfig
from umf_ros.networks.place_network import IMAGE_SIZE, VOXELS, PlaceInput

CONFIG = NetworkConfig(image_size=IMAGE_SIZE, fine_voxels=VOXELS)

Key = tuple[int, int, int]
"""Of a remembered map: sequence, sample, variant; mirrored ones are variants too."""


@dataclass(frozen=True, slots=True)
class PlaceBatch:
    """Views and where they were taken; row i and row B/2 + i are a pair.

    Attributes:
        input: without maps.
        images: (B, 1, 160, 224), empty where none are read.
        keys: (B,) of their early maps.
        places: where.
    """

    input: PlaceInput
    images: Tensor
    keys: list[Key]
    places: Places

    def to(self, device: torch.device) -> Self:
        """The batch on another device; images stay until they are needed."""
        return replace(self, input=self.input.to(device))


class PlaceViews:
    """Makes views of samples.

    Args:
        reads: what the network reads; nothing else is prepared.
    """

    def __init__(self, reads: frozenset[str]) -> None:
        self._reads = reads
        self._maker = ViewMaker(CONFIG, Augmentation())

    def plain(self, sample: Sample) -> PreparedView:
        """The view as it is, the same every time."""
        return self._view(self._maker.plain(self._needed(sample)), np.random.default_rng(0))

    def batch(
        self,
        sequences: Sequence[SampleSequence],
        draws: list[Draw],
        settings: DescriptorSettings,
        rng: np.random.Generator,
    ) -> PlaceBatch:
        """Varied views of some samples: images in one of few variants each, scans anew every time."""
        views, keys = [], []
        for draw in draws:
            variant = 2 * int(rng.integers(settings.variants)) + draw.mirror
            keys.append((draw.sequence, draw.index, variant))
            luck = generator(settings.seed, draw.sequence, draw.index, purpose=2 + variant)
            views.append(self._varied(sequences[draw.sequence].sample(draw.index), draw.mirror, luck, rng))
        return PlaceBatch(stack(views, None), stack_images(views), keys, places_drawn(draws, sequences))

    def _varied(
        self, sample: Sample, mirror: bool, luck: np.random.Generator, rng: np.random.Generator
    ) -> PreparedView:
        """`luck` varies the image, `rng` the scan."""
        sample = self._needed(sample)
        image = self._maker.varied(replace(sample, points=None), luck, mirror)
        if sample.points is None:
            return self._view(image, rng)
        scan = self._maker.varied(replace(sample, image=None), rng, mirror)
        return self._view(replace(scan, image=image.image, image_present=image.image_present), rng)

    def _needed(self, sample: Sample) -> Sample:
        if "image" not in self._reads:
            sample = replace(sample, image=None)
        return sample if self._reads & {"voxels", "points"} else replace(sample, points=None, intensity=None)

    def _view(self, view: View, rng: np.random.Generator) -> PreparedView:
        points = view.sample.points
        if "points" in self._reads and points is not None:
            upright = transform(np.linalg.inv(view.body_T_view), points).astype(np.float32)
            points = some_points(upright, rng)
        return PreparedView(
            image=view.image if view.image_present else None,
            scan=view.scan if "voxels" in self._reads else None,
            points=points if "points" in self._reads else None,
        )
