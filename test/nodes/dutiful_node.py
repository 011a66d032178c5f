"""A node for the tests of `process.run`: does one thing once it spins, and has work to finish at the end."""

from __future__ import annotations

import os
import signal
import sys

import rclpy
from rclpy.node import Node

from umf_ros.core.errors import ConfigError, OutputError
from umf_ros.nodes.process import run

FAILED: list[int] = []


def fail() -> None:
    FAILED.append(1)
    if len(FAILED) == 3:
        os.kill(os.getpid(), signal.SIGINT)
    raise ZeroDivisionError("a fault in the program")


ACTIONS = {
    "wait": lambda: None,
    "interrupt": lambda: os.kill(os.getpid(), signal.SIGINT),
    "terminate": lambda: os.kill(os.getpid(), signal.SIGTERM),
    "shutdown": rclpy.shutdown,
    "fail": fail,
    "overflow": lambda: os.kill(os.getpid(), signal.SIGINT),
}


class Dutiful(Node):
    def __init__(self, action: str) -> None:
        if action == "refuse":
            raise ConfigError("unknown parameter loop.topk")
        super().__init__("dutiful", automatically_declare_parameters_from_overrides=True)
        self._action = action
        self.create_timer(0.01, ACTIONS[action])
        print("depth", self.get_parameter_or("depth").value)

    def close(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)  # an impatient user
        print("closed while", "publishing" if rclpy.ok() else "cut off")
        if self._action == "overflow":
            raise OutputError("cannot write results: No space left on device")


class Plain(Node):
    """Nothing to finish."""

    def __init__(self) -> None:
        super().__init__("plain")
        self.create_timer(0.01, ACTIONS["interrupt"])


if __name__ == "__main__":
    _, action, *arguments = sys.argv
    code = run(Plain if action == "plain" else lambda: Dutiful(action), arguments)
    print("context", "alive" if rclpy.ok() else "shut down")
    sys.exit(code)
