"""Hierarchical encoder of a voxelised scan, with a pyramid decoder [UMF 4], in plain torch.

The grid comes folded two by two by two into its channels (space to depth), which makes dense 3-D
convolutions cheap enough for a small CPU; the fine map is only evaluated at occupied voxels.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.networks.config import NetworkConfig

CELLS = 40
FEATURES = 6


def parent_and_child(voxels: Tensor) -> tuple[Tensor, Tensor]:
    """Flat index in the 20^3 grid, and which of its eight children, of flat indices in the 40^3 grid."""
    x, y, z = voxels // (CELLS * CELLS), voxels // CELLS % CELLS, voxels % CELLS
    half = CELLS // 2
    return (x // 2 * half + y // 2) * half + z // 2, x % 2 * 4 + y % 2 * 2 + z % 2


def take(cells: Tensor, index: Tensor) -> Tensor:
    """Features (B, N, C) of the cells of a dense map (B, C, X, Y, Z) at flat indices (B, N)."""
    wanted = index.unsqueeze(1).expand(-1, cells.shape[1], -1)
    return cells.flatten(2).gather(2, wanted).transpose(1, 2)


def conv_block(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """3-D convolution, batch normalisation, ReLU."""
    conv = nn.Conv3d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(conv, nn.BatchNorm3d(outputs), nn.ReLU())


class ResidualBlock3d(nn.Module):
    """Two convolutions beside a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        second = nn.Conv3d(channels, channels, 3, padding=1, bias=False)
        self.layers = nn.Sequential(conv_block(channels, channels), second, nn.BatchNorm3d(channels))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, X, Y, Z) to the same shape; `x` is not negative."""
        return F.relu(x + self.layers(x))


class VoxelEncoder(nn.Module):
    """Encoder at 20^3, 10^3 and 5^3 cells with a top-down decoder."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        fine, middle, deep = config.voxel_channels
        self.stem = nn.Sequential(conv_block(FEATURES * 8, fine, 1), conv_block(fine, fine))
        self.down = _stage(fine, middle, config.voxel_blocks)
        self.bottom = _stage(middle, deep, config.voxel_blocks)
        self.up_middle = nn.Conv3d(deep, middle, 1)
        self.up_fine = nn.Conv3d(middle, fine, 1)
        self.coarse = nn.Conv3d(middle, config.tokens, 1)
        # a voxel's feature: its parent cell's, its own measurements, and which child it is
        self.fine = nn.Sequential(
            nn.Linear(fine + FEATURES + 8, config.local), nn.GELU(), nn.Linear(config.local, config.local)
        )

    def forward(self, grid: Tensor, coarse_index: Tensor, fine_index: Tensor) -> tuple[Tensor, Tensor]:
        """Encode a grid and read it at the occupied voxels.

        Args:
            grid: (B, 20, 20, 20, 48) folded features of the voxels, x y z.
            coarse_index: (B, T) flat indices in the 10^3 grid.
            fine_index: (B, V) flat indices in the 40^3 grid.

        Returns:
            Coarse tokens (B, T, tokens) and fine features (B, V, local).
        """
        folded = grid.permute(0, 4, 1, 2, 3)  # channels last in memory
        fine = self.stem(folded)
        middle = self.down(fine)
        deep = self.bottom(middle)
        middle = middle + _double(self.up_middle(deep))
        coarse = take(self.coarse(middle), coarse_index)
        fine = fine + _double(self.up_fine(middle))
        return coarse, self._fine_features(fine, folded, fine_index)

    def _fine_features(self, cells: Tensor, folded: Tensor, index: Tensor) -> Tensor:
        parent, child = parent_and_child(index)
        context = take(cells, parent)
        family = take(folded, parent).unflatten(-1, (FEATURES, 8))
        own = family.gather(3, child[..., None, None].expand(-1, -1, FEATURES, 1)).squeeze(3).to(context.dtype)
        place = F.one_hot(child, 8).to(context.dtype)
        return self.fine(torch.cat([context, own, place], dim=-1))


def _stage(inputs: int, outputs: int, blocks: int) -> nn.Sequential:
    """Half the resolution."""
    further = (ResidualBlock3d(outputs) for _ in range(blocks))
    return nn.Sequential(conv_block(inputs, outputs, stride=2), conv_block(outputs, outputs), *further)


def _double(cells: Tensor) -> Tensor:
    return F.interpolate(cells, scale_factor=2.0, mode="nearest")
