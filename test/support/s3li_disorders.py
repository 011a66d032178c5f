"""Take the disorders of S3LI's files out one by one: each has to be noticed by name, or harmless.

python test/support/s3li_disorders.py OUT [--seed 20001] [--only NAME,NAME]

Simulates one drive of 40 m of the twin for every disorder, without that disorder, and runs it as `umf s3li` does.
The readers expect each disorder: without it, positions in UTC are read as GPS time, and 0.1 s are added to scans that
are on time. A row holds the first lines that were printed about it, and the figures.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from umf_ros.core.errors import UmfError
from umf_ros.lab.datasets.s3li_folder import find_s3li
from umf_ros.lab.evaluation.s3li_run import in_own_process, replay_sequence
from umf_ros.lab.simulation import twin
from umf_ros.lab.simulation.twin_files import Disorders

ETNA, VULCANO = "s3li_loops", "capo_grillo"
LENGTHS_M = 40.0, 24.0
"""Of the drive and of its loop."""
AS_IT_IS = "none taken out"
SHOWN = ("closures_true", "closures_false", "pose_error_m", "ate_odometry_m", "ate_optimized_m")
NAMED = {"gps_time": "GPS time", "imu_frame": "odometry is not that of the body"}
"""Words of the line that names what is different, by disorder."""
WORSE = 2.0
"""Times an error of a trajectory, above which a change is not harmless."""


def run(folder: Path, seed: int, taken_out: str) -> dict[str, Any]:
    """Figures of one sequence without one disorder."""
    name = VULCANO if taken_out == "baseline" else ETNA
    disorders = Disorders() if taken_out == AS_IT_IS else replace(Disorders(), **{taken_out: False})
    with patch.multiple(twin, SHORTEST_M=LENGTHS_M[0], SHORTEST_LOOP_M=LENGTHS_M[1]):
        for _ in twin.write_twin(folder, seed, 0.01, (name,), disorders):
            pass
    sequence = find_s3li(folder).sequences[0]
    try:
        return dict(in_own_process(replay_sequence, sequence, folder / "run", report=lambda done: None))
    except UmfError as error:
        return {"warnings": [str(error)]}


def verdict(taken_out: str, found: dict[str, Any], plain: dict[str, Any]) -> str:
    """noticed, harmless or silent."""
    word = NAMED.get(taken_out)
    if word and any(word in line for line in found["warnings"]):
        return "noticed"
    worst = max((found.get(name) or 0) / max(plain.get(name) or 0, 0.1) for name in ("ate_optimized_m", "pose_error_m"))
    harmless = not found.get("closures_false") and found.get("closures_true") and worst < WORSE
    return "harmless" if harmless else "silent"


def row(taken_out: str, found: dict[str, Any], plain: dict[str, Any]) -> str:
    """A line of the table."""
    figures = " | ".join(str(found.get(name, "-")) for name in SHOWN)
    told = "; ".join(line[:90] for line in found["warnings"][:2])
    return f"| {taken_out} | {verdict(taken_out, found, plain)} | {figures} | {told} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=20_001)
    parser.add_argument("--only", default="")
    options = parser.parse_args(arguments)
    names = [one for one in options.only.split(",") if one] or [field.name for field in fields(Disorders)]
    print(f"| taken out | verdict | {' | '.join(SHOWN)} | said |\n|{'---|' * (len(SHOWN) + 3)}")
    plain: dict[str, Any] = {}
    for name in (AS_IT_IS, *names):
        found = run(options.out / name.replace(" ", "_"), options.seed, name)
        plain = plain or found
        print(row(name, found, plain), flush=True)


if __name__ == "__main__":
    main()
