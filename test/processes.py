"""Nodes as processes, for tests over real DDS."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

# real DDS, on this machine alone and in a domain of its own
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
ENVIRONMENT = {
    **os.environ,
    "RCUTILS_LOGGING_USE_STDOUT": "1",
    "RCUTILS_CONSOLE_OUTPUT_FORMAT": "{message}",
    "RCUTILS_LOGGING_BUFFERED_STREAM": "0",
    "PYTHONUNBUFFERED": "1",
    "OMP_NUM_THREADS": "1",
}


class Process:
    """A node that runs while a test does."""

    started: ClassVar[list[Process]] = []

    def __init__(self, module: str, log: Path, *parameters: str, command: list[str] | None = None) -> None:
        flags = [("-r" if parameter.startswith("__") else "-p", parameter) for parameter in parameters]
        arguments = ["--ros-args", *(word for flag in flags for word in flag)]
        self._log = log
        self._file = log.open("w", encoding="utf-8")
        self._process = subprocess.Popen(
            [*(command or [sys.executable, "-m", module]), *(arguments if parameters else [])],
            stdout=self._file,
            stderr=subprocess.STDOUT,
            env=ENVIRONMENT,
        )
        Process.started.append(self)

    @property
    def output(self) -> str:
        lines = self._log.read_text().splitlines(keepends=True)
        return "".join(line for line in lines if "[RTPS_" not in line)  # of ports that killed processes left

    @property
    def exit_code(self) -> int | None:
        return self._process.poll()

    @property
    def child(self) -> int:
        """Process that this one started."""
        (number,) = (
            Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text(encoding="utf-8").split()
        )
        return int(number)

    def wait_for(self, text: str, timeout_s: float = 90.0) -> None:
        wait_until(lambda: text in self.output or self.exit_code is not None, timeout_s)
        assert text in self.output, f"'{text}' not in:\n{self.output}"

    @contextmanager
    def no_file_longer_than(self, size: int) -> Iterator[None]:
        """The node as on a disk that is full: where it writes more, it gets an error."""
        limits = resource.prlimit(self._process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(self._process.pid, resource.RLIMIT_FSIZE, (size, limits[1]))
        try:
            yield
        finally:
            resource.prlimit(self._process.pid, resource.RLIMIT_FSIZE, limits)

    def send(self, number: int) -> None:
        self._process.send_signal(number)

    def interrupt(self, timeout_s: float = 60.0) -> int:
        if self.exit_code is None:
            self._process.send_signal(signal.SIGINT)
        return self._process.wait(timeout_s)

    def kill(self) -> None:
        if self.exit_code is None:
            self._process.kill()
        self._process.wait()
        self._file.close()


def call_service(node: Any, kind: type, service: str, request: object) -> Any:
    """Call a service of another process and return its response.

    DDS drops the reply of a server that has not discovered the client yet, so an unanswered request is sent again.
    """
    import rclpy

    client = node.create_client(kind, service)
    assert client.wait_for_service(60.0), service
    for _ in range(6):
        future = client.call_async(request)
        if wait_until(future.done, 15.0, spin=lambda: rclpy.spin_once(node, timeout_sec=0.05)):
            return future.result()
    raise AssertionError(f"{service} never answers")


def wait_until(condition: Callable[[], bool], timeout_s: float = 30, spin: Callable[[], object] | None = None) -> bool:
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        spin() if spin else time.sleep(0.05)
    return True
