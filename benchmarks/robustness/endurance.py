"""Endurance tests: kill -9, damaged input, long drives. Prints a table and writes it as JSON.

    python benchmarks/robustness/endurance.py --json endurance.json --quick              (a quarter of an hour)
    python benchmarks/robustness/endurance.py --json endurance.json --folder endurance   (hours)

Replays and both live nodes are killed at random moments and go on; two robots live at once; inputs are damaged in a
process of their own with 2 GB of memory. Each part is done in steps, and what a step found is kept in the folder: a
run that was cut off goes on where it was, and several at once may do different parts (--only) in one folder.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from typing import Annotated

import numpy as np
import typer
from endurance_live import (
    backlogs,
    fuzz_back_end,
    fuzz_front_end,
    kill_back_end,
    kill_both,
    pairs_of,
    restart,
    rows_of,
    two_robots,
)
from live_nodes import Figures
from rich.console import Console
from rich.table import Table

from umf_ros.core.errors import UmfError
from umf_ros.core.io import atomic_write
from umf_ros.lab.program import UMF, umf, write_figures
from umf_ros.runs.run_file import NAME, RunFile

KEYS = "kills lost_keyframes duplicate_closures backend_kills lost_verdicts fuzz_messages fuzz_bags fuzz_files"
KEYS += " fuzz_crashes fuzz_uncounted shutdown_s closures_without_verdict closures_twice restart_s_8h"
OFTEN = "loop: {min_time_gap_s: 8.0, min_travel_m: 10.0}"
"""Loops are closed within seconds, so that a short recording has some."""
LIGHT = (
    f"/**: {{ros__parameters: {{embedding: {{method: thumbnail}}, {OFTEN}, keyframe: {{min_translation_m: 0.2}}}}}}\n"
)
FUZZ = Path(__file__).with_name("endurance_fuzz.py")


@dataclass(frozen=True)
class Task:
    """Where a part works, and on what.

    Attributes:
        folder: for what it leaves.
        bag: a short simulated recording.
        light: parameter file, without the network.
    """

    folder: Path
    bag: Path
    light: Path


@dataclass(frozen=True)
class Part:
    """One thing that is tried, in steps.

    Attributes:
        step: does so many at once and says what was found.
        quick, full: how many are wanted.
        at_once: of a step.
    """

    step: Callable[[Task, int, np.random.Generator], Figures]
    quick: int
    full: int
    at_once: int


def kill_replays(task: Task, kills: int, rng: np.random.Generator) -> Figures:
    """Kill a replay at random keyframes, resume it, and compare what it leaves with an undisturbed run."""
    whole = task.folder / "whole"
    if not (whole / "latest").exists():
        umf("replay", task.bag, "--config", task.light, "--out", whole, right=(0, 3))
    expected, killed = whole / "latest", 0
    out = task.folder / f"cut_{int(rng.integers(10**9))}"
    words = "replay", str(task.bag), "--config", str(task.light), "--out", str(out), "--resume"
    for keyframes in np.sort(rng.integers(0, len(rows_of(expected / "keyframes.csv")), kills, endpoint=True)):
        process = subprocess.Popen([*UMF, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while process.poll() is None and _keyframes(out) < keyframes:
            time.sleep(0.02)
        with suppress(subprocess.TimeoutExpired):  # and at any moment of that keyframe, or of the report at the end
            process.wait(rng.exponential(0.3))
        killed += process.poll() is None
        process.kill()
        process.wait()
    umf(*words, right=(0, 3))
    found = out / "latest"
    stamps, before = ([row["stamp_ns"] for row in rows_of(run / "keyframes.csv")] for run in (found, expected))
    pairs, missing = pairs_of(found / "closures.csv"), set(pairs_of(expected / "closures.csv"))
    return {
        "kills": killed,
        "lost_keyframes": len(set(before) - set(stamps)),
        "duplicate_closures": len(pairs) - len(set(pairs)) + len(stamps) - len(set(stamps)),
        "missing_closures": len(missing - set(pairs)),
    }


def _keyframes(out: Path) -> int:
    """How many keyframes the newest run has written."""
    runs = sorted(path.parent for path in out.glob(f"2*/{NAME}"))
    with suppress(UmfError, IndexError), closing(RunFile(runs[-1], read_only=True)) as file:
        return len(file.rows("keyframes"))
    return 0


def fuzz(part: str, task: Task, count: int, rng: np.random.Generator) -> Figures:
    """Damage inputs in a process of their own; its sudden end is a crash."""
    seed = int(rng.integers(10**9))
    folder = task.folder / f"{part}_{seed}"
    command = [sys.executable, str(FUZZ), part, str(count), str(seed), str(folder)]
    command += [] if part == "files" else [str(task.bag)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    sys.stderr.write(done.stderr[-2000:])
    outcome = Counter(json.loads(done.stdout) if done.returncode == 0 else {"crashes": 1})
    rmtree(folder)
    crashes = outcome["crashes"] + outcome["hangs"]
    return {f"fuzz_{part}": count, "fuzz_crashes": crashes, "fuzz_uncounted": outcome["uncounted"]}


PARTS = {
    "replay": Part(kill_replays, 4, 200, 8),
    "back_end": Part(lambda task, n, rng: kill_back_end(task.folder, n, rng), 3, 40, 5),
    "both": Part(lambda task, n, rng: kill_both(task.folder, n, task.bag, task.light, rng), 4, 80, 4),
    "wire_front": Part(lambda task, n, rng: fuzz_front_end(task.folder, n, task.light, rng), 120, 1000, 500),
    "wire_back": Part(lambda task, n, rng: fuzz_back_end(task.folder, n, rng), 120, 1000, 500),
    "robots": Part(lambda task, _, __: two_robots(task.folder, task.bag, task.light), 1, 1, 1),
    "messages": Part(lambda task, n, rng: fuzz("messages", task, n, rng), 1000, 20_000, 2000),
    "bags": Part(lambda task, n, rng: fuzz("bags", task, n, rng), 24, 500, 25),
    "files": Part(lambda task, n, rng: fuzz("files", task, n, rng), 48, 300, 60),
    "backlog": Part(lambda task, _, __: backlogs(task.folder), 1, 1, 1),
    "restart": Part(lambda task, _, __: restart(task.folder), 1, 1, 1),
}
PLAYING = {"replay", "both", "robots", "messages", "bags"}
"""Parts that play a recording."""


def together(one: Figures, other: Figures) -> Figures:
    """The figures of two steps: counts add up, of times the longest counts."""
    merged = dict(one)
    for name, value in other.items():
        if name not in merged or merged[name] is None:
            merged[name] = value
        elif value is not None:
            merged[name] = max(merged[name], value) if name.endswith(("_ms", "_s", "_mb")) else merged[name] + value
    return merged


def run_part(name: str, wanted: int, task: Task, seed: int, console: Console) -> Figures:
    """Do what is left of a part; every step is kept before the next begins."""
    kept = task.folder / f"part_{name}.json"
    state: Figures = json.loads(kept.read_text()) if kept.exists() else {"done": 0, "figures": {}}
    while state["done"] < wanted:
        count = min(PARTS[name].at_once, wanted - state["done"])
        start = time.monotonic()
        found = PARTS[name].step(task, count, np.random.default_rng([seed, state["done"], len(name)]))
        state = {"done": state["done"] + count, "figures": together(state["figures"], found)}
        with atomic_write(kept) as part:
            part.write_text(json.dumps(state))
        console.print(f"{name}: {state['done']} of {wanted} ({time.monotonic() - start:.0f} s): {found}", markup=False)
    return dict(state["figures"])


def make_task(folder: Path, bag: Path | None, parts: list[str]) -> Task:
    """The recording and parameter file; a recording that is not given is made once, if a part plays it."""
    path, light = bag or folder / "short.mcap", folder / "light.yaml"
    if not path.exists() and PLAYING & set(parts):
        umf("simulate", path, "--duration", "40", "--seed", "3")
    light.write_text(LIGHT)
    return Task(folder, path, light)


def main(
    json_file: Annotated[Path, typer.Option("--json", help="Where the figures go.")],
    quick: Annotated[bool, typer.Option("--quick", help="A few of everything.")] = False,
    folder: Annotated[
        Path | None, typer.Option(help="Keeps what was found, to go on; default: a temporary one.")
    ] = None,
    only: Annotated[list[str] | None, typer.Option(help=f"Parts: {', '.join(PARTS)}. Default: all.")] = None,
    bag: Annotated[Path | None, typer.Option(help="A short simulated recording; default: one is made.")] = None,
    seed: Annotated[int, typer.Option(help="Of kills and damage.")] = 1,
) -> None:
    """Measure what the package survives."""
    console = Console(soft_wrap=True)
    figures: Figures = {"fuzz_crashes": 0, "fuzz_uncounted": 0}
    with tempfile.TemporaryDirectory(prefix="umf_endurance_") as name:
        place = folder or Path(name)
        place.mkdir(parents=True, exist_ok=True)
        parts = only or [*PARTS]
        task = make_task(place.resolve(), bag, parts)
        for part in parts:
            wanted = PARTS[part].quick if quick else PARTS[part].full
            figures = together(figures, run_part(part, wanted, task, seed, console))
    table = Table("figure", "value")
    for key in [*filter(figures.__contains__, KEYS.split()), *sorted(figures.keys() - set(KEYS.split()))]:
        table.add_row(key if key in KEYS.split() else f"({key})", str(figures[key]))
    console.print(table)
    write_figures(json_file, {key: figures.get(key) for key in KEYS.split()})
    if figures.get("crossed_closures") or figures.get("missing_closures"):
        console.print("[red]closures crossed between robots, or were missing after a resumed replay")
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
