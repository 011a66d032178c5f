"""Masked occupancy of a voxel encoder [UMF 4.5.1, figure 4.7] (Voxel-MAE [Min 2022])."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, Self

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import Field, model_validator
from torch import Tensor, nn

from umf_ros.core.geometry import Array
from umf_ros.embedding.inputs import CELLS, ORIGIN_M, VOXEL_M
from umf_ros.lab.datasets.sample import Sample
from umf_ros.lab.datasets.views import View
from umf_ros.lab.training.pretraining import Column, MaskedBatch, Pretraining, PretrainingSettings
from umf_ros.networks.encoders import FEATURES
from umf_ros.networks.umf import UMF

RARE = -4.0
"""Log-odds of a voxel being occupied before anything is learned: one in fifty."""
RINGS_M = (15.0, 30.0)
HALF = CELLS // 2


class MaskedScansSettings(PretrainingSettings):
    """Pretraining of the voxel encoder."""

    weights_suffix = "_lidar"

    method: Literal["masked_scans"] = "masked_scans"
    ring_ratios: tuple[float, float, float] = Field(
        (0.7, 0.6, 0.5), description="share of the occupied voxels that is hidden nearer than 15 m, 30 m, and beyond"
    )

    @model_validator(mode="after")
    def _rings_decrease(self) -> Self:
        near, middle, far = self.ring_ratios
        if not 1 > near >= middle >= far > 0:
            raise ValueError("ring_ratios must not grow with distance and lie between 0 and 1")
        return self


class MaskedScansObjective(Pretraining):
    """The voxel encoder under a light decoder that says which voxels are occupied, the hidden ones among them."""

    settings_type = MaskedScansSettings

    def __init__(self, network: UMF, settings: MaskedScansSettings) -> None:
        super().__init__(network, settings)
        encoder = network.voxel_encoder
        for layer in (encoder.stem, encoder.down, encoder.bottom):
            layer.requires_grad_(True)
        self.decoder = OccupancyDecoder(network.config.voxel_channels, settings.decoder_width)
        self._ratios = settings.ring_ratios

    def part(self, sample: Sample) -> Sample | None:
        """The scan alone."""
        return None if sample.points is None else replace(sample, image=None)

    def masked(self, views: Sequence[View], rng: np.random.Generator) -> MaskedBatch:
        """Grids (B, 20, 20, 20, 48), and which of their voxels (B, 20, 20, 20, 8) are hidden; both folded."""
        grid = torch.from_numpy(np.stack([view.scan.grid for view in views]))
        return MaskedBatch(grid, hidden_voxels(occupancy(grid), self._ratios, rng))

    def forward(self, batch: MaskedBatch) -> dict[str, Tensor]:
        """Binary cross-entropy of the occupancy."""
        wanted = occupancy(batch.values).float()
        return {"total": F.binary_cross_entropy_with_logits(self.predict(batch), wanted)}

    def predict(self, batch: MaskedBatch) -> Tensor:
        """Logits (B, 20, 20, 20, 8) of the occupancy of the whole grid, from the voxels that are not hidden."""
        encoder = self.network.voxel_encoder
        features = batch.values.unflatten(-1, (FEATURES, 8))
        grid = (features * ~batch.mask[..., None, :]).flatten(-2)
        fine = encoder.stem(grid.permute(0, 4, 1, 2, 3))
        middle = encoder.down(fine)
        logits: Tensor = self.decoder(fine, middle, encoder.bottom(middle))
        return logits.float()

    def draw(self, batch: MaskedBatch) -> list[Column]:
        """Occupancy, what of it is visible, and what is predicted, from above.

        The brighter, the higher the ground lies; the darker, the less sure it is.
        """
        occupied = occupancy(batch.values)
        shown = {"scan": occupied, "visible": occupied & ~batch.mask, "predicted": self.predict(batch).sigmoid()}
        return [(name, _from_above(unfold(values.float()).cpu().numpy())) for name, values in shown.items()]


OBJECTIVE = MaskedScansObjective


class OccupancyDecoder(nn.Module):
    """From the encoder's maps at 20^3, 10^3 and 5^3 cells to the occupancy of voxels.

    Args:
        channels: of the maps.
        width: channels of the decoder.
    """

    def __init__(self, channels: tuple[int, int, int], width: int) -> None:
        super().__init__()
        fine, middle, deep = channels
        self.deep, self.middle, self.fine = (nn.Conv3d(count, width, 1) for count in (deep, middle, fine))
        self.mix_middle, self.mix_fine = _mix(width), _mix(width)
        self.head = nn.Conv3d(width, 8, 1)  # the eight children of a cell of the 20^3 grid
        nn.init.constant_(self.head.get_parameter("bias"), RARE)

    def forward(self, fine: Tensor, middle: Tensor, deep: Tensor) -> Tensor:
        """Maps (B, C, X, Y, Z) to logits (B, 20, 20, 20, 8), folded."""
        x = self.mix_middle(_double(self.deep(deep)) + self.middle(middle))
        x = self.head(self.mix_fine(_double(x) + self.fine(fine)))
        return x.permute(0, 2, 3, 4, 1)


def occupancy(grid: Tensor) -> Tensor:
    """(B, 20, 20, 20, 8) bool of a folded grid (B, 20, 20, 20, 48)."""
    return grid[..., :8] > 0


def _mix(width: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv3d(width, width, 3, padding=1, bias=False), nn.BatchNorm3d(width), nn.ReLU())


def _double(cells: Tensor) -> Tensor:
    return F.interpolate(cells, scale_factor=2.0, mode="nearest")


def voxel_ranges() -> Array:
    """(20, 20, 20, 8) horizontal distance of every voxel's centre from the body, m; folded as in `VoxelScan`."""
    x, y = (ORIGIN_M[axis] + (np.arange(CELLS) + 0.5) * VOXEL_M[axis] for axis in (0, 1))
    ranges = np.broadcast_to(np.hypot(x[:, None], y[None])[..., None], (CELLS, CELLS, CELLS))
    folded = ranges.reshape(HALF, 2, HALF, 2, HALF, 2).transpose(0, 2, 4, 1, 3, 5)
    return folded.reshape(HALF, HALF, HALF, 8)


