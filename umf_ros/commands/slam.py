"""`umf slam`: odometry, loop closures, pose graph and map of one recording."""

from __future__ import annotations

from pathlib import Path

from umf_ros.commands import map as maps
from umf_ros.commands import recordings as options


def command(
    bag: options.BagPath,
    out: maps.MapPath = Path("slam"),
    config: options.ConfigPath = None,
    changes: options.Changes = None,
    dataset: options.DatasetName = "auto",
    embedder: options.EmbedderName = None,
    weights: options.WeightsPath = None,
    odometry: maps.OdometryFiles = None,
    odometry_frame: options.OdometryFrame = "",
) -> None:
    """Make a map of one recording: odometry, loop closures, pose graph and ground in one command.

    Scans alone are enough. The same command continues where it was killed; umf map adds further recordings.
    """
    maps.command([bag], out, config, changes, dataset, embedder, weights, 1, None, odometry, odometry_frame)
