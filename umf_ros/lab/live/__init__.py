"""The live graph on a recording: a player in place of the sensors, and the processes of a demo."""

from __future__ import annotations

from umf_ros.nodes.start import start


def bag_player_node() -> None:
    """Entry point of `ros2 run umf_ros bag_player_node`."""
    start("umf_ros.lab.live.bag_player_node")
