"""`umf replay`: offline loop detection on a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from umf_ros.embedding import CHOICES

Optional = typer.Option


def command(
    bag: Annotated[Path, typer.Argument(help="mcap file, db3 folder, or ROS 1 .bag.")],
    config: Annotated[Path | None, Optional(help="Parameter file (YAML).")] = None,
    out: Annotated[Path, Optional(help="Where results/<timestamp> goes.")] = Path("results"),
    dataset: Annotated[str, Optional(help="auto, simulated, s3li-etna or s3li-vulcano.")] = "auto",
    embedder: Annotated[str | None, Optional(help=f"How places are embedded: {CHOICES}.")] = None,
    weights: Annotated[Path | None, Optional(help="Weights file, or umf_resnet50; default: umf_light.")] = None,
    odometry: Annotated[Path | None, Optional(help="Odometry as a TUM file, where the bag has none.")] = None,
    odometry_frame: Annotated[
        str, Optional(help="Whose poses --odometry holds: body, imu, camera or lidar (S3LI's Eval/BASALT: imu).")
    ] = "body",
    ground_truth: Annotated[Path | None, Optional(help="Truth as RTKLIB .pos or TUM file.")] = None,
    min_probability: Annotated[float | None, Optional(min=0, max=1, help="Publish closures from here on.")] = None,
) -> None:
    """Find loop closures in a recording as fast as the machine goes.

    Needs no ROS. Writes closures, trajectories, the pose graph and a report to a new folder.
    Ctrl-C ends the run early and keeps what was found.
    """
    from rich.console import Console

    from umf_ros.bags.frames import FrameReader
    from umf_ros.bags.presets import settings_for
    from umf_ros.bags.reader import open_bag
    from umf_ros.bags.trajectories import read_ground_truth, read_odometry
    from umf_ros.commands.progress import WARNING, FrameProgress, stop_on_interrupt, undisturbed
    from umf_ros.loop_detector import LoopDetector, make_detector_embedder
    from umf_ros.replay import Replay
    from umf_ros.runs.folder import create_run_folder
    from umf_ros.runs.recorder import count_drops
    from umf_ros.runs.report import finish_run

    console = Console()
    recording = open_bag(bag)
    settings = settings_for(
        recording,
        config,
        dataset,
        embedding__method=embedder,
        embedding__weights=str(weights) if weights else None,
        verification__min_probability=min_probability,
    )
    path = read_odometry(odometry, odometry_frame, settings) if odometry else None
    reader = FrameReader(recording, settings, path, warn=lambda text: console.print(text, **WARNING))
    if ground_truth is not None:
        read_ground_truth(recording, ground_truth)  # what is wrong with it is said now, not after the run
    detector = LoopDetector(settings, make_detector_embedder(settings))
    folder = create_run_folder(out)
    replay = Replay(folder, settings, detector)
    with stop_on_interrupt() as interrupted, FrameProgress(console) as progress:
        for detection in replay.run(reader.stream()):
            progress.show(reader.progress, detection)
            if interrupted():
                break
    if interrupted():
        console.print("[yellow]Interrupted: the results cover what was done so far.")
    with undisturbed():
        if not replay.finish(count_drops(reader.counters)):
            console.print("No odometry: closures only, the pose graph is skipped (--odometry FILE.tum supplies it).")
        finish_run(folder, recording, console, ground_truth)
