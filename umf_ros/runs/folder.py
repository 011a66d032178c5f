"""`results/<timestamp>/` with `latest` pointing at it."""

from __future__ import annotations

import os
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from umf_ros.errors import OutputError


def create_run_folder(out: Path) -> Path:
    """Make a new folder named after the local time inside `out` and point `out/latest` at it.

    Raises:
        OutputError: `out` cannot be written.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    try:
        out.mkdir(parents=True, exist_ok=True)
        folder = _make_unique(out, stamp)
        _point(out / "latest", folder)
    except OSError as error:
        raise OutputError(f"cannot write to {out}: {error.strerror}") from None
    return folder


def check_writable(out: Path) -> None:
    """Find out before hours of work whether the results will have a place.

    Raises:
        OutputError: `out` cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write to {out}: {error.strerror}") from None
    if not os.access(out, os.W_OK):
        raise OutputError(f"cannot write to {out}: permission denied")


def _make_unique(out: Path, name: str) -> Path:
    for suffix in ["", *(f"_{i}" for i in range(2, 1000))]:
        with suppress(FileExistsError):
            (out / (name + suffix)).mkdir()
            return out / (name + suffix)
    raise OutputError(f"too many runs named {name} in {out}")


def _point(link: Path, folder: Path) -> None:
    """Replace the link in one step, so that `latest` always leads somewhere."""
    fresh = link.with_name(f".latest-{os.getpid()}")
    fresh.symlink_to(folder.name, target_is_directory=True)
    fresh.replace(link)


def write_atomically(path: Path, text: str) -> None:
    """Write a text file that is never seen half-written.

    Raises:
        OutputError: the file cannot be written.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink()
        raise OutputError(f"cannot write {path}: {error.strerror}") from None
