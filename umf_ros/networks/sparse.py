"""Convolutions on occupied voxels alone, in plain torch [Choy 2019].

A level of resolution holds which voxels are occupied; a convolution gathers the features of a voxel's neighbours that
are occupied too and multiplies them with one matrix. Nothing is computed where there is nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn

MARGIN = 2
"""Empty voxels around the grid: how far the widest convolution reaches."""


@dataclass(frozen=True, eq=False)
class Level:
    """The occupied voxels of a batch at one resolution.

    Attributes:
        cells: (N, 4) int64 frame, x, y, z; every cell once.
        size: voxels along each side of the grid.
        batch: frames.
    """

    cells: Tensor
    size: int
    batch: int

    def rows(self, cells: Tensor) -> Tensor:
        """Rows of some cells (M, 4) within the grid, N for those that are empty."""
        return self._table[self._padded(cells)]

    def neighbours(self, kernel: int) -> Tensor:
        """Rows (N, kernel^3) of the cells around each cell, itself in the middle; N for those that are empty.

        The table is wider than the grid, so that nobody has to ask whether a neighbour is outside.
        """
        reach = torch.arange(kernel, device=self.cells.device) - kernel // 2
        around = torch.cartesian_prod(reach, reach, reach) @ reach.new_tensor([self._wide**2, self._wide, 1])
        return self._table[self._padded(self.cells)[:, None] + around]

    @cached_property
    def half(self) -> Level:
        """The same at half the resolution."""
        flat = self._flat(self._parents, self.size // 2).unique()
        return Level(_unflatten(flat, self.size // 2), self.size // 2, self.batch)

    @cached_property
    def parent(self) -> Tensor:
        """(N,) rows of `half`, and (N,) which of its eight children each cell is, as a pair (2, N)."""
        child = self.cells[:, 1:] % 2 @ self.cells.new_tensor([4, 2, 1])
        return torch.stack([self.half.rows(self._parents), child])

    @property
    def _parents(self) -> Tensor:
        return torch.cat([self.cells[:, :1], self.cells[:, 1:] // 2], 1)

    @property
    def _wide(self) -> int:
        return self.size + 2 * MARGIN

    @cached_property
    def _table(self) -> Tensor:
        table = self.cells.new_full((self.batch * self._wide**3,), len(self.cells))
        table[self._padded(self.cells)] = torch.arange(len(self.cells), device=table.device)
        return table

    def _padded(self, cells: Tensor) -> Tensor:
        """Places of cells (..., 4) in the table."""
        frame, x, y, z = cells.unbind(-1)
        return ((frame * self._wide + x + MARGIN) * self._wide + y + MARGIN) * self._wide + z + MARGIN

    def _flat(self, cells: Tensor, size: int) -> Tensor:
        frame, x, y, z = cells.unbind(-1)
        return ((frame * size + x) * size + y) * size + z


def _unflatten(flat: Tensor, size: int) -> Tensor:
    return torch.stack([flat // size**3, flat // size**2 % size, flat // size % size, flat % size], 1)


class Around(nn.Module):
    """Convolution of odd kernel over the occupied cells (N, C) of a level, to (N, C')."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3) -> None:
        super().__init__()
        self._kernel = kernel
        self.linear = _linear(inputs * kernel**3, outputs)

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """Features (N, C') of the same cells."""
        padded = torch.cat([features, features.new_zeros(1, features.shape[1])])
        found: Tensor = self.linear(padded[level.neighbours(self._kernel)].flatten(1))
        return found


class Down(nn.Module):
    """Convolution of kernel and stride two, to the level of half the resolution."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = _linear(inputs * 8, outputs)

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """Features (M, C') of the cells of `level.half` from (N, C)."""
        row, child = level.parent
        family = features.new_zeros(len(level.half.cells), 8, features.shape[1])
        found: Tensor = self.linear(family.index_put((row, child), features).flatten(1))
        return found


class Up(nn.Module):
    """Transposed convolution of kernel and stride two, from the level of half the resolution."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self._outputs = outputs
        self.linear = _linear(inputs, outputs * 8)

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """Features (N, C') of the cells of `level` from (M, C) of `level.half`."""
        row, child = level.parent
        return self.linear(features).unflatten(1, (8, self._outputs))[row, child]


def _linear(inputs: int, outputs: int) -> nn.Linear:
    """Without bias, for a normalisation follows."""
    made = nn.Linear(inputs, outputs, bias=False)
    nn.init.kaiming_normal_(made.weight, nonlinearity="relu")
    return made


class SparseGem(nn.Module):
    """Generalised mean [Radenović 2019] over the cells of each frame.

    Args:
        power: at the start; it is learned.
    """

    def __init__(self, power: float = 3.0) -> None:
        super().__init__()
        self.power = nn.Parameter(torch.tensor(power))

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """(N, C) to (B, C); zeros for a frame without cells."""
        raised = features.float().clamp(min=1e-6) ** self.power
        total = raised.new_zeros(level.batch, features.shape[1]).index_add(0, level.cells[:, 0], raised)
        count = torch.bincount(level.cells[:, 0], minlength=level.batch)[:, None]
        mean = total / count.clamp(min=1)
        return torch.where(count > 0, mean.clamp(min=1e-18) ** (1 / self.power), torch.zeros_like(mean))
