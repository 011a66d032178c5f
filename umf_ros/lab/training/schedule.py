"""How a run proceeds: its learning rate, and the log it keeps."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

from umf_ros.errors import OutputError


def learning_rate(peak: float, warmup_steps: int, step: int, steps: int) -> float:
    """Linear warm-up, then half a cosine: from `peak` down to zero at the last of the steps."""
    warm = min(1.0, (step + 1) / max(warmup_steps, 1))
    return peak * warm * 0.5 * (1 + math.cos(math.pi * step / steps))


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Add a row to a CSV file, which begins with the names of its columns.

    Raises:
        OutputError: it cannot be written.
    """
    try:
        with path.open("a", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, list(row))
            if stream.tell() == 0:
                writer.writeheader()
            writer.writerow(row)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from None
