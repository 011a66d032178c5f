"""`umf import`: a data set or a folder of files as a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from umf_ros.core.errors import BagError, ConfigError, OutputError, command_line, either

KINDS = "kitti-odometry kitti-raw euroc tum-rgbd nuscenes vslam-lab mulran helipr nclt newer-college folder".split()


def command(
    kind: Annotated[str, typer.Argument(help=f"{either(KINDS)}.")],
    source: Annotated[Path, typer.Argument(help="Folder of the sequence.")],
    out: Annotated[Path, typer.Argument(help="The .mcap file to write, with .yaml and .calibration.yaml beside it.")],
) -> None:
    """Make a recording of a data set: KITTI, EuRoC (ASL), TUM RGB-D, nuScenes, MulRan, HeLiPR, NCLT and others.

    A folder of images and scans needs a times.txt. umf replay reads most of these folders without an import.
    """
    if kind not in KINDS:
        raise ConfigError(f"unknown kind {kind!r}; expected {either(KINDS)}")
    if not source.is_dir():
        raise BagError(f"there is no folder {source}")
    if out.suffix != ".mcap":
        raise OutputError(f"cannot write {out}: the name must end in .mcap")

    from rich.console import Console
    from rich.progress import Progress

    from umf_ros.lab.imported import write_recording
    from umf_ros.lab.importing import FORMATS

    console = Console()
    found = FORMATS[kind][0](source)
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("importing", total=1.0)
        config = write_recording(found, out, lambda done: bar.update(task, completed=done))
    counts = f"{len(found.left)} left and {len(found.right)} right images, {len(found.scans)} scans"
    truth = ", with ground truth" if found.truth is not None else ""
    console.print(f"{out}: {counts}{truth}", markup=False, highlight=False, soft_wrap=True)
    for what in found.guessed:
        console.print(f"a guess that you must replace: {what}", style="yellow", markup=False)
    console.print(f"next: {command_line('replay', out, '--config', config)}", markup=False, soft_wrap=True)
