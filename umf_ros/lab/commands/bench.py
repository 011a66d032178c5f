"""`umf bench`: time and memory of the package on this machine."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Measure time and memory on this machine.")


@app.callback()
def _group() -> None:
    """Make `places` a subcommand although it is the only one."""


@app.command("places")
def places(
    out: Annotated[Path | None, typer.Option("--json", help="Write the figures to this file.")] = None,
    run: Annotated[
        Path | None, typer.Option(help="Repeat the descriptors of this run with noise; default: random drives.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="150,000 places instead of a million.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of the descriptors.")] = 0,
) -> None:
    """Measure search among 1,000, 100,000 and a million places: time, recall, memory and disk.

    Search is exact up to 50,000 places and approximate beyond. Takes some minutes, and 7 GB in the folder for temporary
    files.
    """
    import numpy as np
    from rich.console import Console

    from umf_ros.core.errors import UmfError
    from umf_ros.core.io import write_atomically
    from umf_ros.lab.evaluation.places_bench import measure_places
    from umf_ros.runs.run_file import read_descriptors

    console = Console(stderr=True)
    largest = 150_000 if quick else 1_000_000
    found = read_descriptors(run) if run is not None else {}
    if run is not None and not found:
        raise UmfError(f"{run} holds no descriptors of keyframes")
    drive = np.stack(list(found.values())) if found else None
    thousand, many, most = measure_places((1000, 100_000, largest), drive, seed, console.print)
    figures = {
        "query_ms_1k": round(thousand.query_ms, 2),
        "query_ms_100k": round(many.query_ms, 2),
        "query_ms_1m": round(most.query_ms, 2),
        "query_cpu_ms_1k": round(thousand.query_cpu_ms, 2),
        "query_cpu_ms_100k": round(many.query_cpu_ms, 2),
        "query_cpu_ms_1m": round(most.query_cpu_ms, 2),
        "recall_100k": round(many.recall, 4),
        "recall_1m": round(most.recall, 4),
        "reopen_1m_s": round(most.open_s, 2),
        "reopen_1m_cpu_s": round(most.open_cpu_s, 2),
        "bytes_per_keyframe_ram": round(most.ram),
        "bytes_per_keyframe_ram_100k": round(many.ram),
        "bytes_per_keyframe_disk": round(most.disk),
        "places": largest,
        "approximate": not most.exact,
    }
    if out is not None:
        write_atomically(out, json.dumps(figures, indent=2) + "\n")
    typer.echo(json.dumps(figures, indent=2))
