"""What `umf evaluate` is asked about, opened: worlds, a recording; and the bar it shows meanwhile."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from umf_ros.commands.recordings import check_odometry_options, open_frames, open_recording
from umf_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from umf_ros.core.config import Settings
    from umf_ros.core.frames import Frame
    from umf_ros.core.trajectory import Trajectory
    from umf_ros.lab.evaluation.worlds import TestWorld


@dataclass(frozen=True)
class OpenRecording:
    """A recording with its truth, ready to be read."""

    frames: Iterable[Frame]
    settings: Settings
    truth: Trajectory
    duration_s: float


@dataclass(frozen=True)
class RecordingOptions:
    """What the command line says of a recording."""

    bag: Path
    config: Path | None
    dataset: str
    embedder: str | None
    odometry: Path | None
    odometry_frame: str
    ground_truth: Path | None

    def open(self, console: Console, weights: Path | None) -> OpenRecording:
        """Open it.

        Raises:
            ConfigError: wrong options, or there is no truth.
            BagError: it cannot be read.
        """
        frame_of_odometry = check_odometry_options(self.odometry, self.odometry_frame)

        from umf_ros.bags.trajectories import read_ground_truth
        from umf_ros.commands.console import WARNING

        recording, settings = open_recording(self.bag, self.config, self.dataset, self.embedder, weights)
        truth = read_ground_truth(recording, self.ground_truth)
        if truth is None:
            raise ConfigError(f"{self.bag} holds no ground truth; name a file with --ground-truth")

        def warn(text: str) -> None:
            console.print(text, **WARNING)

        frames = open_frames(recording, settings, warn, self.odometry, frame_of_odometry)
        return OpenRecording(frames, settings, truth, recording.duration_s)


def choose_worlds(name: str, seed: int | None, quick: bool, count: int) -> list[TestWorld]:
    """The first worlds of a name, or those from a seed on.

    Raises:
        ConfigError: there is no such name.
    """
    from umf_ros.lab.evaluation.worlds import FIRST_SEEDS, FULL, QUICK, test_worlds

    if name not in FIRST_SEEDS:
        raise ConfigError(f"--worlds: expected {' or '.join(FIRST_SEEDS)}, not {name!r} (etna: with --methods all)")
    return test_worlds(FIRST_SEEDS[name] if seed is None else seed, QUICK if quick else FULL, count)


def note_on_worlds(worlds: Sequence[TestWorld], quick: bool) -> str:
    """What a report says of the worlds."""
    names = ", ".join(world.name for world in worlds)
    return (
        f"Worlds: {names}; hard setting (offset path up to 4.5 m, yaw 16 deg, sun moved 70 deg, aliasing)"
        f"{', quick' if quick else ''}. A match is true within 12 m and 30 deg [UMF 5.1.2]."
    )


def progress_bar(console: Console) -> Progress:
    """A bar that goes when it is done."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:.0f} %")
    return Progress(*columns, TimeRemainingColumn(), console=console, transient=True)
