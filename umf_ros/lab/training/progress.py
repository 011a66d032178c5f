"""How a run proceeds: where it stands, its learning rate, its log, and checkpoints it goes on from."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from umf_ros.core.errors import WeightsError, writing
from umf_ros.core.io import atomic_write


@dataclass
class Progress:
    """Where a run stands; plain data, for it goes into the checkpoint.

    Attributes:
        step: steps done.
        seconds: time they took.
        losses: means over the last steps of the epoch, by name.
        figures: what was measured last, by name.
        stopped: whether the objective wants no more steps.
    """

    step: int = 0
    seconds: float = 0.0
    losses: dict[str, float] = field(default_factory=dict)
    figures: dict[str, float] = field(default_factory=dict)
    stopped: bool = False


def learning_rate(peak: float, warmup_steps: int, step: int, steps: int) -> float:
    """Linear warm-up, then half a cosine: from `peak` down to zero at the last of the steps."""
    warm = min(1.0, (step + 1) / max(warmup_steps, 1))
    return peak * warm * 0.5 * (1 + math.cos(math.pi * step / steps))


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Add a row to a CSV file, which begins with the names of its columns.

    Raises:
        OutputError: it cannot be written.
    """
    with writing(path), path.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(row))
        if stream.tell() == 0:
            writer.writeheader()
        writer.writerow(row)


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint; an interrupted write leaves the previous one.

    Raises:
        OutputError: it cannot be written.
    """
    with atomic_write(path, RuntimeError) as part:
        torch.save(state, part)


@contextmanager
def resuming(path: Path) -> Iterator[dict[str, Any]]:
    """Read a checkpoint, to be taken over inside the block.

    Raises:
        WeightsError: missing, damaged, or of a run that differs.
    """
    try:
        state = dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # torch.load raises whatever the damaged bytes provoke
        raise WeightsError(f"cannot resume from {path}: {_one_line(error)}") from None
    try:
        yield state
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise WeightsError(f"cannot resume from {path}, which is of another run: {_one_line(error)}") from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
