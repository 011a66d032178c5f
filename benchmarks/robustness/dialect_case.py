"""One case of `dialects.py`: an input as another program writes it, a command, and its right result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from umf_ros.lab.program import Ended

Check = Callable[[Ended, Path], tuple[bool, str]]
"""From a command that has ended and its folder: whether the result is right, and the figure or line that decides."""


class Case(NamedTuple):
    """An input, the command that reads it, and what is right.

    Attributes:
        name: number of the kind and name of the variant, such as "09 odometry_twice".
        make: writes the input into an empty folder.
        command: arguments of `umf`, run in this folder.
        expected: the right result in words.
        check: decides.
    """

    name: str
    make: Callable[[Path], object]
    command: tuple[str, ...]
    expected: str
    check: Check


def last_line(ended: Ended) -> str:
    """The last line of the output."""
    return ended.lines[-1][:100] if ended.lines else "no output"


def line_with(ended: Ended, text: str) -> str:
    """The first line that holds a text; empty without one."""
    return next((line[:100] for line in ended.lines if text in line), "")
