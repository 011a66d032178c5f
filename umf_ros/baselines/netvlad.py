"""NetVLAD [Arandjelović 2016]: residuals to soft clusters of local features, whitened."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.baselines.place_network import LATE, ImageTrunk, PlaceInput, PlaceNetwork, Sense

SHARPNESS = 100.0
"""How many times as much the nearest cluster is assigned as the second, at the start."""


class NetVlad(PlaceNetwork):
    """64 clusters on the trunk's last maps, then a whitening to 256 numbers that is fitted, not learned."""

    reads: ClassVar[frozenset[Sense]] = frozenset({"image"})

    def __init__(self, clusters: int = 64, length: int = 256) -> None:
        super().__init__()
        self.length = length
        self.image_trunk = ImageTrunk()
        self.assign = nn.Conv2d(LATE, clusters, 1)
        self.centres = nn.Parameter(F.normalize(torch.randn(clusters, LATE), dim=1))
        self.register_buffer("mean", torch.zeros(clusters * LATE))
        self.register_buffer("directions", F.normalize(torch.randn(length, clusters * LATE), dim=1))
        self.mean: Tensor
        self.directions: Tensor

    def local(self, maps: Tensor) -> Tensor:
        """Local features (B, 112, H, W) of unit length."""
        return F.normalize(self.image_trunk.late(maps), dim=1)

    def vlad(self, maps: Tensor) -> Tensor:
        """(B, clusters * 112) of unit length."""
        local = self.local(maps)
        share = self.assign(local).flatten(2).softmax(1)
        total = share @ local.flatten(2).transpose(1, 2) - share.sum(2)[..., None] * self.centres
        return F.normalize(F.normalize(total, dim=2).flatten(1), dim=1)

    def forward(self, batch: PlaceInput) -> dict[str, Tensor]:
        """The whitened descriptor in use, the whole one while it learns."""
        vlad = self.vlad(batch.maps)
        found = vlad if self.training else (vlad - self.mean) @ self.directions.T
        return {"descriptor": found * batch.image_present[:, None]}

    @torch.no_grad()
    def begin(self, centres: Tensor, local: Tensor) -> None:
        """Start from clusters.

        Args:
            centres: (clusters, 112).
            local: (N, 112) features that they were found in, unit length.
        """
        nearest = torch.cdist(local, centres).square().sort(1).values
        alpha = math.log(SHARPNESS) / float((nearest[:, 1] - nearest[:, 0]).mean().clamp(min=1e-6))
        self.centres.copy_(centres)
        self.assign.weight.copy_((2 * alpha * centres)[..., None, None])
        assert self.assign.bias is not None
        self.assign.bias.copy_(-alpha * centres.square().sum(1))

    @torch.no_grad()
    def whiten(self, vlad: Tensor) -> None:
        """Fit the whitening to descriptors (N, clusters * 112), more of them than it keeps numbers."""
        self.mean.copy_(vlad.mean(0))
        centred = vlad - self.mean
        energy, weights = torch.linalg.eigh(
            centred @ centred.T
        )  # of as many numbers as there are descriptors, not 7168
        kept = min(self.length, len(energy) - 1)
        energy, weights = energy[-kept:].flip(0).clamp(min=1e-6 * float(energy[-1])), weights[:, -kept:].flip(1)
        variance = energy / len(vlad)
        self.directions.zero_()
        self.directions[:kept] = (weights / energy.sqrt()).T @ centred
        self.directions[:kept] /= (variance + 0.01 * variance[0]).sqrt()[:, None]
