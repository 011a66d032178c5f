"""`umf map`: many recordings in one map."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from umf_ros.commands.recordings import (
    ConfigPath,
    DatasetName,
    EmbedderName,
    OdometryFrame,
    WeightsPath,
    check_files,
    check_odometry_options,
)

if TYPE_CHECKING:
    from rich.console import Console

    from umf_ros.maps.map_folder import MapFolder
    from umf_ros.maps.mapping import Opening

Recordings = Annotated[list[Path], typer.Argument(help="Recordings, or folders of them.")]
Workers = Annotated[int, typer.Option(min=1, max=256, help="Processes that replay and compare recordings.")]
RayAddress = Annotated[
    str | None, typer.Option("--ray", help="Spread them by Ray: address of a cluster that sees these files, or local.")
]
MapPath = Annotated[Path, typer.Option("--out", help="Folder of the map, new or one to add to.")]
OdometryFolder = Annotated[
    Path | None,
    typer.Option("--odometry", help="Folder of TUM files named like the recordings, where these have no odometry."),
]


def command(
    recordings: Recordings,
    out: MapPath = Path("map"),
    config: ConfigPath = None,
    dataset: DatasetName = "auto",
    embedder: EmbedderName = None,
    weights: WeightsPath = None,
    workers: Workers = 1,
    ray: RayAddress = None,
    odometry: OdometryFolder = None,
    odometry_frame: OdometryFrame = "",
) -> None:
    """Make one map of many recordings, or add recordings to one.

    Every recording is a session with its own odometry; closures within and between them make one pose graph.
    Recordings that the map has already are passed over, so that a new one costs itself alone.
    """
    check_files(recordings[0], config, odometry)
    odometry_frame = check_odometry_options(odometry, odometry_frame)

    from rich.console import Console

    from umf_ros.core.io import check_writable
    from umf_ros.core.tasks import spread
    from umf_ros.maps.joint_graph import solve
    from umf_ros.maps.mapping import Opening, find_recordings, unmatched
    from umf_ros.maps.outputs import write_results

    console = Console()
    check_writable(out)
    opening = Opening(config, dataset, embedder, str(weights) if weights else None, odometry, odometry_frame)
    found = find_recordings(recordings)
    target = _open(out, opening, found[0])
    if ray is None and workers == 1:
        for recording in found:
            _add(target, recording, opening, console)
    else:
        _add_all(target, found, opening, partial(spread, workers=workers, ray=ray), console)
    for session in unmatched(target):
        _match(target, session.name, console)
    with console.status("Solving the joint graph"):
        summary = write_results(target, solve(target))
    _tell(out, summary, console)


def _open(out: Path, opening: Opening, first: Path) -> MapFolder:
    from umf_ros.bags.reader import open_bag
    from umf_ros.maps.map_folder import MapFolder

    return MapFolder.open_or_create(out, opening.settings(open_bag(first)))


def _add_all(
    target: MapFolder, recordings: list[Path], opening: Opening, spread: Callable[..., None], console: Console
) -> None:
    """Replay all recordings at once, then compare all with those before them; the same map as one after the other."""
    from umf_ros.maps.mapping import add_session, match_task, replay_task, unmatched

    new = _new_ones(target, recordings, console)
    tasks = [(recording, opening, target.folder_of(name)) for name, recording in new.items()]
    _with_bar(console, "Replaying", len(tasks), lambda done: spread(replay_task, tasks, done=done))
    for name, recording in new.items():
        add_session(target, name, recording)
    names = [(target.path, session.name) for session in unmatched(target)]
    _with_bar(console, "Comparing with the map", len(names), lambda done: spread(match_task, names, done=done))


def _new_ones(target: MapFolder, recordings: list[Path], console: Console) -> dict[str, Path]:
    """The recordings that are not in the map yet, by the names of their sessions to be."""
    from umf_ros.bags.reader import open_bag
    from umf_ros.runs.reader import describe_recording

    new: dict[str, Path] = {}
    described = []
    for recording in recordings:
        about = describe_recording(open_bag(recording)) | {"path": ""}
        if target.knows(about) is not None or about in described:
            console.print(f"{recording}: in the map already", markup=False, soft_wrap=True)
            continue
        described.append(about)
        new[target.free_name(recording, new)] = recording
    return new


def _with_bar(console: Console, what: str, total: int, run: Callable[[Callable[[int], None]], None]) -> None:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("recordings")
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(what, total=total)
        run(lambda done: progress.update(task, completed=done))


def _add(target: MapFolder, recording: Path, opening: Opening, console: Console) -> None:
    """Replay a recording into the map, unless it is there."""
    from umf_ros.bags.reader import open_bag
    from umf_ros.commands.console import FrameProgress
    from umf_ros.maps.mapping import add_session, replay_session
    from umf_ros.runs.reader import describe_recording

    known = target.knows(describe_recording(open_bag(recording)))
    if known is not None:
        console.print(f"{recording}: in the map already, as {known.name}", markup=False, soft_wrap=True)
        return
    name = target.free_name(recording)
    console.print(f"{recording}: session {name}", markup=False, soft_wrap=True)
    with FrameProgress(console) as progress:
        replay_session(recording, opening, target.folder_of(name), progress.show)
    add_session(target, name, recording)
    _match(target, name, console)


def _match(target: MapFolder, name: str, console: Console) -> None:
    """Compare a session with those before it."""
    from rich.progress import track

    from umf_ros.maps.mapping import match_session

    session = next(one for one in target.sessions if one.name == name)
    matches = match_session(target, session)
    for _ in track(matches, f"Comparing {name} with the map", session.places, console=console, transient=True):
        pass


def _tell(out: Path, summary: dict[str, Any], console: Console) -> None:
    from umf_ros.maps.outputs import crispness, sentence

    for one in summary["sessions"]:
        tied = f"{one['closures_between']} ends of closures with others"
        joined = f"joined by {tied}" if one["joined"] else "not joined: nothing ties it to the map yet"
        way = f"{one['places']} places, {one['length_m']:.0f} m" + ("" if one["odometry"] else ", no odometry")
        console.print(f"  {one['name']}: {way}; {joined}", markup=False, soft_wrap=True)
    console.print(f"{out}: {sentence(summary)}", markup=False, soft_wrap=True)
    if told := crispness(summary):
        console.print(told)
    console.print(f"{out / 'report.html'}", markup=False, soft_wrap=True)
