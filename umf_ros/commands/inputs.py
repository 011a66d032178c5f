"""What a recording lacks and what could not be read of it, told once and kept with the run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rich.console import Console

from umf_ros.bags.reader import Bag
from umf_ros.commands.progress import WARNING
from umf_ros.core.config import Settings
from umf_ros.runs.finished_run import remember_recording
from umf_ros.runs.inputs import absent_inputs, input_counts
from umf_ros.sensors.buffers import InputCounter
from umf_ros.sensors.sessions import Input


class InputConsole:
    """Prints each line about the inputs once, and writes them into the summary of the run.

    Attributes:
        told: the lines so far.
    """

    def __init__(self, console: Console, bag: Bag) -> None:
        self._console = console
        self._bag = bag
        self._warnings: list[str] = []
        self.told: frozenset[str] = frozenset()

    def warn(self, text: str) -> None:
        """Tell what cannot be read."""
        self._warnings.append(text)
        self._tell(text)

    def tell_absent(self, settings: Settings, odometry_from_file: bool) -> None:
        """Tell which inputs the recording lacks, one line each."""
        for finding in absent_inputs(self._bag, settings, odometry_from_file):
            self._tell(finding.line)

    def remember(
        self,
        folder: Path,
        counters: Mapping[Input, InputCounter],
        interrupted: bool,
        odometry: Path | None,
        odometry_frame: str,
    ) -> None:
        """Keep in the summary what the report needs to know of the inputs."""
        source = {"path": str(odometry.resolve()), "frame": odometry_frame} if odometry else None
        known = {
            "inputs": input_counts(counters),
            "warnings": self._warnings,
            "interrupted": interrupted,
            "odometry_file": source,
        }
        remember_recording(folder, self._bag, **known)

    def _tell(self, text: str) -> None:
        if text not in self.told:
            self.told |= {text}
            self._console.print(text, **WARNING)
