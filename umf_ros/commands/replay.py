"""`umf replay`: offline loop detection on a recording."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from umf_ros.commands import recordings as options

if TYPE_CHECKING:
    from rich.console import Console

    from umf_ros.core.config import Settings
    from umf_ros.localizer import Localization

MinProbability = Annotated[float | None, typer.Option(min=0, max=1, help="Minimum probability of a published closure.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue the newest interrupted replay in --out.")]
RerunPath = Annotated[Path | None, typer.Option("--rerun", help="Also log the run for the Rerun viewer: an .rrd file.")]
Viewer = Annotated[bool, typer.Option("--viewer", help="Show the run in the Rerun viewer while it runs.")]
Mode = Annotated[str | None, typer.Option("--mode", help="mapping, or localization in the map that --map names.")]
MapPath = Annotated[Path | None, typer.Option("--map", help="Map to localise in; implies --mode localization.")]


def command(
    bag: options.BagPath,
    config: options.ConfigPath = None,
    changes: options.Changes = None,
    out: options.RunsFolder = Path("results"),
    dataset: options.DatasetName = "auto",
    embedder: options.EmbedderName = None,
    weights: options.WeightsPath = None,
    odometry: options.OdometryChoice = None,
    odometry_frame: options.OdometryFrame = "",
    ground_truth: options.TruthPath = None,
    min_probability: MinProbability = None,
    resume: Resume = False,
    rerun: RerunPath = None,
    live: Viewer = False,
    mode: Mode = None,
    map_folder: MapPath = None,
) -> None:
    """Find loop closures in a recording as fast as the machine goes.

    Needs no ROS. Writes closures, trajectories, the pose graph and a report to a new folder.
    Ctrl-C ends the run early and keeps its results, with exit status 130; --resume continues it, also after a crash.
    Exit status 3: the inputs could not give any result.
    """
    options.refuse_unused("a mapping run", {"--map": mode == "mapping" and map_folder})
    options.refuse_unused("a run in the viewer", {"--rerun": live and rerun})
    chosen = options.ChosenOdometry.parse(odometry, odometry_frame)
    options.check_files(bag, config, ground_truth)
    options.check_map(map_folder)

    from rich.console import Console

    from umf_ros.commands.console import WARNING, FrameProgress, stop_on_interrupt, undisturbed, waiting

    console = Console()
    with waiting(console, "Opening the recording"):
        recording, settings = options.open_recording(
            bag,
            options.parameters(config, changes),
            dataset,
            embedder,
            weights,
            verification__min_probability=min_probability,
            mode=mode or ("localization" if map_folder else None),
            map=str(map_folder) if map_folder else None,
        )
        from umf_ros.detector import LoopDetector, make_detector_embedder

        # the network is compiled while the rest is imported
        starting = ThreadPoolExecutor(1, "start").submit(make_detector_embedder, settings)
        from umf_ros.bags.frames import FrameReader
        from umf_ros.bags.inputs import absent_inputs, input_counts
        from umf_ros.bags.trajectories import read_ground_truth
        from umf_ros.core.io import check_folder, create_run_folder
        from umf_ros.core.resources import MADE_ODOMETRY
        from umf_ros.core.watchdog import watching
        from umf_ros.replay import Replay
        from umf_ros.runs.reader import read_run, remember_recording
        from umf_ros.runs.rerun_log import RerunLog
        from umf_ros.runs.run_file import read_odometry_of
        from umf_ros.runs.writer import begin_folder, count_drops, finish_folder, with_places

        check_folder(out)
    _tell_inputs(console, settings)
    warnings: list[str] = []
    warn = partial(_warn, console, warnings)
    if settings.localizing:
        options.refuse_unused("a localising run", {"--rerun": rerun, "--viewer": live, "--resume": resume})
    truth = read_ground_truth(None, ground_truth)
    unfinished = _unfinished(out, bag, settings, warn) if resume else None
    path = chosen.read(console, recording, settings, unfinished and unfinished / MADE_ODOMETRY, warn)
    with waiting(console, "Loading the network"):
        reader = FrameReader(recording, settings, path, warn=warn)
        network = starting.result()
        viewer = RerunLog(rerun, settings.terrain) if rerun or live else None
        # a store or a map that cannot be used is reported before there is a folder
        known = settings.database.path or (settings.localizing and not settings.grows_map)
        detector = LoopDetector(settings, network) if known else None
        folder = unfinished or begin_folder(create_run_folder(out), bag)
        known_odometry = chosen.keep(folder, path)
        detector = detector or LoopDetector(with_places(settings, folder), network)
    del network, starting  # only the detector keeps the network, until it is closed: the report needs the memory
    absent = [one.line for one in absent_inputs(recording, settings, path is not None)]
    for line in absent:
        console.print(line, **WARNING)
    replay = Replay(folder, settings, detector, unfinished is not None)
    with stop_on_interrupt() as interrupted, FrameProgress(console, replay.graph_counts) as progress, watching():
        stream = reader.stream()
        for detection in replay.run(viewer.watch(stream) if viewer else stream):
            progress.show(reader.progress, detection)
            if viewer:
                viewer.show(detection)
            if interrupted():
                break
    if interrupted() and not settings.localizing:
        console.print("[yellow]Interrupted: the results cover the recording so far; --resume continues from here.")
    newest = replay.newest_pose
    with undisturbed():
        replay.finish(count_drops(reader.counters))
        if not interrupted() or settings.localizing:
            _grow(console, settings, folder)
            finish_folder(folder)
        if viewer:
            viewer.finish(folder)
        sensors = detector.sensors.report(read_odometry_of(folder))
        facts = {"inputs": input_counts(reader.counters), "sensors": sensors.as_json(), "odometry_file": known_odometry}
        remember_recording(folder, recording, warnings=warnings, interrupted=bool(interrupted()), **facts)
        if settings.localizing:
            status = _report_localization(console, folder, replay.counts, newest)
        else:
            from umf_ros.runs.report import finish_run

            truth = truth or (read_ground_truth(recording) if interrupted() else reader.ground_truth)
            run = read_run(folder, recording, truth)
            status = finish_run(run, recording, console, sensors, frozenset(warnings + absent)).exit_code
    replay.raise_if_frames_failed()
    raise typer.Exit(128 + interrupted() if interrupted() else status)


def _unfinished(out: Path, bag: Path, settings: Settings, warn: Callable[[str], None]) -> Path | None:
    """Return the folder of the replay that --resume continues; warn where there is none."""
    from umf_ros.runs.writer import unfinished_folder

    if (found := unfinished_folder(out, bag, settings)) is None:
        warn(f"nothing to resume: {out} holds no interrupted replay of {bag}")
    return found


def _tell_inputs(console: Console, settings: Settings) -> None:
    """Print which inputs were found where no parameter and no data set names them."""
    from umf_ros.commands.console import PLAIN
    from umf_ros.core.config import TRANSFORMS
    from umf_ros.sensors.topic_finder import describe_inputs

    if settings.calibration == TRANSFORMS:
        console.print(describe_inputs(settings), **PLAIN)


def _grow(console: Console, settings: Settings, folder: Path) -> None:
    """Make what was seen while localising a session of the map, where that is asked for."""
    if not settings.grows_map:
        return
    from umf_ros.maps.mapping import grow
    from umf_ros.maps.outputs import sentence

    session, summary = grow(Path(settings.map), folder)
    told = "nothing new for the map" if session is None else f"session {session.name}: {sentence(summary)}"
    console.print(f"{settings.map}: {told}", markup=False, highlight=False, soft_wrap=True)


def _warn(console: Console, warnings: list[str], text: str) -> None:
    """Print a warning once, and keep it for the summary."""
    from umf_ros.commands.console import WARNING

    if text not in warnings:
        warnings.append(text)
        console.print(text, **WARNING)


def _report_localization(console: Console, folder: Path, counts: dict[str, Any], newest: Localization | None) -> int:
    """Print the result of a localising run; return 3 if the rover was not localised."""
    text = "not localised in the map"
    if counts["located"]:
        text = "localised after {keyframes_until_found} keyframes, pose known at {located} of {keyframes}"
        text = text.format_map(counts)
    if newest is not None:
        x, y, z = newest.map_T_body[:3, 3]
        sigma_m = float(newest.covariance[:2, :2].trace() ** 0.5)
        text += f"; last pose ({x:.1f}, {y:.1f}, {z:.1f}) m, +- {sigma_m:.2f} m, p = {newest.probability:.4f}"
    console.print(f"{text}\n{folder}", markup=False, highlight=False, soft_wrap=True)
    return 0 if counts["located"] else 3
