"""Endurance tests: kill -9, damaged input, long drives. Prints a table and writes it as JSON.

    python benchmarks/robustness/endurance.py --json endurance.json --quick              (a quarter of an hour)
    python benchmarks/robustness/endurance.py --json endurance.json --folder endurance   (hours)

Replays and both live nodes are killed at random moments and go on; two robots live at once; inputs are damaged in a
process of their own with 2 GB of memory. Each part is done in steps, and what a step found is kept in the folder: a
run that was cut off goes on where it was, and several at once may do different parts (--only) in one folder.
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from endurance_files import some_keyframe
from endurance_graph import backlogs, live_graph, long_graph, restart, timed
from endurance_live import (
    fuzz_back_end,
    fuzz_front_end,
    kill_back_end,
    kill_both,
    kill_front_end,
    play_live,
    two_robots,
)
from rich.console import Console
from rich.table import Table

from umf_ros.core.config import Database, Loop
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Embedding
from umf_ros.core.io import atomic_write, memory_mb
from umf_ros.places.database import PlaceDatabase
from umf_ros.runs.run_file import NAME, RunFile

Figures = dict[str, Any]
KEYS = "kills lost_keyframes duplicate_closures backend_kills lost_verdicts fuzz_messages fuzz_bags fuzz_files"
KEYS += " fuzz_crashes fuzz_uncounted rss_bytes_per_keyframe live_p50_ms live_p95_ms executor_stall_max_ms shutdown_s"
KEYS += " event_ms_20k query_ms_100k closures_without_verdict closures_twice restart_s_8h"
OFTEN = "loop: {min_time_gap_s: 8.0, min_travel_m: 10.0}"
"""Loops are closed within seconds, so that a short recording has some."""
LIGHT = (
    f"/**: {{ros__parameters: {{embedding: {{method: thumbnail}}, {OFTEN}, keyframe: {{min_translation_m: 0.2}}}}}}\n"
)
WHOLE = f"/**: {{ros__parameters: {{{OFTEN}, qos: {{reliability: reliable, depth: 200}}}}}}\n"
FUZZ = Path(__file__).with_name("endurance_fuzz.py")


@dataclass(frozen=True)
class Task:
    """Where a part works, and on what.

    Attributes:
        folder: for what it leaves.
        bag: a short simulated recording.
        live_bag: the same with images at 30 Hz.
        light, whole: parameter files, without and with the network.
    """

    folder: Path
    bag: Path
    live_bag: Path
    light: Path
    whole: Path


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


def umf(*words: str | Path) -> subprocess.Popen[bytes]:
    """The command as a process of its own."""
    silent = subprocess.DEVNULL
    return subprocess.Popen([sys.executable, "-m", "umf_ros.cli", *map(str, words)], stdout=silent, stderr=silent)


def rows(path: Path) -> list[dict[str, str]]:
    """Rows of a table."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def kill_replays(task: Task, kills: int, rng: np.random.Generator) -> Figures:
    """Kill a replay at random keyframes, resume it, and compare what it leaves with an undisturbed run."""
    whole = task.folder / "whole"
    if not (whole / "latest").exists():
        assert umf("replay", task.bag, "--config", task.light, "--out", whole).wait() in (0, 3)
    expected = whole / "latest"
    out = task.folder / f"cut_{int(rng.integers(10**9))}"
    killed = 0
    for keyframes in np.sort(rng.integers(0, len(rows(expected / "keyframes.csv")), kills, endpoint=True)):
        process = umf("replay", task.bag, "--config", task.light, "--out", out, "--resume")
        while process.poll() is None and _keyframes(out) < keyframes:
            time.sleep(0.02)
        with suppress(subprocess.TimeoutExpired):  # and at any moment of that keyframe, or of the report at the end
            process.wait(rng.exponential(0.3))
        killed += process.poll() is None
        process.kill()
        process.wait()
    umf("replay", task.bag, "--config", task.light, "--out", out, "--resume").wait()
    found = out / "latest"
    stamps = {row["stamp_ns"] for row in rows(found / "keyframes.csv")}
    lost = len({row["stamp_ns"] for row in rows(expected / "keyframes.csv")} - stamps)
    pairs = Counter((row["query_stamp_ns"], row["match_stamp_ns"]) for row in rows(found / "closures.csv"))
    missing = {(row["query_stamp_ns"], row["match_stamp_ns"]) for row in rows(expected / "closures.csv")} - set(pairs)
    doubled = pairs.total() - len(pairs) + len(rows(found / "keyframes.csv")) - len(stamps)
    return {"kills": killed, "lost_keyframes": lost, "duplicate_closures": doubled, "missing_closures": len(missing)}


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
    subprocess.run(["rm", "-rf", str(folder)], check=True)
    crashes = outcome["crashes"] + outcome["hangs"]
    return {f"fuzz_{part}": count, "fuzz_crashes": crashes, "fuzz_uncounted": outcome["uncounted"]}


