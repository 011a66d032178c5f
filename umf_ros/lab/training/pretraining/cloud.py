"""Masked occupancy of a voxel encoder (thesis 4.5.1, figure 4.7; Voxel-MAE)."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.networks.voxel_encoder import FEATURES, VoxelEncoder

RARE = -4.0
"""Log-odds of a voxel being occupied before anything is learned: one in fifty."""


class OccupancyReconstruction(nn.Module):
    """The encoder under a light decoder that says which voxels are occupied.

    Args:
        encoder: trained in place.
        channels: of the encoder at 20^3, 10^3 and 5^3 cells.
        width: channels of the decoder.
    """

    def __init__(self, encoder: VoxelEncoder, channels: tuple[int, int, int], width: int) -> None:
        super().__init__()
        self.encoder = encoder
        fine, middle, deep = channels
        self.deep, self.middle, self.fine = (nn.Conv3d(count, width, 1) for count in (deep, middle, fine))
        self.mix_middle, self.mix_fine = _mix(width), _mix(width)
        self.head = nn.Conv3d(width, 8, 1)  # the eight children of a cell of the 20^3 grid
        nn.init.constant_(self.head.get_parameter("bias"), RARE)

    def forward(self, grid: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Predict the occupancy of the whole grid from the voxels that are not hidden.

        Args:
            grid: (B, 20, 20, 20, 48) folded features of the voxels.
            hidden: (B, 20, 20, 20, 8) bool, folded.

        Returns:
            The loss, and logits (B, 20, 20, 20, 8).
        """
        features = grid.unflatten(-1, (FEATURES, 8))
        logits = self._logits((features * ~hidden[..., None, :]).flatten(-2)).float()
        return F.binary_cross_entropy_with_logits(logits, occupancy(grid).float()), logits

    def _logits(self, grid: Tensor) -> Tensor:
        encoder = self.encoder
        fine = encoder.stem(grid.permute(0, 4, 1, 2, 3))
        middle = encoder.down(fine)
        x = self.mix_middle(_double(self.deep(encoder.bottom(middle))) + self.middle(middle))
        x = self.head(self.mix_fine(_double(x) + self.fine(fine)))
        return x.permute(0, 2, 3, 4, 1)


def occupancy(grid: Tensor) -> Tensor:
    """(B, 20, 20, 20, 8) bool of a folded grid (B, 20, 20, 20, 48)."""
    return grid[..., :8] > 0


def _mix(width: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv3d(width, width, 3, padding=1, bias=False), nn.BatchNorm3d(width), nn.ReLU())


def _double(cells: Tensor) -> Tensor:
    return F.interpolate(cells, scale_factor=2.0, mode="nearest")
