"""`umf evaluate`: recall, precision, reranking, missing modalities and cost; `umf sensors`: each sensor by itself."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.commands.recordings import (
    Changes,
    ConfigPath,
    DatasetName,
    OdometryFrame,
    RunsFolder,
    TruthPath,
    WeightsPath,
    check_files,
    check_odometry_options,
    open_recording,
    parameters,
    refuse_unused,
)
from umf_ros.core.errors import ConfigError
from umf_ros.embedding import choices

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from umf_ros.bags.reader import Bag
    from umf_ros.core.config import ParameterSource, Settings
    from umf_ros.core.frames import Frame
    from umf_ros.core.trajectory import Trajectory
    from umf_ros.lab.evaluation.methods_run import FrameSet
    from umf_ros.lab.evaluation.results import EvaluationReport, Figures
    from umf_ros.lab.evaluation.worlds import TestWorld


@dataclass(frozen=True)
class OpenRecording:
    """An open recording with its ground truth."""

    bag: Path
    frames: Iterable[Frame]
    settings: Settings
    truth: Trajectory
    duration_s: float


def open_with_truth(
    recording: Bag, settings: Settings, odometry: Path | None, odometry_frame: str, truth_path: Path | None
) -> OpenRecording:
    """Return a recording to evaluate.

    Args:
        recording: opened.
        settings: to read it with.
        odometry: a TUM file, where the recording has none.
        odometry_frame: of its poses.
        truth_path: a file of ground truth, where the recording has none.

    Raises:
        ConfigError: there is no truth.
        BagError: it cannot be read.
    """
    from rich.console import Console

    from umf_ros.bags.frames import FrameReader
    from umf_ros.bags.trajectories import read_ground_truth, read_odometry
    from umf_ros.commands.console import WARNING

    truth = read_ground_truth(recording, truth_path)
    if truth is None:
        raise ConfigError(f"{recording.path} holds no ground truth; name a file with --ground-truth")
    path = read_odometry(odometry, odometry_frame, settings) if odometry else None
    frames = FrameReader(recording, settings, path, warn=lambda text: Console().print(text, **WARNING))
    return OpenRecording(recording.path, frames, settings, truth, recording.duration_s)


def choose_worlds(name: str, seed: int | None, quick: bool, count: int) -> list[TestWorld]:
    """Return the first worlds of a name, or those from a seed on."""
    from umf_ros.lab.evaluation.worlds import FIRST_SEEDS, FULL, QUICK, test_worlds

    return test_worlds(FIRST_SEEDS[name] if seed is None else seed, QUICK if quick else FULL, count)


def note_on_worlds(worlds: Sequence[TestWorld], quick: bool) -> str:
    """Return the figures of the worlds for the report."""
    names = ", ".join(world.name for world in worlds)
    return (
        f"Worlds: {names}; hard setting (offset path up to 4.5 m, yaw 16 deg, sun moved 70 deg, aliasing)"
        f"{', quick' if quick else ''}. A match is true within 12 m and 30 deg [UMF 5.1.2]."
    )


def progress_bar(console: Console) -> Progress:
    """Return a transient progress bar."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:.0f} %")
    return Progress(*columns, TimeRemainingColumn(), console=console, transient=True)


SPARSE = 3
"""Every so many-th sample of a sequence is asked in a quick comparison."""
REPEATS = 3
"""Of every timed frame."""


