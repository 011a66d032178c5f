"""`umf evaluate --methods all`: every method on whatever `umf evaluate` takes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from umf_ros.core.errors import ConfigError
from umf_ros.lab.commands.evaluation_inputs import RecordingOptions, choose_worlds, note_on_worlds, progress_bar

if TYPE_CHECKING:
    from rich.console import Console

    from umf_ros.lab.evaluation.methods_run import FrameSet
    from umf_ros.lab.evaluation.results import Figures

SPARSE = 3
"""Every so many-th sample of a sequence is asked in a quick comparison."""
REPEATS = 3
"""Of every timed frame."""


@dataclass(frozen=True)
class EveryMethod:
    """The comparison of all methods.

    Attributes:
        weights: of UMF; None: the default.
        trained: folder with the weights of other methods; None: the shipped ones.
        quick: a smaller sample of every world.
        out: folder of the results.
    """

    weights: Path | None
    trained: Path | None
    quick: bool
    out: Path

    def worlds(self, name: str, seed: int | None, count: int) -> Figures:
        """On simulated worlds, or on those of S3LI's simulated sequences that the thesis tests on."""
        from rich.console import Console

        from umf_ros.lab.evaluation.frame_sets import drive_sets, world_set
        from umf_ros.lab.evaluation.worlds import WORLDS
        from umf_ros.lab.simulation.seeds import TEST

        if name == "etna":
            if count != WORLDS:
                raise ConfigError("--worlds etna has no use for --count")
            first, every = TEST.start if seed is None else seed, SPARSE if self.quick else 1
            note = (
                f"Simulated S3LI sequences of seed {first}, every {every}. sample: each is asked for its own past, "
                "20 s and 15 m back; those without a true match can only be wrong. Nothing was trained on the others."
            )
            return self._compare(Console(), drive_sets(first, every), note)
        chosen = choose_worlds(name, seed, self.quick, count)
        return self._compare(Console(), map(world_set, chosen), note_on_worlds(chosen, self.quick))

    def places(self, listing: Path) -> Figures:
        """On sets of still images or scans."""
        from rich.console import Console

        from umf_ros.lab.evaluation.frame_sets import still_set
        from umf_ros.lab.evaluation.places import read_place_sets

        sets = map(still_set, read_place_sets(listing))
        return self._compare(Console(), sets, f"{listing}: a match is true where the set says so.")

    def sequences(self, listing: Path, rule: str) -> Figures:
        """On listed sequences."""
        from rich.console import Console

        from umf_ros.lab.datasets.listed import SequenceList
        from umf_ros.lab.evaluation.frame_sets import sequence_set
        from umf_ros.lab.evaluation.protocol import RULES

        if rule not in RULES:
            raise ConfigError(f"--rule: expected {' or '.join(RULES)}, not {rule!r}")
        sets = [sequence_set(sequence, RULES[rule]) for sequence in SequenceList(listing).worlds]
        note = (
            f"{listing}: samples with a true match in an earlier pass are asked for it; same place by the rule {rule}."
        )
        return self._compare(Console(), sets, note)

    def recording(self, options: RecordingOptions) -> Figures:
        """On the keyframes of a recording."""
        from rich.console import Console

        from umf_ros.lab.evaluation.frame_sets import recording_set

        console = Console()
        opened = options.open(console, None)
        places = recording_set(options.bag.stem, opened.frames, opened.truth, opened.settings)
        gaps = opened.settings.loop
        note = (
            f"{options.bag}: every keyframe against those at least {gaps.min_time_gap_s:g} s older and "
            f"{gaps.min_travel_m:g} m back along the path; keyframes without a true match can only be wrong."
        )
        return self._compare(console, [places], note)

    def _compare(self, console: Console, sets: Iterable[FrameSet], note: str) -> Figures:
        from umf_ros.lab.evaluation.all_methods import compare_methods
        from umf_ros.runs.writer import create_run_folder

        with progress_bar(console) as bar:
            task = bar.add_task("reading", total=None)
            done: list[int] = []

            def show(what: str, frames: int) -> None:
                done.append(frames)
                bar.update(task, description=f"{what}, {sum(done)} frames")

            report, folder = compare_methods(
                sets, [note], self.weights, self.trained, lambda: create_run_folder(self.out), REPEATS, show
            )
        report.show(console, folder)
        return report.figures
