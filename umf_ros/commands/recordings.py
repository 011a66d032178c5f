"""Options of the commands that read a recording, and functions that open it.

A file that is missing raises a `BagError`, a `ConfigError` or an `UmfError` before anything that takes time to import.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from umf_ros.core.errors import BagError, ConfigError, UmfError, either
from umf_ros.core.resources import dataset_names
from umf_ros.embedding import choices

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from umf_ros.bags.frames import FrameReader
    from umf_ros.bags.reader import Bag
    from umf_ros.core.config import Settings

BagPath = Annotated[Path, typer.Argument(help="mcap file, db3 folder, or ROS 1 .bag.")]
ConfigPath = Annotated[Path | None, typer.Option("--config", help="Parameter file (YAML).")]
DatasetName = Annotated[str, typer.Option("--dataset", help=f"{either(['auto', *dataset_names()])}.")]
EmbedderName = Annotated[str | None, typer.Option("--embedder", help=f"Embedding method: {choices()}.")]
WeightsPath = Annotated[Path | None, typer.Option("--weights", help="Weights file; default: umf_scene.")]
OdometryPath = Annotated[
    Path | None, typer.Option("--odometry", help="Odometry as a TUM file, where the recording has none.")
]
OdometryFrame = Annotated[
    str,
    typer.Option(
        "--odometry-frame",
        help="Frame of the poses in --odometry: body (the default), imu, camera or lidar (S3LI's Eval/BASALT: imu).",
        show_default=False,
    ),
]
TruthPath = Annotated[Path | None, typer.Option("--ground-truth", help="Truth as RTKLIB .pos or TUM file.")]
RunsFolder = Annotated[Path, typer.Option("--out", help="Parent folder of results/<timestamp>.")]


def check_files(bag: Path, *others: Path | None) -> None:
    """Check that a recording and other files exist."""
    if not bag.exists():
        raise BagError(f"there is no recording {bag}")
    for path in others:
        if path is not None and not path.exists():
            raise ConfigError(f"cannot read {path}: No such file or directory")


def check_map(folder: Path | None) -> None:
    """Check that a folder, if one is given, holds a map."""
    if folder is not None and not (folder / "map.json").is_file():
        raise UmfError(f"{folder} is not a map: map.json is missing; make one with umf map")


def open_recording(
    bag: Path,
    config: Path | None = None,
    dataset: str = "auto",
    embedder: str | None = None,
    weights: Path | None = None,
    **overrides: Any,
) -> tuple[Bag, Settings]:
    """Open a recording, and load the settings to read it with; `overrides` are those of `load_settings`."""
    check_files(bag, config)

    from umf_ros.bags.presets import settings_for
    from umf_ros.bags.reader import open_bag

    recording = open_bag(bag)
    overrides |= {"embedding__method": embedder, "embedding__weights": str(weights) if weights else None}
    return recording, settings_for(recording, config, dataset, **overrides)


def refuse_unused(what: str, options: Mapping[str, object]) -> None:
    """Raise a `ConfigError` if one of some options, by their names, is given that `what` would ignore."""
    given = [name for name, value in options.items() if value]
    if given:
        raise ConfigError(f"{what} {'has' if what.startswith('a ') else 'have'} no use for {', '.join(given)}")


def check_odometry_options(odometry: Path | None, odometry_frame: str) -> str:
    """Return the frame of the odometry file; raise a `ConfigError` if only the frame is given."""
    if odometry_frame and odometry is None:
        raise ConfigError("--odometry-frame is the frame of the poses in an --odometry file: give both")
    return odometry_frame or "body"


def open_frames(
    recording: Bag, settings: Settings, warn: Callable[[str], None], odometry: Path | None, odometry_frame: str
) -> FrameReader:
    """Read the frames of a recording, with the odometry of a file if one is given; `warn` takes the faults."""
    from umf_ros.bags.frames import FrameReader
    from umf_ros.bags.trajectories import read_odometry

    path = read_odometry(odometry, odometry_frame, settings) if odometry else None
    return FrameReader(recording, settings, path, warn=warn)
