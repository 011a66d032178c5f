"""AdaFusion [Lai 2022]: image and scan weighted against each other by what attention finds in them."""

from __future__ import annotations

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.baselines.minkloc import LENGTH, Level, SparseGem, VoxelPyramid, frame_means
from umf_ros.baselines.place_network import EARLY, LATE, Gem, ImageTrunk, PlaceInput, PlaceNetwork, Sense

SUMMARY = 64
"""Numbers that say of one scale how much it is worth."""


class ChannelAttention(nn.Module):
    """A weight for each channel, from its mean over the view."""

    def __init__(self, channels: int, reduction: int = 8) -> None:
        super().__init__()
        narrow = max(channels // reduction, 4)
        self.layers = nn.Sequential(nn.Linear(channels, narrow), nn.ReLU(), nn.Linear(narrow, channels), nn.Sigmoid())

    def forward(self, means: Tensor) -> Tensor:
        """(B, C) to the same shape, 0 to 1."""
        found: Tensor = self.layers(means)
        return found


class ImageScale(nn.Module):
    """Channel and spatial attention on maps of one scale, and what they summarise to."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channel, self.spatial = ChannelAttention(channels), nn.Conv2d(channels, 1, 3, padding=1)
        self.summary = nn.Linear(channels, SUMMARY)

    def forward(self, maps: Tensor) -> Tensor:
        """(B, C, H, W) to (B, 64)."""
        maps = maps * self.channel(maps.mean(dim=(2, 3)))[..., None, None]
        weight = self.spatial(maps).flatten(2).softmax(2)
        return F.relu(self.summary((maps.flatten(2) * weight).sum(2)))


class CloudScale(nn.Module):
    """The same on occupied cells."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channel, self.spatial = ChannelAttention(channels), nn.Linear(channels, 1)
        self.summary = nn.Linear(channels, SUMMARY)

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """(N, C) to (B, 64)."""
        features = features * self.channel(frame_means(features, level))[level.cells[:, 0]]
        weight = self.spatial(features).clamp(-10, 10).exp()
        share = frame_means(features * weight, level) / frame_means(weight, level).clamp(min=1e-9)
        return F.relu(self.summary(share))


class AdaFusion(PlaceNetwork):
    """Both descriptors side by side, each as long as attention over several scales of both says."""

    reads: ClassVar[frozenset[Sense]] = frozenset({"image", "voxels"})
    length = 2 * LENGTH

    def __init__(self) -> None:
        super().__init__()
        self.image_trunk, self.pyramid = ImageTrunk(), VoxelPyramid()
        self.lateral = nn.Conv2d(LATE, LENGTH, 1)
        self.image_pool, self.cloud_pool = Gem(), SparseGem()
        self.image_scales = nn.ModuleList(ImageScale(channels) for channels in (EARLY, LATE, LATE))
        self.cloud_scales = nn.ModuleList(CloudScale(channels) for channels in (32, 64, 64))
        scales = len(self.image_scales) + len(self.cloud_scales)
        self.weigh = nn.Sequential(nn.Linear(scales * SUMMARY, SUMMARY), nn.ReLU(), nn.Linear(SUMMARY, 2))

    def forward(self, batch: PlaceInput) -> dict[str, Tensor]:
        """Descriptors of both and of each."""
        late, scales = self.image_trunk.late(batch.maps), self.pyramid.scales(batch)
        seen = F.normalize(self.image_pool(self.lateral(late)), dim=1)
        felt = F.normalize(self.cloud_pool(*self.pyramid.merge(scales)), dim=1)
        weight = self._weights(batch, late, scales)
        found = torch.cat([seen * weight[:, :1], felt * weight[:, 1:]], 1)
        return {"descriptor": found, "image": seen, "cloud": felt}

    def _weights(self, batch: PlaceInput, late: Tensor, scales: list[tuple[Tensor, Level]]) -> Tensor:
        """(B, 2) of image and scan, their sum one; a missing one has none."""
        maps = (batch.maps, late, F.avg_pool2d(late, 2))
        told = [layer(one) for layer, one in zip(self.image_scales, maps, strict=True)]
        told += [layer(*one) for layer, one in zip(self.cloud_scales, scales, strict=True)]
        scores = self.weigh(torch.cat(told, 1)).float()
        present = torch.stack([batch.image_present, batch.cloud_present], 1)
        return scores.masked_fill(~present, -torch.inf).softmax(1).nan_to_num()