@dataclass(frozen=True)
class EveryMethod:
    """Comparison of all methods.

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
        """Evaluate on simulated worlds, or on the simulated S3LI sequences of the thesis's test split."""
        from umf_ros.lab.evaluation.bag_run import drive_sets, world_set
        from umf_ros.lab.evaluation.worlds import WORLDS
        from umf_ros.lab.simulation.world import TEST

        if name == "etna":
            if count != WORLDS:
                raise ConfigError("--worlds etna has no use for --count")
            first, every = TEST.start if seed is None else seed, SPARSE if self.quick else 1
            note = (
                f"Simulated S3LI sequences of seed {first}, every {every}. sample: each is asked for its own past, "
                "20 s and 15 m back; those without a true match can only be wrong. Nothing was trained on the others."
            )
            return self._compare(drive_sets(first, every), note)
        chosen = choose_worlds(name, seed, self.quick, count)
        return self._compare(map(world_set, chosen), note_on_worlds(chosen, self.quick))

    def places(self, listing: Path) -> Figures:
        """Evaluate on sets of still images or scans."""
        from umf_ros.lab.evaluation.bag_run import still_set
        from umf_ros.lab.evaluation.places import read_place_sets

        sets = map(still_set, read_place_sets(listing))
        return self._compare(sets, f"{listing}: a match is true where the set says so.")

    def sequences(self, listing: Path, rule: str) -> Figures:
        """Evaluate on listed sequences."""
        from umf_ros.lab.datasets.listed import SequenceList
        from umf_ros.lab.evaluation.bag_run import sequence_set
        from umf_ros.lab.evaluation.retrieval import RULES

        sets = [sequence_set(sequence, RULES[rule]) for sequence in SequenceList(listing).worlds]
        note = (
            f"{listing}: samples with a true match in an earlier pass are asked for it; same place by the rule {rule}."
        )
        return self._compare(sets, note)

    def recording(self, opened: OpenRecording) -> Figures:
        """Evaluate on the keyframes of a recording."""
        from umf_ros.lab.evaluation.bag_run import recording_set

        places = recording_set(opened.bag.stem, opened.frames, opened.truth, opened.settings)
        gaps = opened.settings.loop
        note = (
            f"{opened.bag}: every keyframe against those at least {gaps.min_time_gap_s:g} s older and "
            f"{gaps.min_travel_m:g} m back along the path; keyframes without a true match can only be wrong."
        )
        return self._compare([places], note)

    def _compare(self, sets: Iterable[FrameSet], note: str) -> Figures:
        from rich.console import Console

        from umf_ros.lab.evaluation.methods_run import compare_methods

        console = Console()
        with progress_bar(console) as bar:
            task = bar.add_task("reading", total=None)
            done: list[int] = []

            def show(what: str, frames: int) -> None:
                done.append(frames)
                bar.update(task, description=f"{what}, {sum(done)} frames")

            report = compare_methods(sets, [note], self.weights, self.trained, REPEATS, show)
        return finish(report, self.out, console)


Optional = typer.Option


def command(
    data: Annotated[
        Path | None,
        typer.Argument(
            help="Recording with ground truth: mcap, db3 folder or .bag; or a YAML file that lists sequences or "
            "sets of still images and scans (docs/training.md)."
        ),
    ] = None,
    worlds: Annotated[
        str | None, Optional(help="Instead of a recording: test or validation; with --methods all also etna.")
    ] = None,
    seed: Annotated[int | None, Optional(min=0, help="First of the worlds' seeds.")] = None,
    count: Annotated[int, Optional(min=1, max=8, help="Number of worlds, of different families.")] = 4,
    quick: Annotated[bool, Optional("--quick", help="A smaller sample of every world.")] = False,
    methods: Annotated[str, Optional(help="umf, or all: also every method of docs/benchmarks.md.")] = "umf",
    trained: Annotated[
        Path | None, Optional(help="With --methods all: folder of other methods' weights, NAME/NAME.safetensors.")
    ] = None,
    weights: WeightsPath = None,
    json_file: Annotated[Path | None, Optional("--json", help="Also write the figures to this file.")] = None,
    out: RunsFolder = Path("results"),
    config: Annotated[Path | None, Optional(help="Parameter file (YAML), for a recording or place sets.")] = None,
    changes: Changes = None,
    dataset: DatasetName = "auto",
    embedder: Annotated[str | None, Optional(help=f"How places are embedded: {choices()}.")] = None,
    odometry: Annotated[Path | None, typer.Option(help="Odometry as a TUM file, where the recording has none.")] = None,
    odometry_frame: OdometryFrame = "",
    ground_truth: TruthPath = None,
    rule: Annotated[str, Optional(help="Definition of the same place in listed sequences: s3li or robotcar.")] = "s3li",
) -> None:
    """Measure recall, precision, reranking, missing modalities and cost.

    On a recording, every keyframe queries the earlier ones; in listed sequences (docs/training.md) every sample, by
    global descriptors alone. On four simulated worlds of different families, a second drive on an offset path under
    another sun queries the first; nothing is trained or tuned on the default seeds of the test worlds.
    """
    _check(data, worlds, methods, trained, rule)
    listed = data is not None and data.suffix in (".yaml", ".yml")
    if data is not None and not listed:
        check_files(data, config, odometry, ground_truth)
    from umf_ros.core.io import check_writable

    check_writable(out)
    of_worlds: dict[str, object] = {"--seed": seed is not None, "--quick": quick, "--count": count != 4}
    of_lists: dict[str, object] = {"--rule": rule != "s3li"}
    of_recordings: dict[str, object] = {"--config": config, "--dataset": dataset != "auto", "--embedder": embedder}
    of_recordings |= {"--set": changes, "--odometry": odometry, "--ground-truth": ground_truth}
    every = EveryMethod(weights, trained, quick, out) if methods == "all" else None
    if data is None:
        refuse_unused("simulated worlds", of_lists | of_recordings)
        asked = str(worlds), seed, count
        figures = every.worlds(*asked) if every else _on_worlds(*asked, quick, weights, out)
    elif listed and lists_place_sets(data):
        allowed = () if every else ("--embedder", "--config", "--set")
        others = {name: value for name, value in of_recordings.items() if name not in allowed}
        refuse_unused("a list of place sets", of_worlds | of_lists | others)
        figures = every.places(data) if every else _on_places(data, parameters(config, changes), embedder, weights, out)
    elif listed:
        refuse_unused("a list of sequences", of_worlds | of_recordings)
        check_files(Path(), data)
        figures = every.sequences(data, rule) if every else _on_sequences(data, rule, weights, out)
    else:
        refuse_unused("a recording", of_worlds | of_lists | ({"--embedder": embedder} if every else {}))
        frame = check_odometry_options(odometry, odometry_frame)
        recording = open_recording(data, parameters(config, changes), dataset, embedder, None if every else weights)
        opened = open_with_truth(*recording, odometry, frame, ground_truth)
        figures = every.recording(opened) if every else _on_recording(opened, out)
    from umf_ros.lab.program import write_figures

    write_figures(json_file, figures)


