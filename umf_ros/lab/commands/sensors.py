"""`umf sensors`: closures with both sensors, with the LiDAR alone and with the camera alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from umf_ros.commands.recordings import ConfigPath, RunsFolder, check_files


def command(
    bag: Annotated[
        Path | None, typer.Argument(help="Recording with ground truth; default: one is simulated.", show_default=False)
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated world and drive.")] = 1,
    config: ConfigPath = None,
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
    from umf_ros.lab.evaluation.sensors_run import replay_all, score, stretches_of, table_of
    from umf_ros.runs.findings import about_sensors

    console = Console()
    check_writable(out)
    if bag is None:
        bag = Path("data") / f"sensors_seed{seed}.mcap"
        if not bag.exists():
            simulate.command(bag, preset="sensors", seed=seed)
    stretches = stretches_of(bag)
    recording = open_bag(bag)
    told = [one.line for one in about_sensors(check_sensors(recording, settings_for(recording, config, "auto")))]
    for line in told or ["nothing is wrong with light, clocks, mountings and baseline"]:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    folder = create_run_folder(out)
    with console.status("replaying") as status:
        runs = replay_all(bag, config, folder, report, workers, lambda done: status.update(f"replayed {done} of 3"))
    found = {name: score(about, stretches) for name, about in runs.items()}
    figures = {name: {where: asdict(one) for where, one in scores.items()} for name, scores in found.items()}
    write_atomically(folder / "sensors.json", json.dumps(figures, indent=2) + "\n")
    print_table(console, f"{bag}", table_of(found))
    console.print(f"{folder}", markup=False, soft_wrap=True)
