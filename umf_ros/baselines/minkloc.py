"""MinkLoc++ [Komorowski 2021]: a sparse 3-D pyramid and an image branch, fused late."""

from __future__ import annotations

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.baselines.place_network import LATE, MEASURED, Gem, ImageTrunk, PlaceInput, PlaceNetwork, Sense
from umf_ros.networks.encoders import Around, Down, Level, SparseGem, Up

CELLS = 40
LENGTH = 128
"""Of the descriptor of one modality."""


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
