"""Tasks that the workers of a test can import."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from umf_ros.core.errors import UmfError

Task = tuple[Path, int]


def square(task: Task) -> None:
    folder, number = task
    (folder / f"{number}").write_text(f"{number**2}")


def square_after_a_death(task: Task) -> None:
    """The first worker that meets task 3 is killed in the middle of it."""
    folder, number = task
    if number == 3 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    square(task)


def refuse(task: Task) -> None:
    raise UmfError(f"task {task[1]} cannot be done")


def die(task: Task) -> None:
    os.kill(os.getpid(), signal.SIGKILL)
