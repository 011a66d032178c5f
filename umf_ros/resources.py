"""Where the package keeps its configuration and weights: in the checkout or in an installed share folder."""

from __future__ import annotations

import sys
from pathlib import Path

from umf_ros.errors import UmfError


def share_folders() -> list[Path]:
    """Folders that can hold `config/` and `models/`, the most specific first."""
    checkout = Path(__file__).resolve().parent.parent
    folders = [checkout] if (checkout / "package.xml").is_file() else []
    # <prefix>/lib/python3.x/site-packages/umf_ros -> <prefix>/share/umf_ros
    folders += [parent / "share" / "umf_ros" for parent in Path(__file__).resolve().parents]
    return [*folders, Path(sys.prefix) / "share" / "umf_ros"]


def find(relative: str) -> Path:
    """Path of a shipped file, such as `config/calibration/simulated.yaml`.

    Raises:
        UmfError: no such file is installed.
    """
    for folder in share_folders():
        if (folder / relative).exists():
            return folder / relative
    raise UmfError(f"{relative} is not installed with umf_ros; reinstall the package")
