"""What the package survives: kill -9, damaged input, long drives. Prints a table and writes it as JSON.

    python benchmarks/endurance.py --json endurance.json            (hours)
    python benchmarks/endurance.py --json endurance.json --quick    (minutes)

Replays are killed at random moments and resumed; the back-end is killed over DDS and started again; inputs are damaged
in a process of its own with 2 GB of memory. `live_p50_ms` and `live_p95_ms` need a recording played to both nodes and a
machine with nothing else to do: with --live.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from endurance_fuzz import some_keyframe
from endurance_live import kill_back_end, play_live
from rich.console import Console

from umf_ros.config import Database, Loop, load_settings
from umf_ros.frames import Embedding, LoopClosure
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, rover_loops
from umf_ros.places.database import PlaceDatabase
from umf_ros.pose_graph.pose_graph import PoseGraph

SETTINGS = """/**: {ros__parameters: {embedding: {method: thumbnail}, loop: {min_time_gap_s: 8.0, min_travel_m: 10.0},
keyframe: {min_translation_m: 0.2}}}
"""
FUZZ = Path(__file__).with_name("endurance_fuzz.py")


def umf(*words: str | Path) -> subprocess.Popen[bytes]:
    """The command as a process of its own."""
    silent = subprocess.DEVNULL
    return subprocess.Popen([sys.executable, "-m", "umf_ros.cli", *map(str, words)], stdout=silent, stderr=silent)


def rows(path: Path) -> list[dict[str, str]]:
    """Rows of a table."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def kill_replays(bag: Path, folder: Path, kills: int, rng: np.random.Generator) -> dict[str, int]:
    """Kill a replay at random moments, resume it, and compare what it leaves with an undisturbed run."""
    config = folder / "settings.yaml"
    config.write_text(SETTINGS)
    start = time.monotonic()
    assert umf("replay", bag, "--config", config, "--out", folder / "whole").wait() == 0
    whole_s = time.monotonic() - start
    expected = folder / "whole" / "latest"
    lost = duplicates = killed = 0
    while killed < kills:
        out = folder / f"cut_{killed}"
        while True:
            process = umf("replay", bag, "--config", config, "--out", out, "--resume")
            try:
                process.wait(whole_s * rng.uniform(0.2, 1.0) if killed < kills else None)
                break
            except subprocess.TimeoutExpired:
                os.kill(process.pid, signal.SIGKILL)
                process.wait()
                killed += 1
        found = out / "latest"
        stamps = {row["stamp_ns"] for row in rows(found / "keyframes.csv")}
        lost += len({row["stamp_ns"] for row in rows(expected / "keyframes.csv")} - stamps)
        pairs = Counter((row["query_stamp_ns"], row["match_stamp_ns"]) for row in rows(found / "closures.csv"))
        duplicates += pairs.total() - len(pairs)
        duplicates += len(rows(found / "keyframes.csv")) - len(stamps)
    return {"kills": killed, "lost_keyframes": lost, "duplicate_closures": duplicates}


def fuzz(part: str, count: int, folder: Path, *more: Path) -> Counter[str]:
    """Damage inputs in a process of their own; its sudden end is a crash."""
    command = [sys.executable, str(FUZZ), part, str(count), "1", str(folder / part), *map(str, more)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.stderr.write(done.stderr[-2000:])
        return Counter(crashes=1)
    sys.stderr.write(done.stderr)
    return Counter(json.loads(done.stdout))


def resident() -> int:
    """Bytes of memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def many_places(count: int, rng: np.random.Generator) -> dict[str, float]:
    """Memory per place, and the time of a query among them."""
    places = PlaceDatabase(Database(), "noise", 256)
    descriptors = rng.standard_normal((1000, 256)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    before = resident()
    blank = some_keyframe(0, rng)
    for number in range(count):
        seen = Embedding(descriptors[number % 1000])
        stamp_ns, session = number * 10**9, number // 1000
        places.add(replace(blank, stamp_ns=stamp_ns, embedding=seen, session=session, travelled_m=float(number)))
    used = resident() - before
    query = replace(some_keyframe(count * 10**9 + 10**12, rng), embedding=Embedding(descriptors[3]))
    times = []
    for _ in range(30):
        start = time.perf_counter()
        places.query(query, Loop())
        times.append(1e3 * (time.perf_counter() - start))
    return {"rss_bytes_per_keyframe": round(used / count), "query_ms_100k": round(float(np.median(times)), 2)}


def long_graph(poses: int) -> float:
    """Milliseconds, p50, of a closure that comes to a graph of so many poses."""
    world = rover_loops(poses, 10005)
    graph = PoseGraph(load_settings().pose_graph.model_copy(update={"max_gap_s": 3.0}))
    for k, pose in enumerate(world.odometry):
        graph.add_odometry(k * PERIOD_NS, pose)
    closures: list[LoopClosure] = [world.message(row) for row in range(len(world.closures))]
    graph.add_closures(closures[:-20])
    times = []
    for closure in closures[-20:]:
        start = time.perf_counter()
        graph.add_closure(closure)
        times.append(1e3 * (time.perf_counter() - start))
    return round(float(np.median(times)), 1)


def main(
    json_file: Annotated[Path, typer.Option("--json", help="Where the figures go.")],
    quick: Annotated[bool, typer.Option("--quick", help="A few of everything.")] = False,
    bag: Annotated[Path | None, typer.Option(help="A short simulated recording; default: one is made.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Play it to both nodes too, and measure.")] = False,
    seed: Annotated[int, typer.Option(help="Of kills and damage.")] = 1,
) -> None:
    """Measure what the package survives."""
    console = Console()
    rng = np.random.default_rng(seed)
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="umf_endurance_") as name:
        folder = Path(name)
        if bag is None:
            bag = folder / "short.mcap"
            assert umf("simulate", bag, "--duration", "30", "--seed", "3").wait() == 0
        figures |= kill_replays(bag, folder, 6 if quick else 200, rng)
        console.print(figures)
        figures |= kill_back_end(folder, 3 if quick else 40, 200 if quick else 2000, rng)
        console.print(figures)
        sizes = (
            {"messages": 2000, "bags": 60, "files": 60} if quick else {"messages": 20_000, "bags": 500, "files": 300}
        )
        outcomes = {
            part: fuzz(part, count, folder, *([bag] if part != "files" else [])) for part, count in sizes.items()
        }
        console.print(outcomes)
        figures |= {f"fuzz_{part}": count for part, count in sizes.items()}
        figures["fuzz_messages"] += figures.pop("fuzz_over_dds")
        figures["fuzz_crashes"] = sum(found["crashes"] + found["hangs"] for found in outcomes.values())
        figures["fuzz_crashes"] += figures.pop("crashes_over_dds")
        figures["fuzz_uncounted"] = outcomes["messages"]["uncounted"] + figures.pop("uncounted_over_dds")
        figures |= many_places(100_000, rng)
        figures["event_ms_20k"] = long_graph(20_000)
        figures |= play_live(bag, folder) if live else {"live_p50_ms": None, "live_p95_ms": None}
    console.print(figures)
    json_file.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
