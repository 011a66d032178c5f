"""MinkLoc++ [Komorowski 2021]: a sparse 3-D pyramid and an image branch, fused late."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.baselines.place_network import LATE, MEASURED, Gem, ImageTrunk, PlaceInput, PlaceNetwork, Sense
from umf_ros.networks.config import CELLS

LENGTH = 128
"""Of the descriptor of one modality."""
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

        The table has a margin around the grid, so that neighbours outside the grid need no check.
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


class Normalised(nn.Module):
    """A sparse convolution, batch normalisation over the occupied cells, ReLU."""

    def __init__(self, convolution: Around | Down | Up, channels: int) -> None:
        super().__init__()
        self.convolution, self.norm = convolution, nn.BatchNorm1d(channels)

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """As the convolution."""
        return F.relu(self.norm(self.convolution(features, level)))


class AttentiveBlock(nn.Module):
    """Residual block whose channels are weighted by their neighbours' means [ECA-Net 2020]."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = Normalised(Around(channels, channels), channels)
        self.second, self.norm = Around(channels, channels), nn.BatchNorm1d(channels)
        self.attention = nn.Conv1d(1, 1, 3, padding=1, bias=False)

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """(N, C) to the same shape."""
        found = self.norm(self.second(self.first(features, level), level))
        weight = self.attention(frame_means(found, level)[:, None]).squeeze(1).sigmoid()
        return F.relu(features + found * weight[level.cells[:, 0]])


def frame_means(features: Tensor, level: Level) -> Tensor:
    """Means (B, C) over the cells of each frame of features (N, C)."""
    frames = level.cells[:, 0]
    total = features.new_zeros(level.batch, features.shape[1]).index_add(0, frames, features)
    return total / torch.bincount(frames, minlength=level.batch)[:, None].clamp(min=1)


class VoxelPyramid(nn.Module):
    """Bottom-up at strides 2, 4 and 8 of a grid of 40^3, one step back down, 128 channels at stride 4."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = Normalised(Around(MEASURED, 32, 5), 32)
        self.downs = nn.ModuleList(Normalised(Down(i, o), o) for i, o in ((32, 32), (32, 64), (64, 64)))
        self.blocks = nn.ModuleList(AttentiveBlock(channels) for channels in (32, 64, 64))
        self.top, self.lateral = nn.Linear(64, LENGTH), nn.Linear(64, LENGTH)
        self.up = Up(LENGTH, LENGTH)

    def scales(self, batch: PlaceInput) -> list[tuple[Tensor, Level]]:
        """Features and cells at strides 2, 4 and 8."""
        frame, place = batch.mask.nonzero(as_tuple=True)
        flat = batch.cells[frame, place]
        cells = torch.stack([frame, flat // CELLS**2, flat // CELLS % CELLS, flat % CELLS], 1)
        level = Level(cells, CELLS, len(batch.mask))
        features = self.stem(batch.voxels[frame, place], level)
        found = []
        for down, block in zip(self.downs, self.blocks, strict=True):
            features, level = down(features, level), level.half
            features = block(features, level)
            found.append((features, level))
        return found

    def merge(self, scales: list[tuple[Tensor, Level]]) -> tuple[Tensor, Level]:
        """The pyramid's features (N, 128) at stride 4."""
        (_, _), (middle, level), (deep, _) = scales
        return self.lateral(middle) + self.up(self.top(deep), level), level

    def forward(self, batch: PlaceInput) -> tuple[Tensor, Level]:
        """From what was measured to the pyramid's features."""
        return self.merge(self.scales(batch))


class ImageBranch(nn.Module):
    """The trunk, 128 channels, generalised mean."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = ImageTrunk()
        self.lateral = nn.Conv2d(LATE, LENGTH, 1)
        self.pool = Gem()

    def forward(self, maps: Tensor) -> Tensor:
        """Early maps to descriptors (B, 128)."""
        found: Tensor = self.pool(self.lateral(self.trunk.late(maps)))
        return found


class CloudBranch(nn.Module):
    """The pyramid, generalised mean."""

    def __init__(self) -> None:
        super().__init__()
        self.pyramid = VoxelPyramid()
        self.pool = SparseGem()

    def forward(self, batch: PlaceInput) -> Tensor:
        """Descriptors (B, 128)."""
        found: Tensor = self.pool(*self.pyramid(batch))
        return found


class MinkLocVisual(PlaceNetwork):
    """The image branch alone."""

    reads: ClassVar[frozenset[Sense]] = frozenset({"image"})
    length = LENGTH

    def __init__(self) -> None:
        super().__init__()
        self.image = ImageBranch()

    def forward(self, batch: PlaceInput) -> dict[str, Tensor]:
        """Descriptor of the image."""
        return {"descriptor": self.image(batch.maps) * batch.image_present[:, None]}


class MinkLocLidar(PlaceNetwork):
    """The cloud branch alone."""

    reads: ClassVar[frozenset[Sense]] = frozenset({"voxels"})
    length = LENGTH

    def __init__(self) -> None:
        super().__init__()
        self.cloud = CloudBranch()

    def forward(self, batch: PlaceInput) -> dict[str, Tensor]:
        """Descriptor of the scan."""
        return {"descriptor": self.cloud(batch)}


class MinkLocFusion(PlaceNetwork):
    """Both descriptors side by side; half of the loss is the cloud's own (alpha .5, beta 0)."""

    reads: ClassVar[frozenset[Sense]] = frozenset({"image", "voxels"})
    length = 2 * LENGTH
    weight_cloud = 0.5

    def __init__(self) -> None:
        super().__init__()
        self.image, self.cloud = ImageBranch(), CloudBranch()

    def forward(self, batch: PlaceInput) -> dict[str, Tensor]:
        """Descriptors of both and of each."""
        seen, felt = self.image(batch.maps) * batch.image_present[:, None], self.cloud(batch)
        return {"descriptor": torch.cat([seen, felt], 1), "image": seen, "cloud": felt}