def lists_place_sets(listing: Path) -> bool:
    """Whether a YAML file lists place sets, and not sequences: its first entry names queries."""
    from umf_ros.core.io import read_yaml

    content = read_yaml(listing) if listing.is_file() else None
    return isinstance(content, list) and bool(content) and isinstance(content[0], dict) and "queries" in content[0]


def _check(data: Path | None, worlds: str | None, methods: str, trained: Path | None, rule: str) -> None:
    """Refuse invalid arguments before the slow imports."""
    if (data is None) == (worlds is None):
        raise ConfigError("expected either a recording or --worlds test|validation")
    if methods not in ("umf", "all"):
        raise ConfigError(f"--methods: expected umf or all, not {methods!r}")
    if rule not in ("s3li", "robotcar"):
        raise ConfigError(f"--rule: expected s3li or robotcar, not {rule!r}")
    if worlds not in (None, "test", "validation", "etna" if methods == "all" else None):
        raise ConfigError(f"--worlds: expected test or validation, not {worlds!r} (etna: with --methods all)")
    if trained is not None and methods == "umf":
        raise ConfigError("--trained names weights of other methods, and without --methods all there are none")


def _on_worlds(name: str, seed: int | None, count: int, quick: bool, weights: Path | None, out: Path) -> Figures:
    from rich.console import Console

    from umf_ros.lab.evaluation.worlds import evaluate_worlds, work

    console = Console()
    chosen = choose_worlds(name, seed, quick, count)
    with progress_bar(console) as bar:
        task = bar.add_task("", total=sum(work(world) for world in chosen))

        def progress(what: str, done: int) -> None:
            bar.update(task, description=what, advance=done)

        summary = evaluate_worlds(weights, chosen, 3 if quick else 10, progress)
    note = note_on_worlds(chosen, quick) + " Times are medians on this machine, as busy as it was."
    return finish(summary.report([note]), out, console)


def _on_recording(opened: OpenRecording, out: Path) -> Figures:
    from rich.console import Console

    from umf_ros.embedding import make_embedder
    from umf_ros.lab.evaluation.bag_run import BagEvaluation

    console, settings = Console(), opened.settings
    evaluation = BagEvaluation(settings, make_embedder(settings.embedding, True, settings.verification.features))
    with progress_bar(console) as bar:
        task = bar.add_task("embedding", total=opened.duration_s)
        start_ns: list[int] = []

        def show(frame: Frame, keyframes: int) -> None:
            start_ns.append(frame.stamp_ns)
            done_s = (frame.stamp_ns - start_ns[0]) * 1e-9
            bar.update(task, completed=done_s, description=f"{keyframes} keyframes")

        evaluation.remember(opened.frames, show)
        bar.update(task, description="reranking")
        result = evaluation.judge(opened.truth)
    notes = [
        f"{opened.bag}: every keyframe against those at least {settings.loop.min_time_gap_s:g} s older and "
        f"{settings.loop.min_travel_m:g} m back along the path. {result.keyframes} keyframes with a true pose, "
        f"{result.scores['fused'].queries} of them revisits; the others can only be wrong."
    ]
    if not opened.truth.has_orientation:
        notes.append("The truth has no headings: a match is true within 12 m, whatever its heading.")
    return finish(result.report(notes), out, console)


