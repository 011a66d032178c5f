"""Print latencies of the back-end at the end of a long drive, and its memory; with `--start`, those of a start.

`python benchmarks/scale/latency.py [--poses 20000] [--quick] [--start RECORDING]`

A node resumes a stored graph and receives the last 40 closures over DDS, with odometry at 20 Hz: its executor's longest
stall, the time from a closure to its verdict, memory and time to shut down. CPU times are of the graph alone. `--start`
prints the times from `umf replay` to the first keyframe of a recording in its run folder, of three starts.
"""

from __future__ import annotations

import argparse
import sqlite3
import subprocess
import sys
import tempfile
import time
from contextlib import closing, suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "robustness"))

from endurance_graph import Figures, live, one_by_one

NAMES = {
    "live_stall_ms_20k": "executor's longest stall, ms",
    "drive_event_cpu_ms_20k_p50": "CPU per closure, ms, p50",
    "drive_event_cpu_ms_20k_p95": "CPU per closure, ms, p95",
    "verdict_ms_20k_p50": "closure to verdict, ms, p50",
    "verdict_ms_20k_p95": "closure to verdict, ms, p95",
    "verdicts_missing": "closures without a verdict",
    "shutdown_s_20k": "shutdown, s",
    "memory_mb_20k": "memory of the node, MB",
}


def start_of_replay_s(recording: Path) -> float:
    """Seconds from `umf replay` to its first stored keyframe; NaN without one."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "umf_ros.cli", "replay", str(recording), "--out", folder]
        start = time.monotonic()
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            while process.poll() is None:
                for path in Path(folder).glob("*/run.sqlite"):
                    with suppress(sqlite3.OperationalError), closing(sqlite3.connect(path)) as run:
                        if run.execute("SELECT count(*) FROM keyframes").fetchone()[0]:
                            process.kill()
                            return time.monotonic() - start
                time.sleep(0.01)
    return float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=20_000, help="of the drive, one metre apart")
    parser.add_argument("--quick", action="store_true", help="2,000 poses")
    parser.add_argument("--start", type=Path, help="a recording: time the start of its replay instead")
    arguments = parser.parse_args()
    if arguments.start is not None:
        seconds = " ".join(f"{start_of_replay_s(arguments.start):.2f}" for _ in range(3))
        print(f"umf replay to the first keyframe, s: {seconds}")
        return
    poses = 2_000 if arguments.quick else arguments.poses
    with tempfile.TemporaryDirectory() as folder:
        figures: Figures = one_by_one(poses) | live(poses, Path(folder))
    for name, text in NAMES.items():
        print(f"{text:32s} {figures[name]:8.1f}")


if __name__ == "__main__":
    main()
