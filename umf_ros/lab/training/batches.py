"""From drawn samples to tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from umf_ros.embedding.inputs import pack
from umf_ros.embedding.torch_runtimes import to_tensors
from umf_ros.lab.datasets.correspondences import Matches, cell_points, match_cells, match_voxels
from umf_ros.lab.datasets.labels import Places
from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.lab.datasets.views import View, ViewMaker
from umf_ros.lab.training.sampler import Draw, places_drawn
from umf_ros.networks.config import NetworkConfig
from umf_ros.networks.umf import NetworkInput

CHILDREN = 8
"""Voxels folded into one cell of the grid."""


@dataclass(frozen=True, slots=True)
class TrainingBatch:
    """A batch of metric learning.

    Attributes:
        input: the views; row i and row B/2 + i are a pair.
        image_kept, cloud_kept: (B,) bool, images and scans that the fused descriptor may use.
        places: where they were taken.
        with_bank: whether descriptors of past batches serve as references too.
        local_rows: (2L,) rows that train the local heads: L anchors, then their L partners.
        cells, voxels: (L, K, 2) corresponding features of each such pair, -1 for none.
        useful_cells: (2L, N) bool, image cells with a known depth.
    """

    input: NetworkInput
    image_kept: Tensor
    cloud_kept: Tensor
    places: Places
    local_rows: Tensor
    cells: Tensor
    voxels: Tensor
    useful_cells: Tensor
    with_bank: bool = False

    def thinned(self) -> Self:
        """The batch with a sparse grid, a thirtieth of its size: what is sent between processes has to be copied."""
        return replace(self, input=_thin(self.input))

    def to(self, device: torch.device) -> Self:
        """The batch on another device, its grid dense again."""
        names = ("image_kept", "cloud_kept", "local_rows", "cells", "voxels", "useful_cells")
        moved = {name: getattr(self, name).to(device) for name in names}
        return replace(self, input=_thick(self.input.to(device)), **moved)


def stack_views(views: Sequence[View], config: NetworkConfig) -> NetworkInput:
    """The views as one batch."""
    images = [view.image if view.image_present else None for view in views]
    return to_tensors(pack(images, [view.scan for view in views], config, trim=True))


def _thin(batch: NetworkInput) -> NetworkInput:
    cells = batch.grid.flatten(0, 3)
    occupied = torch.nonzero(cells[:, :CHILDREN].sum(1)).squeeze(1)  # the first feature is occupancy
    places = torch.stack(torch.unravel_index(occupied, batch.grid.shape[:4]))
    grid = torch.sparse_coo_tensor(places, cells[occupied], batch.grid.shape, is_coalesced=True)
    return batch._replace(grid=grid)


def _thick(batch: NetworkInput) -> NetworkInput:
    return batch._replace(grid=batch.grid.to_dense()) if batch.grid.is_sparse else batch


class BatchMaker:
    """Makes augmented batches and finds what corresponds in them."""

    def __init__(self, sequences: Sequence[SampleSequence], views: ViewMaker, local_pairs: int, matches: int) -> None:
        self._sequences = sequences
        self._views = views
        self._local_pairs = local_pairs
        self._matches = matches

    def make(self, pairs: list[tuple[Draw, Draw]], rng: np.random.Generator) -> TrainingBatch:
        """Views of all anchors, then of all their positives."""
        draws = [anchor for anchor, _ in pairs] + [positive for _, positive in pairs]
        views = [self._view(draw, rng) for draw in draws]
        count = min(self._local_pairs, len(pairs))
        anchors = np.linspace(0, len(pairs) - 1, count).astype(int)
        rows = np.concatenate([anchors, anchors + len(pairs)])
        couples = [(views[row], views[row + len(pairs)]) for row in anchors]
        useful = [np.isfinite(cell_points(views[row])[:, 2]) for row in rows]
        stacked = stack_views(views, self._views.config)
        return TrainingBatch(
            input=stacked,
            image_kept=stacked.image_present,
            cloud_kept=stacked.coarse_mask.any(1),
            places=places_drawn(draws, self._sequences),
            local_rows=torch.from_numpy(rows),
            cells=self._pick([match_cells(*couple) for couple in couples], rng),
            voxels=self._pick([match_voxels(*couple) for couple in couples], rng),
            useful_cells=torch.from_numpy(np.array(useful, dtype=bool)),
        )

    def _view(self, draw: Draw, rng: np.random.Generator) -> View:
        return self._views.varied(self._sequences[draw.sequence].sample(draw.index), rng, draw.mirror)

    def _pick(self, found: list[Matches], rng: np.random.Generator) -> Tensor:
        picked = np.full((len(found), self._matches, 2), -1, np.int64)
        for row, matches in zip(picked, found, strict=True):
            some = rng.permutation(len(matches))[: self._matches]
            row[: len(some)] = matches[some]
        return torch.from_numpy(picked)
