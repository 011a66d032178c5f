"""Files that come with the package, in a checkout or an installed share folder. Cheap to import: for `umf --help`."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from umf_ros.core.errors import UmfError

DEFAULT_DATASET = "simulated"
LAB_PACKAGES = {"nncf": ("nncf", "3.4"), "open3d": ("open3d", "0.19"), "sklearn": ("scikit-learn", "1.4")}
"""Optional packages: distribution and first version known to work, by module."""
FLEET_PACKAGES = ("pgvector", "psycopg", "ray")
"""Modules that only a rover of a fleet or a cluster needs."""
ODOMETRY_ENGINES = ("vgicp",)
"""Engines that make odometry from scans, by the names of `umf_ros.sensors.scan_odometry.ENGINES`; the default first."""
MADE_ODOMETRY = "odometry.tum"
"""Poses of an engine in the folder of a run."""


def share_folders() -> list[Path]:
    """Return folders that can hold `config/` and `models/`, the most specific first."""
    checkout = Path(__file__).resolve().parents[2]
    folders = [checkout] if (checkout / "package.xml").is_file() else []
    # <prefix>/lib/python3.x/site-packages/umf_ros -> <prefix>/share/umf_ros
    folders += [parent / "share" / "umf_ros" for parent in Path(__file__).resolve().parents]
    return [*folders, Path(sys.prefix) / "share" / "umf_ros"]


def find(relative: str) -> Path:
    """Return the path of a shipped file, such as `config/calibration/simulated.yaml`.

    Raises:
        UmfError: no such file is installed.
    """
    for folder in share_folders():
        if (folder / relative).exists():
            return folder / relative
    raise UmfError(f"{relative} is not installed with umf_ros; reinstall the package")


def dataset_names() -> list[str]:
    """Return data sets that have a file in `config/datasets`, the default first."""
    names = {path.stem for folder in share_folders() for path in (folder / "config" / "datasets").glob("*.yaml")}
    return sorted(names, key=lambda name: (name != DEFAULT_DATASET, name))


def check_packages() -> None:
    """Check that this Python has the packages that are needed: the venv of a workspace may not be activated.

    Raises:
        UmfError: it has none of them.
    """
    if not any(find_spec(name) for name in ("rosbags", "pydantic_core")):
        raise UmfError(f"{sys.executable} lacks the required packages: source venv/bin/activate first")
