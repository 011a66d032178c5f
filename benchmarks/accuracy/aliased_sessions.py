"""Sessions that share one graph, and as many wrong closures as right ones: what the joint graph believes.

    python benchmarks/accuracy/aliased_sessions.py --json F  # seconds each: five sessions, four kinds, ten worlds

A drive of 750 m is cut into five sessions, each with an origin of its own; wrong closures come in groups that agree
with each other, as where a world repeats itself: between places far apart (`groups`) or 3 to 15 m apart (`near`). They
are 30 % or 50 % of all. Counted are those between sessions: `wrong_between` are wrong ones that are believed.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from umf_ros.lab.simulation.pose_graphs import Kind
from umf_ros.lab.simulation.world import TEST

sys.path.insert(0, str(Path(__file__).parents[2] / "test"))
from support.aliased_sessions import judge

CASES: tuple[tuple[Kind, float], ...] = (("groups", 0.3), ("near", 0.3), ("groups", 0.5), ("near", 0.5))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two worlds")
    parser.add_argument("--seed", type=int, default=TEST.start + 1, help="seed of the first world")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    found = []
    for seed in range(arguments.seed, arguments.seed + (2 if arguments.quick else 10)):
        for kind, share in CASES:
            found.append(judge(seed, kind, share))
            print(json.dumps(found[-1]), flush=True)
    counts = ("wrong", "wrong_between", "right", "right_between")
    figures = {"graphs": len(found), **{name: sum(one[name] for one in found) for name in counts}}
    figures["ate_joint_m_median"] = round(float(np.median([one["ate_joint_m"] for one in found])), 3)
    print(json.dumps(figures, indent=2))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures | {"all": found}, indent=2) + "\n")


if __name__ == "__main__":
    main()
