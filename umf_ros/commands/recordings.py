"""Options of the commands that read a recording, and functions that open it.

A file that is missing raises a `BagError`, a `ConfigError` or an `UmfError` before anything that takes time to import.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from umf_ros.core.errors import BagError, ConfigError, UmfError, command_line, either
from umf_ros.core.resources import MADE_ODOMETRY, dataset_names
from umf_ros.core.resources import ODOMETRY_ENGINES as ENGINES
from umf_ros.embedding import choices

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rich.console import Console

    from umf_ros.bags.reader import Bag
    from umf_ros.core.config import Parameters, ParameterSource, Settings
    from umf_ros.core.trajectory import Trajectory

BagPath = Annotated[Path, typer.Argument(help="mcap file, db3 folder, ROS 1 .bag, or folder of a data set.")]
ConfigPath = Annotated[Path | None, typer.Option("--config", help="Parameter file (YAML).")]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Set a parameter, as loop.top_k=40; may be given repeatedly."),
]
DatasetName = Annotated[str, typer.Option("--dataset", help=f"{either(['auto', *dataset_names()])}.")]
EmbedderName = Annotated[str | None, typer.Option("--embedder", help=f"Embedding method: {choices()}.")]
WeightsPath = Annotated[Path | None, typer.Option("--weights", help="Weights file; default: umf_scene.")]
OdometryChoice = Annotated[
    str | None,
    typer.Option("--odometry", metavar="FILE|ENGINE", help="TUM file; vgicp: of the scans, the default without; none."),
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


def check_run(folder: Path) -> None:
    """Check that a folder holds a run, which may have been killed; else the error names what may be meant."""
    if not folder.exists():
        raise UmfError(f"there is no run {folder}")
    runs = folder / "latest", *sorted(folder.glob("sessions/*"))
    if meant := [str(run) for run in runs if (run / "run.sqlite").is_file()]:
        raise UmfError(f"{folder} holds runs and is none; did you mean {either(meant)}?")
    if folder.is_file() or (folder / "metadata.yaml").is_file():
        raise UmfError(f"{folder} is no run folder; of a recording, {command_line('replay', folder)} makes one")
    if not any((folder / name).is_file() for name in ("summary.json", "run.sqlite")):
        raise UmfError(f"{folder} holds no finished run: summary.json is missing")


def check_mapping(folder: Path) -> None:
    """Check that a run did not localise in a map, where it has no closures between places of its own."""
    from umf_ros.core.config import load_settings

    if (settings := load_settings(folder / "config.yaml")).localizing:
        found = "its poses are in trajectory_in_map.tum and localization.csv"
        raise UmfError(f"{folder} localised in {settings.map}: {found}, and it has no closures of its own places")


def parameters(config: Path | None, changes: list[str] | None) -> Parameters:
    """Return the parameters of `--config` and `--set`."""
    from umf_ros.core.config import Parameters, parse_changes

    return Parameters(config, parse_changes(changes or ()))


def check_map(folder: Path | None) -> None:
    """Check that a folder, if one is given, holds a map."""
    if folder is not None and not (folder / "map.json").is_file():
        raise UmfError(f"{folder} is not a map: map.json is missing; make one with umf map")


def open_recording(
    bag: Path,
    config: ParameterSource = None,
    dataset: str = "auto",
    embedder: str | None = None,
    weights: Path | None = None,
    **overrides: Any,
) -> tuple[Bag, Settings]:
    """Open a recording, and load the settings to read it with; `overrides` are those of `load_settings`."""
    check_files(bag)

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


@dataclass(frozen=True, slots=True)
class ChosenOdometry:
    """Odometry of a replay by its `--odometry`.

    Attributes:
        path: TUM file of its poses; None for an engine.
        frame: of the poses in the file.
        engine: that is to be run on the scans; empty where a file or none is wanted.
        is_wanted: whether the user named the engine, which is else used where the recording has no odometry.
    """

    path: Path | None
    frame: str
    engine: str = ""
    is_wanted: bool = False

    @classmethod
    def parse(cls, choice: str | None, frame: str) -> ChosenOdometry:
        """Return the choice of `--odometry` and `--odometry-frame`; raise a `ConfigError` if they do not fit."""
        path = Path(choice) if choice and Path(choice).exists() else None
        if choice is not None and path is None and choice not in (names := (*ENGINES, "none")):
            raise ConfigError(f"--odometry {choice}: there is no such file, and no engine but {either(names)}")
        engine = "" if path or choice == "none" else choice or ENGINES[0]
        return cls(path, check_odometry_options(path, frame), engine, choice is not None)

    def read(
        self, console: Console, recording: Bag, settings: Settings, made: Path | None, warn: Callable[[str], None]
    ) -> Trajectory | None:
        """Return the odometry of the file, or of the scans where that is wanted or the recording has none, else None.

        `made` is the file of an earlier run of the engine on this recording, where there is one; `warn` takes the
        reason why the default engine fails.

        Raises:
            BagError: the file cannot be read, or an engine fails that the user named or that is needed to localise.
        """
        from umf_ros.bags.inputs import present_topics
        from umf_ros.bags.scan_odometry import can_track, odometry_of_scans
        from umf_ros.bags.trajectories import read_odometry
        from umf_ros.commands.console import PLAIN, LineProgress
        from umf_ros.core.config import topics_of

        if self.path is not None:
            return read_odometry(self.path, self.frame, settings)
        if not self.engine or not (self.is_wanted or can_track(recording, settings)):
            if settings.localizing and not present_topics(recording, settings).odometry:
                raise ConfigError("a rover without odometry cannot be localised: give --odometry FILE.tum")
            return None
        console.print(f"odometry: {self.engine} on the scans of {topics_of(settings).cloud}", **PLAIN)
        try:
            with LineProgress(console, "Odometry of the scans") as progress:
                return odometry_of_scans(recording, settings, self.engine, made, progress.advance_to)
        except BagError as error:
            if self.is_wanted or settings.localizing:
                raise
            warn(f"no odometry: {error}")
            return None

    def keep(self, folder: Path, made: Trajectory | None) -> dict[str, str] | None:
        """Write poses `made` by an engine to a run folder; return the entry `odometry_file` of its summary."""
        from umf_ros.core.trajectory import write_tum

        if self.path is not None:
            return {"path": str(self.path.resolve()), "frame": self.frame}
        if made is None:
            return None
        path = (folder / MADE_ODOMETRY).resolve()
        write_tum(path, made)
        return {"path": str(path), "frame": "body", "engine": self.engine}


def show_parameters(
    config: ConfigPath = None,
    changes: Changes = None,
    bag: Annotated[Path | None, typer.Argument(metavar="[BAG]", help="Recording that decides the topics.")] = None,
) -> None:
    """Print the effective parameters: defaults, those of --config and of --set; for a recording with its topics.

    The output is a parameter file.
    """
    from umf_ros.core.config import dump_settings, load_settings

    given = parameters(config, changes)
    settings = load_settings(given) if bag is None else open_recording(bag, given)[1]
    typer.echo(dump_settings(settings), nl=False)
