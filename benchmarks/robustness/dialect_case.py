"""One case of `dialects.py`: an input as another program writes it, a command, and its right result."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

UMF = (sys.executable, "-m", "umf_ros.cli")
LIMIT_S = 1200.0
SEED, SECONDS = 27001, 46
"""Of the drive that most cases change."""


class Outcome(NamedTuple):
    """Result of a command: its exit status, its console output without empty lines, and its folder."""

    status: int
    said: str
    folder: Path

    @property
    def lines(self) -> list[str]:
        """The lines of the output."""
        return [line.strip() for line in self.said.splitlines() if line.strip()]

    @property
    def in_short(self) -> str:
        """The last line of the output."""
        return self.lines[-1][:100] if self.lines else "no output"


Check = Callable[[Outcome], tuple[bool, str]]
"""Returns whether the outcome is right, and the figure or line that decides."""


@dataclass(frozen=True)
class Case:
    """An input, the command that reads it, and what is right.

    Attributes:
        name: number of the kind and name of the variant, such as "09 odometry_twice".
        make: writes the input into an empty folder.
        command: arguments of `umf`, run in this folder; or a function of the folder in place of a command.
        expected: the right result in words.
        check: decides.
    """

    name: str
    make: Callable[[Path], object]
    command: tuple[str, ...] | Callable[[Path], str]
    expected: str
    check: Check

    def run(self, folder: Path) -> tuple[bool, str]:
        """Make the input and run the command in a folder; return whether the result is right, and the result."""
        folder.mkdir(parents=True, exist_ok=True)
        self.make(folder)
        if callable(self.command):
            return self.check(Outcome(0, self.command(folder), folder))
        ended = subprocess.run([*UMF, *self.command], cwd=folder, capture_output=True, text=True, timeout=LIMIT_S)
        return self.check(Outcome(ended.returncode, ended.stdout + ended.stderr, folder))


def says(text: str, status: int | None = None) -> Check:
    """Return a check that one line holds a text, and of the exit status."""

    def check(outcome: Outcome) -> tuple[bool, str]:
        found = next((line for line in outcome.lines if text in line), None)
        right = found is not None and status in (None, outcome.status)
        return right, (found or f"status {outcome.status}: {outcome.in_short}")[:100]

    return check


def umf(folder: Path, *arguments: str) -> None:
    """Run a command of `umf` in a folder, for the making of an input."""
    subprocess.run([*UMF, *arguments], cwd=folder, capture_output=True, check=True)


def simulated(folder: Path) -> Path:
    """Return the drive as simulated, made once in a folder."""
    path = folder / "demo.mcap"
    if not path.exists():
        umf(folder, "simulate", "making.mcap", "--preset", "demo", "--seed", str(SEED), "--duration", str(SECONDS))
        (folder / "making.mcap").rename(path)
    return path
