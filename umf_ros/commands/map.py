"""`umf map`: many recordings in one map."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from shutil import copytree
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from umf_ros.commands import recordings as options
from umf_ros.core.errors import ConfigError, command_line

if TYPE_CHECKING:
    from rich.console import Console

    from umf_ros.bags.reader import Bag
    from umf_ros.maps.map_folder import MapFolder
    from umf_ros.maps.mapping import Opening

Recordings = Annotated[list[Path], typer.Argument(help="Recordings, or folders of them.")]
Workers = Annotated[int, typer.Option(min=1, max=256, help="Number of processes that replay and match recordings.")]
RayAddress = Annotated[str | None, typer.Option("--ray", help="Ray cluster that has these files: address or local.")]
MapPath = Annotated[Path, typer.Option("--out", help="Folder of the map, new or one to add to.")]
OdometryFiles = Annotated[
    str | None,
    typer.Option("--odometry", metavar="FILE|ENGINE", help="TUM file, or folder of NAME.tum; vgicp: of the scans."),
]

Pair = Annotated[tuple[int, int] | None, typer.Option(metavar="MATCH QUERY", help="Closure by its keyframes' stamps.")]


class _MakeOrChange(TyperGroup):
    """`umf map RECORDINGS` makes a map; other commands are named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Name the usual command where none is named."""
        return super().parse_args(ctx, args if args and args[0] in self.commands else ["make", *args])


ALSO = (
    "umf map edit decides about closures of a map by hand, umf map grow adds a drive that localised in it, "
    "umf map export writes the map of the ground for other limits of a rover, umf map import-cloud makes a map of the "
    "cloud of another program."
)
app = typer.Typer(
    cls=_MakeOrChange,
    rich_markup_mode="rich",
    help="Make one map of many recordings, add recordings to one, edit and export it.",
)


@app.command("make", epilog=ALSO)
def command(
    recordings: Recordings,
    out: MapPath = Path("map"),
    config: options.ConfigPath = None,
    changes: options.Changes = None,
    dataset: options.DatasetName = "auto",
    embedder: options.EmbedderName = None,
    weights: options.WeightsPath = None,
    workers: Workers = 1,
    ray: RayAddress = None,
    odometry: OdometryFiles = None,
    odometry_frame: options.OdometryFrame = "",
) -> None:
    """Make one map of many recordings, or add recordings to one.

    Every recording is a session with its own odometry; closures within and between them make one pose graph.
    Recordings that are in the map already are skipped, so only new ones take time.
    A map without closures, as of a drive that never returns, is one to localise in.
    """
    chosen = options.ChosenOdometry.parse(odometry, odometry_frame)
    if odometry == "none":
        raise ConfigError("--odometry none: a map needs odometry; umf replay does without")
    options.check_files(recordings[0], config)

    from rich.console import Console

    from umf_ros.commands.console import LineProgress, telling_interrupts, waiting

    console = Console()
    with waiting(console, "Opening the recordings"):
        from umf_ros.bags.reader import open_bag
        from umf_ros.core.io import check_writable
        from umf_ros.core.tasks import spread
        from umf_ros.maps.map_folder import MapFolder
        from umf_ros.maps.mapping import Opening, find_recordings, match_session, unmatched

        parameters, engine = options.parameters(config, changes), chosen.engine if chosen.is_wanted else ""
        network = embedder, str(weights) if weights else None
        opening = Opening(parameters, dataset, *network, chosen.path, chosen.frame, engine)
        bags = [open_bag(one) for one in find_recordings(recordings)]  # before there is a folder
        for bag in bags:
            opening.check(bag)
        check_writable(out)
        target = MapFolder.open_or_create(out, opening.settings(bags[0]))
    new = _new_recordings(target, bags, console)
    with telling_interrupts(console, "the same command continues from here"):
        if ray is None and workers == 1:
            for name, recording in new.items():
                _add(target, name, recording, opening, console)
        else:
            _add_all(target, new, opening, partial(spread, workers=workers, ray=ray), console)
        for session in unmatched(target):
            with LineProgress(console, f"Matching {session.name} with the map") as progress:
                for done, _ in enumerate(match_session(target, session), 1):
                    progress.advance_to(done / session.places)
        _print_summary(out, _solve(target, console), console)


@app.command("edit")
def edit(
    map_folder: Annotated[Path, typer.Argument(help="Folder of the map.")],
    reject: Pair = None,
    accept: Pair = None,
    undo: Pair = None,
) -> None:
    """Decide about closures of a map by hand, and solve it again.

    MATCH and QUERY are stamps in nanoseconds, as in graph_verdicts.csv of the map. The decisions are kept in edits.json
    of the map until --undo leaves a closure to the evidence again.
    """
    from rich.console import Console

    from umf_ros.core.frames import State
    from umf_ros.maps.joint_graph import solve
    from umf_ros.maps.map_folder import MapFolder
    from umf_ros.maps.outputs import write_results

    decided = [pair for pair in (reject, accept, undo) if pair]
    if len(set(decided)) < len(decided):
        raise ConfigError("--reject, --accept and --undo are given for the same closure: leave one of them")
    target = MapFolder.open(map_folder)
    edits = target.edits()
    edits |= {pair: state for pair, state in ((reject, State.REJECTED), (accept, State.ACCEPTED)) if pair}
    if undo and edits.pop(undo, None) is None:
        raise ConfigError(f"--undo {undo[0]} {undo[1]}: nothing was decided about that closure by hand")
    console = Console()
    with console.status("Solving the joint graph"):
        joint = solve(target, edits)  # an edit that cannot be leaves all as it is
        target.write_edits(edits)
        summary = write_results(target, joint)
    for (match, query), state in edits.items():
        console.print(f"  {match} {query}: {state.value} by hand", markup=False, soft_wrap=True)
    _print_summary(map_folder, summary, console)


@app.command("grow")
def grow_map(
    map_folder: Annotated[Path, typer.Argument(help="Folder of the map.")],
    run: Annotated[Path, typer.Argument(help="Run folder of a drive that localised in it with localization.update.")],
) -> None:
    """Make what a rover saw while localising in a map a session of that map.

    The nodes do so themselves at ~/save and at the end; this is for a run that was killed.
    """
    from rich.console import Console

    from umf_ros.maps.mapping import grow

    console = Console()
    with console.status("Solving the joint graph"):
        session, summary = grow(map_folder, run)
    if session is None:
        console.print(f"{run}: nothing new for the map", markup=False, soft_wrap=True)
    _print_summary(map_folder, summary, console)


@app.command("export")
def export(
    map_folder: Annotated[Path, typer.Argument(help="Folder of the map.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the files; the map's by default.")] = None,
    config: options.ConfigPath = None,
    changes: options.Changes = None,
) -> None:
    """Write where a rover can drive, as map.yaml and map.pgm for Nav2's map server, and the elevation as a GeoTIFF.

    The parameters terrain.* of --config are the limits of the rover; without it, they are those of the map.
    """
    from umf_ros.core.config import load_settings
    from umf_ros.core.io import check_writable
    from umf_ros.maps.map_folder import MapFolder
    from umf_ros.maps.outputs import export_terrain

    target, folder = MapFolder.open(map_folder), out or map_folder
    settings = load_settings(options.parameters(config or target.path / "config.yaml", changes)).terrain
    check_writable(folder)
    typer.echo(f"{folder}: {export_terrain(target, settings, folder)}")


@app.command("import-cloud")
def import_cloud(
    cloud: Annotated[Path, typer.Argument(help="Cloud of a map, .pcd, .ply, .las or .laz: metres, z upwards.")],
    trajectory: Annotated[
        Path | None, typer.Option(help="TUM file: poses of the LiDAR in the cloud; else where a rover can stand.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder of the map, new or empty.")] = Path("map"),
    config: options.ConfigPath = None,
    fov: Annotated[float, typer.Option(min=20, max=360, help="Width that the LiDAR sees, deg.")] = 360.0,
    low: Annotated[float, typer.Option(min=-89, max=0, help="Elevation of its lowest beam, deg.")] = -30.0,
    high: Annotated[float, typer.Option(min=0, max=89, help="Elevation of its highest beam, deg.")] = 30.0,
    height: Annotated[float, typer.Option(min=0.1, max=10, help="Its height above the ground, m.")] = 1.2,
) -> None:
    """Make a map of a point cloud of another program, to localise in with a LiDAR alone.

    Places are views of the LiDAR rendered out of the cloud, along the trajectory in both directions, or every two
    metres in four: a tenth of a second each.
    """
    options.check_files(Path(), cloud, config, trajectory)

    from rich.console import Console

    from umf_ros.bags.trajectories import read_tum
    from umf_ros.commands.console import PLAIN, WARNING, LineProgress, telling_interrupts, waiting
    from umf_ros.core.config import load_settings
    from umf_ros.core.io import check_writable
    from umf_ros.detector import make_detector_embedder
    from umf_ros.maps import cloud as clouds
    from umf_ros.maps.map_folder import MapFolder
    from umf_ros.maps.outputs import sentence

    if out.is_dir() and any(out.iterdir()):
        raise ConfigError(f"{out} holds files already: import a cloud into a folder of its own; nothing was written")
    beside = out if out.is_dir() else out.resolve().parent  # a folder there may be a link or a volume
    check_writable(out if out.exists() else beside)
    console, settings = Console(), load_settings(config)
    lidar = clouds.VirtualLidar(fov, low, high, height_m=height)
    with waiting(console, "Reading the cloud"):
        read_points = import_module("umf_ros.lab.scan_files").read_points  # by name, as commands of the lab are
        points = clouds.thinned(read_points(cloud), cloud)
        poses = clouds.along(read_tum(trajectory)) if trajectory else clouds.standing(points, height)
        headings = (0.0, 180.0) if trajectory else (0.0, 90.0, 180.0, 270.0)
        views, embedder = clouds.CloudViews(points, poses, headings, lidar), make_detector_embedder(settings)
    told = f"{len(points)} points 10 cm apart; views from {len(poses)} positions in {len(headings)} directions"
    console.print(f"{cloud}: {told}", **PLAIN)
    with (
        telling_interrupts(console, "nothing was written"),
        LineProgress(console, "Rendering views") as progress,
        TemporaryDirectory(prefix=f".{out.name}-", dir=beside) as made,  # whole or not at all
    ):
        target = MapFolder.open_or_create(Path(made) / "map", settings)
        count = clouds.import_cloud(target, cloud, views, embedder, progress.advance_to)
        copytree(target.path, out, dirs_exist_ok=True)
    summary = _solve(MapFolder.open(out), console)
    console.print(f"{out}: {sentence(summary)}", **PLAIN)
    if missing := len(poses) * len(headings) - count:
        console.print(f"{missing} of {missing + count} views {clouds.BLIND}", **WARNING)
    if outside := sum(one["places"] for one in summary["sessions"] if not one["joined"]):
        console.print(f"{outside} places are not connected with the others: nothing is found there", **WARNING)
    _print_files(out, summary, console)
    console.print(f"next: {command_line('replay', 'BAG', '--map', out)}", **PLAIN)


def _solve(target: MapFolder, console: Console) -> dict[str, Any]:
    """Solve the graph of a map and write its results; return their summary."""
    from umf_ros.commands.console import waiting
    from umf_ros.maps.joint_graph import solve
    from umf_ros.maps.outputs import write_results

    with waiting(console, "Solving the joint graph"):
        return write_results(target, solve(target))


def _new_recordings(target: MapFolder, bags: list[Bag], console: Console) -> dict[str, Path]:
    """The recordings that are not in the map yet, by the names of their sessions to be."""
    from umf_ros.commands.console import PLAIN
    from umf_ros.runs.reader import describe_recording

    new: dict[str, Path] = {}
    described = []
    for bag in bags:
        about, recording = describe_recording(bag) | {"path": ""}, bag.path
        known = target.find(about)
        if known is not None or about in described:
            as_name = f", as {known.name}" if known else ""
            console.print(f"{recording}: in the map already{as_name}, by the settings of then", **PLAIN)
            continue
        described.append(about)
        new[target.free_name(recording, new)] = recording
    return new


def _add_all(
    target: MapFolder, new: dict[str, Path], opening: Opening, spread: Callable[..., None], console: Console
) -> None:
    """Replay all recordings in parallel, then match each with the earlier ones; the map is the same as in sequence."""
    from umf_ros.commands.console import LineProgress
    from umf_ros.maps.mapping import add_session, match_task, replay_task, unmatched

    def run(what: str, work: Callable[..., None], tasks: list[tuple[Any, ...]]) -> None:
        total = len(tasks)
        with LineProgress(console, what) as progress:
            spread(work, tasks, done=lambda n: progress.advance_to(n / total, f"{n} of {total} recordings"))

    run("Replaying", replay_task, [(recording, opening, target.folder_of(name)) for name, recording in new.items()])
    for name, recording in new.items():
        add_session(target, name, recording)
    run("Matching with the map", match_task, [(target.path, session) for session in unmatched(target)])


def _add(target: MapFolder, name: str, recording: Path, opening: Opening, console: Console) -> None:
    """Replay a recording into the map."""
    from umf_ros.commands.console import FrameProgress
    from umf_ros.maps.mapping import add_session, replay_session

    console.print(f"{recording}: session {name}", markup=False, soft_wrap=True)
    with FrameProgress(console) as progress:
        replay_session(recording, opening, target.folder_of(name), progress.show)
    add_session(target, name, recording)


def _print_summary(out: Path, summary: dict[str, Any], console: Console) -> None:
    from umf_ros.commands.console import WARNING
    from umf_ros.maps.outputs import crispness, sentence

    for one in summary["sessions"]:
        told = f"joined by {one['closures_between']} ends of closures with others"
        told = told if one["joined"] and one["closures_between"] else "no accepted closure with others yet"
        size = f"{one['places']} places, {one['length_m']:.0f} m"
        told = f"; {told}" if len(summary["sessions"]) > 1 else ""
        console.print(f"  {one['name']}: {size}{told}", markup=False, soft_wrap=True)
        for finding in one.get("findings", []):
            console.print(f"    {finding}", **WARNING)
    for line in filter(None, (f"{out}: {sentence(summary)}", crispness(summary))):
        console.print(line, markup=False, soft_wrap=True)
    _print_files(out, summary, console)


def _print_files(out: Path, summary: dict[str, Any], console: Console) -> None:
    files = [f"{out}: {summary['ground']}"] if summary.get("ground") else []
    for line in (*files, f"{out / 'report.html'}"):
        console.print(line, markup=False, soft_wrap=True)
