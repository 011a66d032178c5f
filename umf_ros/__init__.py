"""Multimodal place recognition and loop closure for rovers with a camera and a LiDAR."""

import re
from pathlib import Path


def _version() -> str:
    """The version in package.xml, the one place where it is written: beside a checkout, else as it was installed."""
    package = Path(__file__).parents[1] / "package.xml"
    if package.is_file():
        written = re.search(r"<version>(.+)</version>", package.read_text(encoding="utf-8"))
        return written[1] if written else ""
    from importlib.metadata import version

    return version("umf_ros")


__version__ = _version()
