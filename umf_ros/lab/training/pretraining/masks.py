"""What is hidden from an encoder."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from umf_ros.embedding.voxels import CELLS, ORIGIN_M, VOXEL_M
from umf_ros.geometry import Array

PATCH = 32
"""Pixels per side of a patch: one cell of the encoder's coarsest map."""
RINGS_M = (15.0, 30.0)
HALF = CELLS // 2


def visible_patches(batch: int, image_size: tuple[int, int], ratio: float, rng: np.random.Generator) -> Tensor:
    """(B, 1, H/32, W/32) bool, False for the `ratio` of the patches of every image that is hidden."""
    rows, columns = image_size[0] // PATCH, image_size[1] // PATCH
    kept = max(round(rows * columns * (1 - ratio)), 1)
    rank = rng.random((batch, rows * columns)).argsort(axis=1).argsort(axis=1)
    return torch.from_numpy(rank < kept).view(batch, 1, rows, columns)


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
