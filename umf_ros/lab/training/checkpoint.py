"""Checkpoints from which a run goes on as if it had never stopped."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from umf_ros.errors import OutputError, WeightsError


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint; an interrupted write leaves the previous one.

    Raises:
        OutputError: it cannot be written.
    """
    unfinished = path.with_suffix(".part")
    try:
        torch.save(state, unfinished)
        unfinished.replace(path)
    except (OSError, RuntimeError) as error:
        raise OutputError(f"cannot write {path}: {_one_line(error)}") from None


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
