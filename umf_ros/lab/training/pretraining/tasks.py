"""What each modality hides, predicts and draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from umf_ros.errors import ConfigError
from umf_ros.lab.datasets.sample import Sample
from umf_ros.lab.training.pretraining.cloud import OccupancyReconstruction, occupancy
from umf_ros.lab.training.pretraining.image import ImageReconstruction, normalised, patches, repainted, unpatch
from umf_ros.lab.training.pretraining.masks import hidden_voxels, unfold, visible_patches
from umf_ros.lab.training.pretraining.pictures import save_images, save_occupancy
from umf_ros.lab.training.pretraining.settings import PretrainingSettings
from umf_ros.lab.training.pretraining.sparse import hide
from umf_ros.lab.training.views import View
from umf_ros.networks.image_encoder import Backbone
from umf_ros.networks.umf import UMF

Inputs = tuple[Tensor, Tensor]
"""What an encoder is given, and a mask over it."""


class Task(Protocol):
    """One way of hiding and predicting."""

    @property
    def model(self) -> nn.Module:
        """The encoder and its decoder."""
        ...

    def part(self, sample: Sample) -> Sample | None:
        """The modality of a sample that is used, or None when the sample lacks it."""
        ...

    def prepare(self, views: Sequence[View], rng: np.random.Generator) -> Inputs:
        """A batch with freshly drawn masks."""
        ...

    def loss(self, inputs: Inputs) -> Tensor:
        """Loss of a batch."""
        ...

    def draw(self, inputs: Inputs, path: Path) -> None:
        """Draw what is given, what is shown to the encoder, and what it makes of it."""
        ...


class PaintImages:
    """Hidden patches of images."""

    def __init__(self, network: UMF, settings: PretrainingSettings) -> None:
        backbone = network.image_encoder.backbone
        if not isinstance(backbone, Backbone):
            raise ConfigError(f"preset: the image trunk of {settings.preset} comes pretrained")
        self.model = ImageReconstruction(backbone, settings.decoder_width)
        self._size, self._ratio = network.config.image_size, settings.mask_ratio

    def part(self, sample: Sample) -> Sample | None:
        """The image alone."""
        return None if sample.image is None else replace(sample, points=None, intensity=None)

    def prepare(self, views: Sequence[View], rng: np.random.Generator) -> Inputs:
        """Images, and which of their patches are visible."""
        image = torch.from_numpy(np.stack([view.image for view in views]))[:, None]
        return image, visible_patches(len(views), self._size, self._ratio, rng)

    def loss(self, inputs: Inputs) -> Tensor:
        """Squared error of the hidden patches, each normalised."""
        return self.model(*inputs)[0]

    def draw(self, inputs: Inputs, path: Path) -> None:
        """Image, visible patches, painted image, and the normalised patches wanted and painted."""
        image, visible = inputs
        _, painting = self.model(image, visible)
        wanted = unpatch(normalised(patches(image)), self._size)
        low = image.amin(dim=(2, 3), keepdim=True)
        shown = {
            "image": image,
            "visible": hide(image - low, visible) + low,
            "painted": repainted(image, painting, visible),
            "patches, normalised": wanted,
            "patches, painted": torch.where(hide(torch.ones_like(image), visible) > 0, wanted, painting),
        }
        save_images(path, [(name, values[:, 0].float().cpu().numpy()) for name, values in shown.items()])


class GuessOccupancy:
    """Hidden voxels of scans."""

    def __init__(self, network: UMF, settings: PretrainingSettings) -> None:
        channels = network.config.voxel_channels
        self.model = OccupancyReconstruction(network.voxel_encoder, channels, settings.decoder_width)
        self._ratios = settings.ring_ratios

    def part(self, sample: Sample) -> Sample | None:
        """The scan alone."""
        return None if sample.points is None else replace(sample, image=None)

    def prepare(self, views: Sequence[View], rng: np.random.Generator) -> Inputs:
        """Grids, and which of their voxels are hidden."""
        grid = torch.from_numpy(np.stack([view.scan.grid for view in views]))
        return grid, hidden_voxels(occupancy(grid), self._ratios, rng)

    def loss(self, inputs: Inputs) -> Tensor:
        """Binary cross-entropy of the occupancy."""
        return self.model(*inputs)[0]

    def draw(self, inputs: Inputs, path: Path) -> None:
        """Occupancy, what of it is visible, and what is predicted, from above."""
        grid, hidden = inputs
        _, logits = self.model(grid, hidden)
        occupied = occupancy(grid)
        shown = {"scan": occupied, "visible": occupied & ~hidden, "predicted": logits.sigmoid()}
        save_occupancy(path, [(name, unfold(values.float()).cpu().numpy()) for name, values in shown.items()])


def make_task(network: UMF, settings: PretrainingSettings) -> Task:
    """The task of the settings' modality."""
    return PaintImages(network, settings) if settings.modality == "image" else GuessOccupancy(network, settings)
