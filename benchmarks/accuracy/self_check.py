"""Wrong closures planted in runs, which are judged without truth (`umf judge`).

    python benchmarks/accuracy/self_check.py $(seq 20301 20312)      # 12 runs, 0 to 30 % of their closures wrong
    python benchmarks/accuracy/self_check.py 10001 10002 10003 10004 # those that the weights of the judge are fitted on

A run is a simulated drive of 95 m, a loop twice, with a LiDAR of 70 degrees alone. Planted are closures to any place,
groups of three to a wrong place, consistent with each other, and poses off by 1.5 to 4 m at the right place. Prints for
each run and over all: planted closures and those `named`, right ones by the truth and those `doubted`, the estimated
precision with its interval, and the true one. Recordings and runs stay in `--work`.
"""

from __future__ import annotations

import json
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import typer

from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import expmap, invert, relative
from umf_ros.core.trajectory import Trajectory
from umf_ros.lab.program import replay
from umf_ros.lab.simulation.bag_writer import BagWriter
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.presets import DEMO
from umf_ros.lab.simulation.simulator import Simulator, record
from umf_ros.runs.run_file import NAME, RunFile, closure_row, read_odometry_of
from umf_ros.runs.self_check import check_run
from umf_ros.runs.truth import judge_closures

SHARES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3)


def run_of(work: Path, seed: int) -> Path:
    """The run of a simulated drive, made unless it is there."""
    recording, run = work / f"{seed}.mcap", work / f"{seed}"
    if not recording.exists():
        simulator = Simulator(DEMO, seed, None, None, FAMILIES[seed % len(FAMILIES)])
        simulator.exposures = []
        with BagWriter(recording) as file:
            record(simulator, file, workers=1)
    if not (run / "summary.json").exists():
        run.mkdir(exist_ok=True)
        bag = open_bag(recording)
        replay(bag, settings_for(bag, None, "auto"), run)
    return run


def planted(own: list[LoopClosure], odometry: Trajectory, stamps: Any, count: int, seed: int) -> list[LoopClosure]:
    """Wrong closures between keyframes of a run, with covariances and probabilities of its own."""
    rng, found = np.random.default_rng(seed), list[LoopClosure]()
    while len(found) < count:
        model, kind = own[int(rng.integers(len(own)))], rng.integers(3)
        off = np.array([0.0, 0.0, np.pi * (rng.random() < 0.3) + rng.normal(0, 0.2), *rng.normal(0, 1.5, 2), 0.0])
        if kind == 0:  # beside the right pose
            way, turn = rng.uniform(-np.pi, np.pi), rng.uniform(0.15, 0.5) * rng.choice([-1.0, 1.0])
            beside = rng.uniform(1.5, 4.0) * np.array([np.cos(way), np.sin(way)])
            wrong = expmap(np.array([[0.0, 0.0, turn, *beside, 0.0]]))[0]
            found.append(replace(model, match_T_query=model.match_T_query @ wrong))
            continue
        first, second = np.sort(rng.choice(len(stamps) - 3, 2, replace=False))
        if second - first < len(stamps) // 6:
            continue
        pose = expmap(off[None])[0]
        for step in range(1 if kind == 1 else 3):  # a place, or a stretch of the way that looks like another
            match, query = stamps[[first + step, second + step]]
            poses = odometry.at(np.array([stamps[first], match, stamps[second], query]))[0]
            moved = invert(relative(poses[0], poses[1])) @ pose @ relative(poses[2], poses[3])
            model = replace(model, query_stamp_ns=int(query), match_stamp_ns=int(match))
            found.append(replace(model, match_T_query=moved))
    return found[:count]


def judged(work: Path, seed: int, share: float) -> dict[str, Any]:
    """Figures of one run with a share of planted closures."""
    run, truth = run_of(work, seed), read_ground_truth(open_bag(work / f"{seed}.mcap"))
    odometry = read_odometry_of(run)
    assert truth is not None and odometry is not None
    with TemporaryDirectory() as copied:
        for name in (NAME, "config.yaml"):
            shutil.copy(run / name, copied)
        with closing(RunFile(Path(copied))) as file:
            own, stamps = file.closures(), np.array([int(row[0]) for row in file.rows("keyframes")])
            wrong = planted(own, odometry, stamps, round(share / (1 - share) * len(own)), seed)
            with file.writing():
                file.append("closures", [closure_row(one, float("nan")) for one in wrong])
        found = check_run(Path(copied))
    is_planted, doubted = np.arange(len(found.closures)) >= len(own), found.probabilities < 0.5
    queries, matches = np.array([one.endpoints for one in found.closures], np.int64).T
    is_true = judge_closures(found.closures, truth.at(queries)[0], truth.at(matches)[0]).is_true
    masks = {"planted": is_planted & ~is_true, "right": ~is_planted & is_true, "own_wrong": ~is_planted & ~is_true}
    masks |= {"named": masks["planted"] & doubted, "doubted": masks["right"] & doubted}
    share, low, high = (round(one, 3) for one in found.precision)
    figures = {"precision": [share, low, high], "true_precision": round(float(is_true.mean()), 3)}
    inside = int(low <= is_true.mean() <= high)
    return {"seed": seed, **{name: int(mask.sum()) for name, mask in masks.items()}, **figures, "in_interval": inside}


def main(seeds: list[int], work: Path = Path("results/self_check")) -> None:
    """Print the figures of every run, and their sums."""
    work.mkdir(parents=True, exist_ok=True)
    runs = []
    for number, seed in enumerate(seeds):
        runs.append(judged(work, seed, SHARES[number % len(SHARES)]))
        print(json.dumps(runs[-1]), flush=True)
    print(json.dumps({name: sum(one[name] for one in runs) for name in runs[0] if isinstance(runs[0][name], int)}))


if __name__ == "__main__":
    typer.run(main)
