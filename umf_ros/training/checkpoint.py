"""Checkpoints from which a run goes on as if it had never stopped."""

from __future__ import annotations

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
        raise OutputError(f"cannot write {path}: {' '.join(str(error).split())}") from None


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint.

    Raises:
        WeightsError: missing or damaged.
    """
    try:
        return dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # torch.load raises whatever the damaged bytes provoke
        raise WeightsError(f"cannot resume from {path}: {' '.join(str(error).split())[:200]}") from None
