"""Objectives of the other methods' networks."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from pydantic import Field
from sklearn.cluster import KMeans

from umf_ros.baselines.netvlad import NetVlad
from umf_ros.lab.training.descriptors import DescriptorObjective
from umf_ros.lab.training.networks import DescriptorSettings


class AdaFusionSettings(DescriptorSettings):
    """What it was trained with."""

    method: Literal["adafusion"] = "adafusion"
    learning_rate: float = Field(5e-4, gt=0, description="peak of the cosine schedule")


class AdaFusionObjective(DescriptorObjective):
    """Nothing of its own."""

    settings_type = AdaFusionSettings


class MinkLocFusionSettings(DescriptorSettings):
    """What it was trained with."""

    method: Literal["minkloc_fusion"] = "minkloc_fusion"
    learning_rate: float = Field(5e-4, gt=0, description="peak of the cosine schedule")


class MinkLocFusionObjective(DescriptorObjective):
    """Nothing of its own."""

    settings_type = MinkLocFusionSettings


class MinkLocLidarSettings(DescriptorSettings):
    """What it was trained with."""

    method: Literal["minkloc_lidar"] = "minkloc_lidar"
    learning_rate: float = Field(1e-3, gt=0, description="peak of the cosine schedule")


class MinkLocLidarObjective(DescriptorObjective):
    """Nothing of its own."""

    settings_type = MinkLocLidarSettings


class MinkLocVisualSettings(DescriptorSettings):
    """What it was trained with."""

    method: Literal["minkloc_visual"] = "minkloc_visual"
    learning_rate: float = Field(3e-4, gt=0, description="peak of the cosine schedule")


class MinkLocVisualObjective(DescriptorObjective):
    """Nothing of its own."""

    settings_type = MinkLocVisualSettings


class PointNet2Settings(DescriptorSettings):
    """What it was trained with."""

    method: Literal["pointnet2"] = "pointnet2"
    learning_rate: float = Field(1e-3, gt=0, description="peak of the cosine schedule")


class PointNet2Objective(DescriptorObjective):
    """Nothing of its own."""

    settings_type = PointNet2Settings


IMAGES = 120
"""For the clusters; each has 140 local features."""
WHITENED = 700
"""Images that the whitening is fitted to."""


class NetVladSettings(DescriptorSettings):
    """What it was trained with."""

    method: Literal["netvlad"] = "netvlad"
    loss: Literal["neighbourhood", "triplet"] = Field("triplet", description="as it was published")
    learning_rate: float = Field(2e-4, gt=0, description="peak of the cosine schedule")


class NetVladObjective(DescriptorObjective):
    """Its centres begin as clusters of the trunk's own features."""

    settings_type = NetVladSettings
    network: NetVlad
    _whitened: torch.Tensor | None = None

    def begin(self) -> None:
        """Find the clusters, unless the network starts from weights."""
        if self._settings.start:
            return
        with torch.no_grad():
            local = self.network.local(self._some(IMAGES)).flatten(2).transpose(1, 2).flatten(0, 1)
        count = len(self.network.centres)
        found = KMeans(count, n_init=1, max_iter=50, random_state=self._settings.seed).fit(local.numpy())
        self.network.begin(torch.from_numpy(found.cluster_centers_).float(), local)

    def settle(self) -> None:
        """Fit the whitening to training images as they are described now."""
        if self._whitened is None:
            self._whitened = self._some(WHITENED).half()
        self.network.eval()
        device = self.network.mean.device
        with torch.no_grad():
            parts = [self.network.vlad(part.float().to(device)) for part in self._whitened.split(64)]
        self.network.whiten(torch.cat(parts))

    def _some(self, count: int) -> torch.Tensor:
        """Early maps (count, 80, 10, 14) of training images as they are."""
        every = [(world, row) for world in self._sequences for row in range(len(world))]
        chosen = np.random.default_rng(self._settings.seed).permutation(len(every))[:count]
        return torch.cat([self._views.plain(every[k][0], [every[k][1]]).maps for k in chosen])
