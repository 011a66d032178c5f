"""Opening a recording with its settings: the same options and the same way in for every command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from umf_ros.core.errors import BagError, ConfigError, UmfError, either
from umf_ros.core.resources import dataset_names
from umf_ros.embedding import choices

if TYPE_CHECKING:
    from collections.abc import Callable

    from umf_ros.bags.frames import FrameReader
    from umf_ros.bags.reader import Bag
    from umf_ros.core.config import Settings

BagPath = Annotated[Path, typer.Argument(help="mcap file, db3 folder, or ROS 1 .bag.")]
ConfigPath = Annotated[Path | None, typer.Option("--config", help="Parameter file (YAML).")]
DatasetName = Annotated[str, typer.Option("--dataset", help=f"{either(['auto', *dataset_names()])}.")]
EmbedderName = Annotated[str | None, typer.Option("--embedder", help=f"How places are embedded: {choices()}.")]
WeightsPath = Annotated[Path | None, typer.Option("--weights", help="Weights file, or umf_light; default: umf_scene.")]
OdometryPath = Annotated[
    Path | None, typer.Option("--odometry", help="Odometry as a TUM file, where the recording has none.")
]
OdometryFrame = Annotated[
    str,
    typer.Option(
        "--odometry-frame",
        help="Whose poses --odometry holds: body (the default), imu, camera or lidar (S3LI's Eval/BASALT: imu).",
        show_default=False,
    ),
]
TruthPath = Annotated[Path | None, typer.Option("--ground-truth", help="Truth as RTKLIB .pos or TUM file.")]
RunsFolder = Annotated[Path, typer.Option("--out", help="Where results/<timestamp> goes.")]


def check_files(bag: Path, *others: Path | None) -> None:
    """Say what is not there before anything that takes time to import.

    Raises:
        BagError: there is no such recording.
        ConfigError: one of the other files is not there.
    """
    if not bag.exists():
        raise BagError(f"there is no recording {bag}")
    for path in others:
        if path is not None and not path.exists():
            raise ConfigError(f"cannot read {path}: No such file or directory")


def check_map(folder: Path | None) -> None:
    """Likewise of a map's folder, if one is asked for.

    Raises:
        UmfError: it holds no map.
    """
    if folder is not None and not (folder / "map.json").is_file():
        raise UmfError(f"{folder} holds no map: map.json is missing (umf map makes one)")


def check_run(folder: Path) -> None:
    """Likewise of a run folder.

    Raises:
        UmfError: it holds no finished run.
    """
    if not (folder / "summary.json").is_file():
        raise UmfError(f"{folder} holds no finished run: summary.json is missing")


def open_recording(
    bag: Path,
    config: Path | None = None,
    dataset: str = "auto",
    embedder: str | None = None,
    weights: Path | None = None,
    **overrides: Any,
) -> tuple[Bag, Settings]:
    """A recording, and the settings to read it with.

    Args:
        bag: the recording.
        config: parameter file.
        dataset: name of its data set, or auto.
        embedder: method, before what the file says.
        weights: file or name, likewise.
        overrides: as in `load_settings`.

    Raises:
        BagError: it cannot be opened, or its data set is not known.
        ConfigError: the file cannot be read, or a name, type or value is wrong.
    """
    check_files(bag, config)

    from umf_ros.bags.presets import settings_for
    from umf_ros.bags.reader import open_bag

    recording = open_bag(bag)
    overrides |= {"embedding__method": embedder, "embedding__weights": str(weights) if weights else None}
    return recording, settings_for(recording, config, dataset, **overrides)


def check_odometry_options(odometry: Path | None, odometry_frame: str) -> str:
    """The frame of the odometry file; without a file there is nothing it could be the frame of.

    Raises:
        ConfigError: only the frame was given.
    """
    if odometry_frame and odometry is None:
        raise ConfigError("--odometry-frame says whose poses an --odometry file holds, and there is none")
    return odometry_frame or "body"


def open_frames(
    recording: Bag, settings: Settings, warn: Callable[[str], None], odometry: Path | None, odometry_frame: str
) -> FrameReader:
    """The frames of a recording, with the odometry of a file where one is named; `warn` is told of faults.

    Raises:
        BagError: the recording or the file cannot be read as frames or odometry.
        CalibrationError: the calibration cannot be read.
    """
    from umf_ros.bags.frames import FrameReader
    from umf_ros.bags.trajectories import read_odometry

    path = read_odometry(odometry, odometry_frame, settings) if odometry else None
    return FrameReader(recording, settings, path, warn=warn)
