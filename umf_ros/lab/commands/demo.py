"""`umf demo` and `umf play`: play a recording on the live topics, with or without the nodes."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated

import typer

from umf_ros.commands.recordings import BagPath, check_files, refuse_unused
from umf_ros.core.errors import UmfError


def command(
    seed: Annotated[int, typer.Option(min=0, help="Seed of world and traverse.")] = 1,
    out: Annotated[Path, typer.Option(help="Parent folder of results/<timestamp>.")] = Path("results"),
    bag: Annotated[Path | None, typer.Option(help="Play this recording instead of simulating one.")] = None,
    rate: Annotated[float, typer.Option(min=0.1, max=10, help="Speed of the player.")] = 1.0,
    duration: Annotated[
        float | None, typer.Option(min=10, help="Seconds to simulate; default: the whole traverse.")
    ] = None,
) -> None:
    """Simulate a short traverse, play it to the live nodes over DDS, and write a report.

    Bag player, loop_closure_node and pose_graph_node run as separate processes, as next to a rover. Ctrl-C ends them
    early and keeps the results, with exit status 130. Exit status 3: the inputs could not give any result.
    """
    if bag is not None:
        refuse_unused("a recording", {"--seed": seed != 1, "--duration": duration is not None})

    from rich.console import Console

    from umf_ros.bags.reader import open_bag
    from umf_ros.commands.console import undisturbed
    from umf_ros.core.io import check_writable, create_run_folder
    from umf_ros.lab.commands import simulate
    from umf_ros.lab.commands.report import report_run
    from umf_ros.lab.live.live_graph import LiveGraph
    from umf_ros.runs.reader import remember_recording

    console = Console()
    check_writable(out)
    if bag is None:
        bag = Path("data") / f"demo_seed{seed}.mcap"
        simulate.write_drive(bag, console, "demo", (seed, None), duration)
    recording = open_bag(bag)
    folder = create_run_folder(out)
    with LiveGraph(folder, console) as graph:
        graph.play(bag, recording.duration_s, rate)
    with undisturbed():
        remember_recording(folder, recording, interrupted=graph.interrupted)
        status = report_run(folder, recording, console).exit_code
    raise typer.Exit(128 + signal.SIGINT if graph.interrupted else status)


def play(
    bag: BagPath,
    rate: Annotated[float, typer.Option(min=0.01, max=100, help="Speed as a multiple of the recording's.")] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end, until Ctrl-C.")] = False,
    wait_for_subscribers: Annotated[
        bool, typer.Option("--wait-for-subscribers", help="Start when images and scans have subscribers.")
    ] = False,
) -> None:
    """Publish a recording on its topics, with /clock, at its own speed."""
    check_files(bag)

    import importlib.util
    import os
    import sys

    if importlib.util.find_spec("rclpy") is None:
        raise UmfError("playing needs ROS 2 (rclpy is not installed); run umf doctor for a remedy")
    arguments = [str(bag), "--rate", str(rate), *["--loop"] * loop, *["--wait-for-subscribers"] * wait_for_subscribers]
    # the player takes the place of this process: signals and the exit status are its own
    os.execv(sys.executable, [sys.executable, "-m", "umf_ros.lab.live.bag_player_node", *arguments])
