"""Several processes under `torchrun`: each has its own batches, gradients are averaged."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist


@dataclass(frozen=True, slots=True)
class Team:
    """Where a process stands among the others.

    Attributes:
        rank: of the process, 0 leads: it alone validates and writes.
        size: number of processes.
        device: what the process computes on.
    """

    rank: int
    size: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """Whether this is the process that validates and writes."""
        return self.rank == 0


def choose_device(device: str) -> str:
    """Name of a torch device; for "auto" a GPU's where there is one."""
    return device if device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"


@contextmanager
def join_team(device: str) -> Iterator[Team]:
    """The team that `torchrun` started, or a team of one.

    Args:
        device: torch device, or "auto".
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    rank, local = int(os.environ.get("RANK", "0")), int(os.environ.get("LOCAL_RANK", "0"))
    chosen = choose_device(device)
    target = torch.device(f"{chosen}:{local}" if chosen == "cuda" and size > 1 else chosen)
    if size == 1:
        yield Team(0, 1, target)
        return
    # the others wait while the leader validates
    dist.init_process_group("nccl" if target.type == "cuda" else "gloo", timeout=timedelta(hours=1))
    try:
        yield Team(rank, size, target)
    finally:
        dist.destroy_process_group()
