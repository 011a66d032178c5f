"""`umf play`: a recording on the live topics."""

from __future__ import annotations

from typing import Annotated

import typer

from umf_ros.commands.recordings import BagPath, check_files
from umf_ros.core.errors import UmfError


def command(
    bag: BagPath,
    rate: Annotated[float, typer.Option(min=0.01, max=100, help="Speed; 1 is that of the recording.")] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end, until Ctrl-C.")] = False,
    wait_for_subscribers: Annotated[
        bool, typer.Option("--wait-for-subscribers", help="Start when images and scans are wanted.")
    ] = False,
) -> None:
    """Publish a recording on its topics, with /clock, at its own pace."""
    check_files(bag)

    import importlib.util
    import os
    import sys

    if importlib.util.find_spec("rclpy") is None:
        raise UmfError("playing needs ROS 2 (rclpy is not installed); umf doctor says what helps")
    arguments = [str(bag), "--rate", str(rate), *["--loop"] * loop, *["--wait-for-subscribers"] * wait_for_subscribers]
    # the player takes the place of this process: signals and the exit status are its own
    os.execv(sys.executable, [sys.executable, "-m", "umf_ros.lab.live.bag_player_node", *arguments])
