"""Text files of trajectories."""

from __future__ import annotations

from pathlib import Path

from umf_ros.errors import BagError


def read_lines(path: str | Path) -> list[str]:
    """Lines of a text file.

    Raises:
        BagError: the file cannot be read or is no text.
    """
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise BagError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise BagError(f"{path} is no text file") from None
