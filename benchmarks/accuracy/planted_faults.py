"""Plants ten faults in recordings or their settings, and prints the first sentence of each report.

    python benchmarks/accuracy/planted_faults.py data/demo_seed1.mcap --out /tmp/planted
    python benchmarks/accuracy/planted_faults.py data/demo_seed1.mcap --offsets  # what clocks are measured to be off
    python benchmarks/accuracy/planted_faults.py *.mcap --good  # what is said of recordings as they are
    python benchmarks/accuracy/planted_faults.py *.mcap --axes  # when impossible axes are named

Each run must name its own fault, and the run without a fault none.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag

sys.path.insert(0, str(Path(__file__).parents[2] / "test"))
from support.planted_faults import (
    axes_faults,
    first_contradiction,
    first_sentences,
    measured_offset,
    print_findings,
)

OFFSETS_S = (-1.0, -0.5, -0.2, -0.1, 0.0, 0.1, 0.2, 0.5, 1.0)


def print_offsets(path: Path, sensors: Sequence[str]) -> bool:
    """Print planted and measured offsets; returns whether all are within a tenth of a second."""
    bag, good = open_bag(path), True
    for sensor in sensors:
        for seconds in OFFSETS_S:
            found = measured_offset(bag, sensor, seconds)
            good &= found is not None and abs(found - seconds) < 0.1
            told = "nothing said" if found is None else f"{found:+.2f} s measured"
            print(f"{path.stem} {sensor}: {seconds:+.1f} s planted, {told}", flush=True)
    return good


def print_axes(path: Path, out: Path, only: str) -> bool:
    """Print when impossible axes are named; returns whether all are before the first closure, and none without one."""
    bag, wrong = open_bag(path), 0
    settings = settings_for(bag, None, "auto")
    for fault in axes_faults(settings):
        if only not in fault.name:
            continue
        after_s, what = first_contradiction(bag, fault, out / "axes", settings.loop.min_time_gap_s)
        right = all(word in what for word in fault.words) and bool(what) == bool(fault.words)
        wrong += not right
        print(f"{'ok  ' if right else 'MISS'} {path.stem} {fault.name}: {after_s:.1f} s, {what or '-'}", flush=True)
    return not wrong


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("results/planted_faults"))
    parser.add_argument("--only", default="", help="faults whose names contain this")
    parser.add_argument("--settings", default="{}", help="further settings as JSON")
    parser.add_argument("--offsets", action="store_true", help="only measure clock offsets of -1 to 1 s")
    parser.add_argument("--sensors", default="lidar,camera", help="sensors whose clocks are shifted")
    parser.add_argument("--good", action="store_true", help="only check recordings without faults")
    parser.add_argument("--axes", action="store_true", help="only check when impossible axes are named")
    given = parser.parse_args()
    if given.axes:
        sys.exit(not all([print_axes(path, given.out / path.stem, given.only) for path in given.bags]))
    if given.offsets:
        sys.exit(not all([print_offsets(path, given.sensors.split(",")) for path in given.bags]))
    if given.good:
        sys.exit(not all([print_findings(path) for path in given.bags]))
    sys.exit(not all([print_faults(path, given.out / path.stem, given) for path in given.bags]))


def print_faults(path: Path, out: Path, given: argparse.Namespace) -> bool:
    """Print the first sentence of every fault's report; returns whether all are named, and none where there is none."""
    named = total = wrong = 0
    for fault, status, sentence in first_sentences(path, out, json.loads(given.settings), given.only):
        right = all(word.lower() in sentence.lower() for word in fault.words) and bool(fault.words or status == 0)
        named, total = named + (right and fault.name != "none"), total + (fault.name != "none")
        wrong += not right
        print(f"{'ok  ' if right else 'MISS'} {status} {fault.name}: {sentence}", flush=True)
    print(f"{path.stem}: {named} of {total} faults named")
    return not wrong


if __name__ == "__main__":
    main()
