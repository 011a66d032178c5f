"""What each modality hides, predicts and draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from umf_ros.datasets.sample import Sample
from umf_ros.networks.umf import UMF
from umf_ros.training.pretraining.cloud import OccupancyReconstruction, occupancy
from umf_ros.training.pretraining.image import ImageReconstruction, normalised, patches, repainted, unpatch
from umf_ros.training.pretraining.masks import hidden_voxels, unfold, visible_patches
from umf_ros.training.pretraining.pictures import save_images, save_occupancy
from umf_ros.training.pretraining.settings import PretrainingSettings
from umf_ros.training.pretraining.sparse import hide
from umf_ros.training.views import View


class Task(Protocol):
    """One way of hiding and predicting."""

    @property
    def model(self) -> nn.Module:
        """The encoder and its decoder."""
        ...

    def part(self, sample: Sample) -> Sample | None:
        """The modality of a sample that is used, or None when the sample lacks it."""
        ...

    def loss(self, views: Sequence[View], rng: np.random.Generator) -> Tensor:
        """Loss of a batch with freshly drawn masks."""
        ...

    def draw(self, views: Sequence[View], rng: np.random.Generator, path: Path) -> None:
        """Draw what is given, what is shown to the encoder, and what it makes of it."""
        ...


class PaintImages:
    """Hidden patches of images."""

    def __init__(self, network: UMF, settings: PretrainingSettings) -> None:
        self.model = ImageReconstruction(network.image_encoder.backbone, settings.decoder_width)
        self._size, self._ratio = network.config.image_size, settings.mask_ratio

    def part(self, sample: Sample) -> Sample | None:
        """The image alone."""
        return None if sample.image is None else replace(sample, points=None, intensity=None)

    def loss(self, views: Sequence[View], rng: np.random.Generator) -> Tensor:
        """Squared error of the hidden patches, each normalised."""
        image, visible = self._prepare(views, rng)
        return self.model(image, visible)[0]

    def draw(self, views: Sequence[View], rng: np.random.Generator, path: Path) -> None:
        """Image, visible patches, painted image, and the normalised patches wanted and painted."""
        image, visible = self._prepare(views, rng)
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

    def _prepare(self, views: Sequence[View], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        device = self.model.head.weight.device
        image = torch.from_numpy(np.stack([view.image for view in views]))[:, None]
        visible = visible_patches(len(views), self._size, self._ratio, rng)
        return image.to(device), visible.to(device)


class GuessOccupancy:
    """Hidden voxels of scans."""

    def __init__(self, network: UMF, settings: PretrainingSettings) -> None:
        channels = network.config.voxel_channels
        self.model = OccupancyReconstruction(network.voxel_encoder, channels, settings.decoder_width)
        self._ratios = settings.ring_ratios

    def part(self, sample: Sample) -> Sample | None:
        """The scan alone."""
        return None if sample.points is None else replace(sample, image=None)

    def loss(self, views: Sequence[View], rng: np.random.Generator) -> Tensor:
        """Binary cross-entropy of the occupancy."""
        return self.model(*self._prepare(views, rng))[0]

    def draw(self, views: Sequence[View], rng: np.random.Generator, path: Path) -> None:
        """Occupancy, what of it is visible, and what is predicted, from above."""
        grid, hidden = self._prepare(views, rng)
        _, logits = self.model(grid, hidden)
        occupied = occupancy(grid)
        shown = {"scan": occupied, "visible": occupied & ~hidden, "predicted": logits.sigmoid()}
        save_occupancy(path, [(name, unfold(values.float()).cpu().numpy()) for name, values in shown.items()])

    def _prepare(self, views: Sequence[View], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        grid = torch.from_numpy(np.stack([view.scan.grid for view in views]))
        hidden = hidden_voxels(occupancy(grid), self._ratios, rng)
        device = self.model.head.weight.device
        return grid.to(device), hidden.to(device)


def make_task(network: UMF, settings: PretrainingSettings) -> Task:
    """The task of the settings' modality."""
    return PaintImages(network, settings) if settings.modality == "image" else GuessOccupancy(network, settings)
