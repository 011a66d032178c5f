"""Draw samples and load them as batches."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, Self, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from umf_ros.core.errors import ConfigError, UmfError
from umf_ros.embedding.inputs import pack
from umf_ros.lab.datasets.sample import Places, Rule, SampleSequence, label, places_of
from umf_ros.lab.datasets.views import Matches, View, ViewMaker, cell_points, match_cells, match_voxels
from umf_ros.networks.config import NetworkConfig, NetworkInput


@dataclass(frozen=True, slots=True)
class Draw:
    """One sample of a batch: sequence, index in it, and whether it is mirrored."""

    sequence: int
    index: int
    mirror: bool


class PairSampler:
    """Anchor-positive pairs of two worlds, half of each world's along one stretch of it.

    A place is confused with places of its own world: its neighbours along the path, and similar views
    farther off; a pair of another world differs by its ground alone. Hard worlds are drawn twice
    as often as easy ones. Positives come from another pass.

    Args:
        sequences: the worlds.
        rule: what a positive is.
        mirror: chance of a world to be mirrored.
        whole: take all pairs from all over one world instead, as the database of a rover will hold them.

    Raises:
        ConfigError: no sequence has a revisit.
    """

    def __init__(
        self, sequences: Sequence[SampleSequence], rule: Rule, mirror: float = 0.5, whole: bool = False
    ) -> None:
        self._sequences = sequences
        self._mirror, self._whole = mirror, whole
        self._positives = [_positives(sequence, rule) for sequence in sequences]
        self._usable = [np.flatnonzero([len(row) > 0 for row in rows]) for rows in self._positives]
        weight = np.array([0.0 if not len(self._usable[k]) else _weight(s) for k, s in enumerate(sequences)])
        if not weight.any():
            raise ConfigError("train: no place of these worlds is visited twice")
        self._chance = weight / weight.sum()

    def draw(self, pairs: int, rng: np.random.Generator) -> list[tuple[Draw, Draw]]:
        """`pairs` anchor-positive pairs."""
        drawn = []
        draw = self._anywhere if self._whole else self._stretch
        for count in (pairs,) if self._whole else (pairs // 2, pairs - pairs // 2):
            world = int(rng.choice(len(self._chance), p=self._chance))
            mirror = bool(rng.random() < self._mirror)
            drawn += [self._pair(world, index, mirror, rng) for index in draw(world, count, rng)]
        return drawn

    def _anywhere(self, world: int, count: int, rng: np.random.Generator) -> list[int]:
        """Places of a world, as different ones as there are."""
        usable = self._usable[world]
        return rng.choice(usable, count, replace=len(usable) < count).tolist()

    def _stretch(self, world: int, count: int, rng: np.random.Generator) -> list[int]:
        """Half of them within 80 m of a random place, half anywhere in the world."""
        usable = self._usable[world]
        position = self._sequences[world].world_T_body[usable, :2, 3]
        near = usable[np.linalg.norm(position - position[rng.integers(len(usable))], axis=1) < 80]
        close = rng.choice(near, count // 2, replace=len(near) < count // 2)
        return [*map(int, close), *map(int, rng.choice(usable, count - count // 2))]

    def _pair(self, world: int, index: int, mirror: bool, rng: np.random.Generator) -> tuple[Draw, Draw]:
        positive = int(rng.choice(self._positives[world][index]))
        return Draw(world, index, mirror), Draw(world, positive, mirror)


def _weight(sequence: SampleSequence) -> float:
    return 1.0 if sequence.setting == "easy" else 2.0


def _positives(sequence: SampleSequence, rule: Rule) -> list[np.ndarray]:
    places = places_of(0, np.asarray(sequence.world_T_body), np.asarray(sequence.pass_index))
    positive, _ = label(places, places, replace(rule, between_passes=True))
    return [np.flatnonzero(row) for row in positive]


def places_drawn(draws: Sequence[Draw], sequences: Sequence[SampleSequence]) -> Places:
    """Places of a batch; a mirrored world is another world."""
    poses = np.stack([sequences[draw.sequence].world_T_body[draw.index] for draw in draws])
    flip = np.array([-1.0 if draw.mirror else 1.0 for draw in draws])
    places = places_of(0, poses)
    world = np.array([2 * draw.sequence + draw.mirror for draw in draws])
    position = places.position * np.stack([np.ones_like(flip), flip], axis=1)
    passage = np.array([sequences[draw.sequence].pass_index[draw.index] for draw in draws], float)
    return Places(world, position, places.heading * flip, passage)


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
    return trimmed(pack(images, [view.scan for view in views], config)).tensors()


def trimmed(batch: NetworkInput) -> NetworkInput:
    """Cut off padding that no scan of the batch needs; the outputs stay the same."""
    coarse, fine = (max(1, int(mask.sum(axis=1).max())) for mask in (batch.coarse_mask, batch.fine_mask))
    lengths = {"coarse_index": coarse, "coarse_mask": coarse, "fine_index": fine, "fine_mask": fine}
    return batch._replace(**{name: getattr(batch, name)[:, :length] for name, length in lengths.items()})


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


Item = TypeVar("Item")


class _ByStep(Dataset[Item | UmfError], Generic[Item]):
    def __init__(self, make: Callable[[int], Item]) -> None:
        self._make = make

    def __getitem__(self, step: int) -> Item | UmfError:
        try:
            return self._make(step)
        except UmfError as error:  # the loader would wrap it in a trace of the other process
            return error


def made_ahead(make: Callable[[int], Item], steps: range, workers: int) -> Iterator[Item]:
    """Batches of `make` for every step, in order.

    Args:
        make: must depend on nothing but the step; called in a copy of this process.
        steps: what to make.
        workers: processes; 0: this one, when an item is asked for.

    Raises:
        UmfError: what `make` raises.
    """
    if not workers:
        yield from map(make, steps)
        return
    cv2.setNumThreads(0)  # its threads would not be there in a copy, which would wait for them for ever
    torch.sparse.check_sparse_tensor_invariants.disable()  # or torch warns that they are not checked
    loader = DataLoader(
        _ByStep(make),
        batch_size=None,
        sampler=steps,
        num_workers=min(workers, len(steps)),
        prefetch_factor=2,
        multiprocessing_context="fork",
        collate_fn=_as_it_is,
    )
    for item in loader:
        if isinstance(item, UmfError):
            raise item
        yield item


def _as_it_is(item: object) -> object:
    return item
