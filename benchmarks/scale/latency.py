"""Print latencies of the back-end at the end of a long drive, and its memory.

`python benchmarks/scale/latency.py [--poses 20000] [--quick]`

A node resumes a stored graph and receives the last 40 closures over DDS, with odometry at 20 Hz: its executor's longest
stall, the time from a closure to its verdict, memory and time to shut down. CPU times are of the graph alone.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=20_000, help="of the drive, one metre apart")
    parser.add_argument("--quick", action="store_true", help="2,000 poses")
    arguments = parser.parse_args()
    poses = 2_000 if arguments.quick else arguments.poses
    with tempfile.TemporaryDirectory() as folder:
        figures: Figures = one_by_one(poses) | live(poses, Path(folder))
    for name, text in NAMES.items():
        print(f"{text:32s} {figures[name]:8.1f}")


if __name__ == "__main__":
    main()
