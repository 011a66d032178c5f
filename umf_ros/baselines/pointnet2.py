"""PointNet++ [Qi 2017]: sets of points abstracted to fewer and larger regions, in plain torch."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from umf_ros.baselines.place_network import PlaceInput, PlaceNetwork, Sense


def farthest_points(points: Tensor, count: int) -> Tensor:
    """Indices (B, count) of points (B, N, 3), each the farthest from those before it; the first is the first."""
    chosen = points.new_zeros(len(points), count, dtype=torch.long)
    distance = points.new_full(points.shape[:2], torch.inf)
    rows = torch.arange(len(points), device=points.device)
    for number in range(1, count):
        last = points[rows, chosen[:, number - 1]]
        distance = torch.minimum(distance, (points - last[:, None]).square().sum(-1))
        chosen[:, number] = distance.argmax(1)
    return chosen


def ball_query(points: Tensor, centres: Tensor, radius: float, count: int) -> Tensor:
    """Indices (B, M, count) of points (B, N, 3) around centres (B, M, 3): the first so many within the radius.

    Where there are fewer, the nearest stands in.
    """
    squared = torch.cdist(centres, points).square()
    order = torch.arange(points.shape[1], device=points.device).expand_as(squared)
    outside = squared > radius**2
    first = order.masked_fill(outside, points.shape[1]).topk(count, dim=2, largest=False).values
    return torch.where(first == points.shape[1], squared.argmin(2, keepdim=True), first)


def gather(values: Tensor, index: Tensor) -> Tensor:
    """Rows (B, ..., C) of values (B, N, C) at indices (B, ...)."""
    rows = torch.arange(len(values), device=values.device).view(-1, *[1] * (index.ndim - 1))
    return values[rows, index]


class SetAbstraction(nn.Module):
    """Sampling, grouping and a small PointNet.

    Args:
        inputs: features of a point, besides its coordinates.
        channels: of the shared layers.
        count: regions; 0: one of all points.
        radius: of a region, in units of the coordinates.
        members: points of a region.
    """

    def __init__(self, inputs: int, channels: tuple[int, ...], count: int, radius: float, members: int) -> None:
        super().__init__()
        self._count, self._radius, self._members = count, radius, members
        layers: list[nn.Module] = []
        for before, after in zip((inputs + 3, *channels), channels, strict=False):
            layers += [nn.Linear(before, after, bias=False), nn.BatchNorm1d(after), nn.ReLU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, points: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Points (B, N, 3) with features (B, N, C) to regions (B, M, 3) and (B, M, C')."""
        centres, index = self._regions(points)
        inside = (gather(points, index) - centres[:, :, None]) / self._radius
        grouped = torch.cat([inside, gather(features, index)], -1)
        found = self.layers(grouped.flatten(0, 2)).unflatten(0, grouped.shape[:3])
        return centres, found.amax(2)

    def _regions(self, points: Tensor) -> tuple[Tensor, Tensor]:
        if not self._count:
            every = torch.arange(points.shape[1], device=points.device).expand(len(points), 1, -1)
            return points.new_zeros(len(points), 1, 3), every
        centres = gather(points, farthest_points(points, self._count))
        return centres, ball_query(points, centres, self._radius, self._members)


class PointNet2(PlaceNetwork):
    """Two levels of regions, 2.5 and 8 m, then all of them."""

    reads: ClassVar[frozenset[Sense]] = frozenset({"points"})

    def __init__(self, length: int = 256) -> None:
        super().__init__()
        self.length = length
        self.near = SetAbstraction(0, (64, 64, 128), 128, 2.5, 16)
        self.far = SetAbstraction(128, (128, 128, 256), 32, 8.0, 16)
        self.whole = SetAbstraction(256, (256, 512), 0, 20.0, 0)
        layers = nn.Linear(512, 512, bias=False), nn.BatchNorm1d(512), nn.ReLU(), nn.Linear(512, length)
        self.head = nn.Sequential(*layers)

    def forward(self, batch: PlaceInput) -> dict[str, Tensor]:
        """Descriptor of the points."""
        points = batch.points
        regions = self.near(points, points.new_zeros(*points.shape[:2], 0))
        _, found = self.whole(*self.far(*regions))
        return {"descriptor": self.head(found[:, 0]) * batch.cloud_present[:, None]}