def hidden_voxels(occupied: Tensor, ratios: tuple[float, float, float], rng: np.random.Generator) -> Tensor:
    """Hide occupied voxels, fewer of them in the sparse distance (range-aware masking of Voxel-MAE).

    Args:
        occupied: (B, 20, 20, 20, 8) bool, folded.
        ratios: shares hidden nearer than 15 m, nearer than 30 m, and beyond.
        rng: draws them.

    Returns:
        (B, 20, 20, 20, 8) bool.
    """
    ring = torch.from_numpy(np.digitize(voxel_ranges(), RINGS_M)).flatten()
    hidden = torch.zeros(len(occupied), ring.numel(), dtype=torch.bool)
    for row, there in zip(hidden, occupied.flatten(1), strict=True):
        for number, ratio in enumerate(ratios):
            members = torch.nonzero(there & (ring == number)).squeeze(1).numpy()
            row[rng.permutation(members)[: round(ratio * len(members))]] = True
    return hidden.view(occupied.shape)


def unfold(cells: Tensor) -> Tensor:
    """Depth to space: (B, 20, 20, 20, 8) to (B, 40, 40, 40)."""
    children = cells.unflatten(-1, (2, 2, 2)).permute(0, 1, 4, 2, 5, 3, 6)
    return children.reshape(len(cells), CELLS, CELLS, CELLS)


def _from_above(grid: Array) -> Array:
    """(B, X, Y, Z) chances of being occupied as (B, H, W) pictures, ahead up."""
    levels = np.linspace(0.25, 1.0, grid.shape[3])
    seen = (grid * levels).max(axis=3)[:, ::-1, ::-1]
    return seen.repeat(3, axis=1).repeat(3, axis=2)