def _on_sequences(listing: Path, rule: str, weights: Path | None, out: Path) -> Figures:
    from rich.console import Console

    from umf_ros.lab.datasets.listed import SequenceList
    from umf_ros.lab.evaluation.results import EvaluationReport
    from umf_ros.lab.evaluation.retrieval import RULES
    from umf_ros.lab.training.metric_objective import answerable, means, table, validate
    from umf_ros.networks.config import locate_weights
    from umf_ros.networks.weights import load_weights

    console = Console()
    network = load_weights(locate_weights(weights))
    results = validate(network, SequenceList(listing).worlds, rule=RULES[rule])
    if not answerable(results):
        raise ConfigError(f"{listing}: no place is visited twice")
    notes = [f"{listing}: samples with a true match in an earlier pass are asked for it; same place by rule {rule}."]
    tables = {"Place recognition by the global descriptor": table(results)}
    return finish(EvaluationReport("Evaluation on sequences", notes, means(results), tables), out, console)


def _on_places(
    listing: Path, config: ParameterSource, embedder: str | None, weights: Path | None, out: Path
) -> Figures:
    from rich.console import Console

    from umf_ros.core.config import load_settings
    from umf_ros.lab.evaluation.places import evaluate_place_sets

    console = Console()
    chosen = {"embedding__method": embedder, "embedding__weights": str(weights) if weights else None}
    settings = load_settings(config, **chosen)
    with console.status("embedding") as status:
        report = evaluate_place_sets(listing, settings, status.update)
    return finish(report, out, console)


def finish(report: EvaluationReport, out: Path, console: Console) -> Figures:
    """Write a report into a folder of its own, print it, and return its figures."""
    from umf_ros.core.io import create_run_folder

    folder = create_run_folder(out, latest=False)
    report.write(folder)
    report.show(console, folder)
    return report.figures


def sensors(
    bag: Annotated[
        Path | None, typer.Argument(help="Recording with ground truth; default: one is simulated.", show_default=False)
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated world and drive.")] = 1,
    config: ConfigPath = None,
    changes: Changes = None,
    out: RunsFolder = Path("results"),
    workers: Annotated[int, typer.Option(min=1, max=3, help="Replays in parallel.")] = 2,
    report: Annotated[bool, typer.Option("--report", help="Also write a report for each replay.")] = False,
) -> None:
    """Check the sensors of a recording, and replay it with both, with the LiDAR alone and with the camera alone.

    Faults of exposure, clocks, mountings and baseline are printed first, then notes on what cannot be measured.
    Without a recording, a drive is simulated over even ground, where scans show no structure, and after sunset, where
    images are black. Takes some minutes.
    """
    if bag is not None:
        refuse_unused("a recording", {"--seed": seed != 1})
        check_files(bag, config)

    import json
    from dataclasses import asdict

    from rich.console import Console

    from umf_ros.bags.presets import settings_for
    from umf_ros.bags.reader import open_bag
    from umf_ros.core.io import check_writable, create_run_folder, write_atomically
    from umf_ros.lab.commands import simulate
    from umf_ros.lab.evaluation.inspection import check_sensors
    from umf_ros.lab.evaluation.results import print_table
    from umf_ros.lab.evaluation.sensors_run import describe_sensors, replay_all, score, stretches_of, table_of

    console = Console()
    check_writable(out)
    if bag is None:
        bag = Path("data") / f"sensors_seed{seed}.mcap"
        if not bag.exists():
            simulate.write_drive(bag, console, "sensors", (seed, None))
    stretches = stretches_of(bag)
    recording, source = open_bag(bag), parameters(config, changes)
    for line in describe_sensors(check_sensors(recording, settings_for(recording, source, "auto"))):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    folder = create_run_folder(out)
    with console.status("replaying") as status:
        runs = replay_all(bag, source, folder, report, workers, lambda done: status.update(f"replayed {done} of 3"))
    found = {name: score(about, stretches) for name, about in runs.items()}
    figures = {name: {where: asdict(one) for where, one in scores.items()} for name, scores in found.items()}
    write_atomically(folder / "sensors.json", json.dumps(figures, indent=2) + "\n")
    print_table(console, f"{bag}", table_of(found))
    console.print(f"{folder}", markup=False, soft_wrap=True)