def many_places(rng: np.random.Generator, count: int = 100_000) -> Figures:
    """Memory per place, and the time of a query among them."""
    places = PlaceDatabase(Database(), "noise", 256)
    descriptors = rng.standard_normal((1000, 256)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    before = memory_mb()
    blank = some_keyframe(0, rng)
    for number in range(count):
        seen = Embedding(descriptors[number % 1000])
        stamp_ns, session = number * 10**9, number // 1000
        places.add(replace(blank, stamp_ns=stamp_ns, embedding=seen, session=session, path_length_m=float(number)))
    used = (memory_mb() - before) * 2**20
    query = replace(some_keyframe(count * 10**9 + 10**12, rng), embedding=Embedding(descriptors[3]))
    times = [timed(lambda: places.query(query, Loop())) for _ in range(30)]
    wall, cpu = np.median(times, axis=0).round(2).tolist()
    return {"rss_bytes_per_keyframe": round(used / count), "query_ms_100k": wall, "query_cpu_ms_100k": cpu}


PARTS = {
    "replay": Part(kill_replays, 4, 200, 8),
    "front_end": Part(lambda task, n, rng: kill_front_end(task.folder, n, task.bag, task.light, rng), 2, 40, 4),
    "back_end": Part(lambda task, n, rng: kill_back_end(task.folder, n, rng), 3, 40, 5),
    "both": Part(lambda task, n, rng: kill_both(task.folder, n, task.bag, task.light, rng), 4, 40, 4),
    "wire_front": Part(lambda task, n, rng: fuzz_front_end(task.folder, n, task.light, rng), 120, 1000, 500),
    "wire_back": Part(lambda task, n, rng: fuzz_back_end(task.folder, n, rng), 120, 1000, 500),
    "robots": Part(lambda task, _, __: two_robots(task.folder, task.bag, task.light), 1, 1, 1),
    "messages": Part(lambda task, n, rng: fuzz("messages", task, n, rng), 1000, 20_000, 2000),
    "bags": Part(lambda task, n, rng: fuzz("bags", task, n, rng), 24, 500, 25),
    "files": Part(lambda task, n, rng: fuzz("files", task, n, rng), 48, 300, 60),
    "places": Part(lambda _, __, rng: many_places(rng), 1, 1, 1),
    "graph": Part(lambda _, __, ___: long_graph(), 1, 1, 1),
    "graph_live": Part(lambda task, _, __: live_graph(task.folder), 1, 1, 1),
    "backlog": Part(lambda task, _, __: backlogs(task.folder), 1, 1, 1),
    "restart": Part(lambda task, _, __: restart(task.folder), 1, 1, 1),
    "live": Part(lambda task, _, __: play_live(task.folder, task.live_bag, task.whole), 1, 1, 1),
}

PLAYING = ("replay", "front_end", "both", "robots", "messages", "bags", "live")
"""Parts that play a recording; the last one that with 30 images per second."""


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


def make_task(folder: Path, bag: Path | None, live_bag: Path | None, parts: list[str]) -> Task:
    """The recordings and parameter files; recordings that are not given are made once, if a part plays them."""
    made = []
    for name, given, more in (("short", bag, ()), ("live", live_bag, ("--image-rate", "30"))):
        path = given or folder / f"{name}.mcap"
        if not path.exists() and any((name == "live") == (part == "live") for part in parts if part in PLAYING):
            assert umf("simulate", path, "--duration", "40", "--seed", "3", *more).wait() == 0
        made.append(path)
    files = [folder / "light.yaml", folder / "whole.yaml"]
    for path, text in zip(files, (LIGHT, WHOLE), strict=True):
        path.write_text(text)
    return Task(folder, *made, *files)


def main(
    json_file: Annotated[Path, typer.Option("--json", help="Where the figures go.")],
    quick: Annotated[bool, typer.Option("--quick", help="A few of everything.")] = False,
    folder: Annotated[
        Path | None, typer.Option(help="Keeps what was found, to go on; default: a temporary one.")
    ] = None,
    only: Annotated[list[str] | None, typer.Option(help=f"Parts: {', '.join(PARTS)}. Default: all.")] = None,
    bag: Annotated[Path | None, typer.Option(help="A short simulated recording; default: one is made.")] = None,
    live_bag: Annotated[Path | None, typer.Option(help="One with 30 images per second; default: one is made.")] = None,
    seed: Annotated[int, typer.Option(help="Of kills and damage.")] = 1,
) -> None:
    """Measure what the package survives."""
    console = Console(soft_wrap=True)
    figures: Figures = {"fuzz_crashes": 0, "fuzz_uncounted": 0}
    with tempfile.TemporaryDirectory(prefix="umf_endurance_") as name:
        place = folder or Path(name)
        place.mkdir(parents=True, exist_ok=True)
        parts = only or [*PARTS]
        task = make_task(place.resolve(), bag, live_bag, parts)
        for part in parts:
            wanted = PARTS[part].quick if quick else PARTS[part].full
            figures = together(figures, run_part(part, wanted, task, seed, console))
    table = Table("figure", "value")
    for key in [*filter(figures.__contains__, KEYS.split()), *sorted(figures.keys() - set(KEYS.split()))]:
        table.add_row(key if key in KEYS.split() else f"({key})", str(figures[key]))
    console.print(table)
    json_file.write_text(json.dumps({key: figures.get(key) for key in KEYS.split()}, indent=2) + "\n")
    if figures.get("crossed_closures") or figures.get("missing_closures"):
        console.print("[red]closures crossed between robots, or were missing after a resumed replay")
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
