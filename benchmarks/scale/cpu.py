"""CPU time of a replay per scan, and where it is spent: the median of three replays of one simulated drive.

`make bench`, or `python benchmarks/scale/cpu.py [RECORDING] [--runs 3]`

Without a recording, demo seed 1 is simulated. Each replay is a process of its own with one thread for each network, so
its CPU time holds start and report as well. The parts are wall times of the steps of keyframes (`latencies.csv`).
"""

from __future__ import annotations

import csv
import json
import os
import tempfile
from pathlib import Path

import numpy as np

from umf_ros.lab.program import parser_of, umf, write_figures

os.environ["OMP_NUM_THREADS"] = "1"


def replay(recording: Path, folder: Path) -> dict[str, float]:
    """Return the figures of one replay: CPU and wall time, of keyframes and their steps, and memory."""
    ended = umf("replay", recording, "--out", folder)
    summary = json.loads((folder / "latest" / "summary.json").read_text(encoding="utf-8"))
    with (folder / "latest" / "latencies.csv").open(encoding="utf-8") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    scans = summary["frames"]
    parts = [name for name in rows[0] if name != "stamp_ns"]
    return {
        "scans": scans,
        "keyframes": len(rows),
        "CPU per scan, ms": 1e3 * ended.cpu_s / scans,
        "times real time": 1e-9 * (rows[-1]["stamp_ns"] - rows[0]["stamp_ns"]) / ended.wall_s,
        **{f"{name}, ms": float(np.median([row[name] for row in rows])) for name in parts},
        "keyframe, ms, p95": float(np.percentile([row["total"] for row in rows], 95)),
        "memory, MB": ended.memory_mb,
    }


def main() -> None:
    """Print the medians."""
    parser = parser_of(__doc__)
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recording = given.recording or Path(folder) / "demo.mcap"
        if given.recording is None:
            umf("simulate", recording, "--preset", "demo", "--seed", "1")
        runs = [replay(recording, Path(folder) / str(number)) for number in range(given.runs)]
    medians = {name: float(np.median([run[name] for run in runs])) for name in runs[0]}
    for name, value in medians.items():
        print(f"{name:24} {value:.4g}")
    write_figures(given.json, medians)


if __name__ == "__main__":
    main()
