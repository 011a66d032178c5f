"""Plants small faults of the calibration in recordings, and prints what the check of the sensors says.

    umf simulate seed20001.mcap --preset demo --seed 20001 --duration 45
    python benchmarks/accuracy/calibration_faults.py seed2000?.mcap

A baseline that is 1 % too long, a LiDAR turned by 1 degree about another axis in each recording, scans stamped 20 ms
late, and none of them. A fault is named by the line that is about it; "cannot tell" is counted apart.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "test"))
from support.planted_faults import SMALL_FAULTS, small_fault


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", type=Path, nargs="+")
    given = parser.parse_args()
    planted = named = unsure = false_alarms = 0
    print("| recording | planted | named | said |\n|---|---|---|---|")
    for number, bag in enumerate(given.bags):
        for name, word in SMALL_FAULTS.items():
            found = small_fault(bag, name, axis=number % 3)
            told = [one.what for one in found if one.severity != "note"]
            is_named = bool(word) and any(word in line for line in told)
            planted, named, false_alarms = (
                planted + bool(word),
                named + is_named,
                false_alarms + bool(told and not word),
            )
            unsure += bool(word) and not is_named and any("cannot tell" in one.what for one in found)
            row = [bag.stem, name, "yes" if is_named else "-" if not word else "no", "; ".join(told) or "-"]
            print(f"| {' | '.join(row)} |", flush=True)
    good = len(given.bags)
    print(f"\n{named} of {planted} named, {unsure} not told, {false_alarms} false alarms on {good} without a fault")
    sys.exit(named + unsure < planted or false_alarms > 0)


if __name__ == "__main__":
    main()
