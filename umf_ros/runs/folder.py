"""`results/<timestamp>/` with `latest` pointing at it."""

from __future__ import annotations

import os
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from umf_ros.core.errors import OutputError, writing
from umf_ros.core.io import atomic_write


def create_run_folder(out: Path) -> Path:
    """Make a new folder named after the local time inside `out` and point `out/latest` at it.

    Raises:
        OutputError: `out` cannot be written.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    with writing(f"to {out}"):
        out.mkdir(parents=True, exist_ok=True)
        folder = _make_unique(out, stamp)
        # in one step, so that `latest` always leads somewhere
        fresh = out / f".latest-{os.getpid()}"
        fresh.symlink_to(folder.name, target_is_directory=True)
        fresh.replace(out / "latest")
    return folder


def check_writable(out: Path) -> None:
    """Find out before hours of work whether the results will have a place.

    Raises:
        OutputError: `out` cannot be written.
    """
    with writing(f"to {out}"):
        out.mkdir(parents=True, exist_ok=True)
    if not os.access(out, os.W_OK):
        raise OutputError(f"cannot write to {out}: permission denied")


def _make_unique(out: Path, name: str) -> Path:
    for suffix in ["", *(f"_{i}" for i in range(2, 1000))]:
        with suppress(FileExistsError):
            (out / (name + suffix)).mkdir()
            return out / (name + suffix)
    raise OutputError(f"too many runs named {name} in {out}")


def write_atomically(path: Path, text: str) -> None:
    """Write a text file that is never seen half-written.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")
