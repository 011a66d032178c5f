"""One recording through the live nodes and through the replay: both must find the same.

    python benchmarks/robustness/live_against_replay.py BAG --rate 1

The live graph runs as processes over DDS (bag player, loop_closure_node, pose_graph_node) with queues in which
nothing is lost, so that what is compared is what was found, not what a busy machine dropped. Prints how many rows of
`closures.csv` and `graph_verdicts.csv` are equal; ends with status 1 when one is not.
"""

from __future__ import annotations

import csv
from itertools import zip_longest
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import Bag
from umf_ros.commands.recordings import BagPath, ConfigPath, open_recording
from umf_ros.core.config import Settings, dump_settings
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.lab.live.live_graph import LiveGraph
from umf_ros.replay import Replay
from umf_ros.runs.writer import count_drops, read_summary

OUT = Path("results/live_against_replay")
TABLES = ("closures.csv", "graph_verdicts.csv")
SHOWN = 3

Row = dict[str, str]


def main(
    bag: BagPath,
    rate: Annotated[float, typer.Option(min=0.01, max=100, help="Speed of the live run.")] = 1.0,
    config: ConfigPath = None,
    out: Annotated[Path, typer.Option(help="Where the folders live/ and replay/ go.")] = OUT,
) -> None:
    """Compare the live graph with the replay."""
    console = Console()
    recording, settings = open_recording(
        bag, config, qos__reliability="reliable", qos__depth=1000, worker__queue_size=1000
    )
    live, replayed = out / "live", out / "replay"
    for folder in (live, replayed):
        folder.mkdir(parents=True, exist_ok=True)
    run_live(bag, recording, settings, live, rate, console)
    run_replay(recording, settings, replayed, console)
    drops = {name: count for name, count in read_summary(live)["drops"].items() if count}
    console.print(f"live dropped: {drops or 'nothing'}", markup=False)
    differences = [compare(name, read_rows(live / name), read_rows(replayed / name), console) for name in TABLES]
    if any(differences):
        raise typer.Exit(1)


def run_live(bag: Path, recording: Bag, settings: Settings, folder: Path, rate: float, console: Console) -> None:
    """Play the recording to the live nodes; they leave their results in the folder."""
    parameters = folder / "parameters.yaml"
    parameters.write_text(dump_settings(settings))
    with LiveGraph(folder, Console(quiet=True), parameters) as graph, console.status("Playing to the live nodes"):
        graph.play(bag, recording.duration_s, rate)


def run_replay(recording: Bag, settings: Settings, folder: Path, console: Console) -> None:
    """Replay the recording into the folder."""
    reader = FrameReader(recording, settings)
    replay = Replay(folder, settings, LoopDetector(settings, make_detector_embedder(settings)))
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("Replaying", total=1.0)
        for _ in replay.run(reader.stream()):
            bar.update(task, completed=reader.progress)
    replay.finish(count_drops(reader.counters))
    replay.raise_if_frames_failed()


def read_rows(path: Path) -> list[Row]:
    """Rows of a CSV file; none when the run left none."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def compare(name: str, live: list[Row], replayed: list[Row], console: Console) -> int:
    """Print how many rows are equal, and the first that are not; returns how many are not."""
    pairs = list(zip_longest(live, replayed))
    unequal = [pair for pair in pairs if pair[0] != pair[1]]
    console.print(f"{name}: {len(pairs) - len(unequal)} rows equal, {len(unequal)} unequal", highlight=False)
    if unequal:
        table = Table("row", "column", "live", "replay")
        for here, there in unequal[:SHOWN]:
            row = str(pairs.index((here, there)))
            here, there = here or {}, there or {}
            for column in dict.fromkeys([*here, *there]):
                if here.get(column) != there.get(column):
                    table.add_row(row, column, here.get(column, "none"), there.get(column, "none"))
        console.print(table)
    return len(unequal)


if __name__ == "__main__":
    typer.run(main)
