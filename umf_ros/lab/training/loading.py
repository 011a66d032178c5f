"""Batches made ahead of their use by worker processes, so that a GPU need not wait for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import cv2
import torch
from torch.utils.data import DataLoader, Dataset

from umf_ros.core.errors import UmfError

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
    """What `make` makes of every step, in order.

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
