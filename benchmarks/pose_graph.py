"""How well the pose graph resists wrong closures, and what it costs.

`python benchmarks/pose_graph.py [--quick] [--seed N] [--jobs N] [--json FILE] [FILES.g2o ...]`

Generated graphs and, if given, g2o files (their closures count as right) get 0 to 50 % wrong
closures: far at random, in groups that agree with each other, and as such groups to similar places
close by. Some have odometry that is wrong in one direction all the time, or but one closure at the end of a long
way (figures named hard). Times are CPU time of this process, which is wall time on a quiet core and does not depend
on what else the machine does.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import gtsam
import numpy as np

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array, invert
from umf_ros.lab.datasets.g2o import PERIOD_NS, as_recording, read_g2o
from umf_ros.lab.simulation.pose_graphs import (
    WORLDS,
    GraphWorld,
    Kind,
    WorldClosure,
    rover_loops,
    with_bias,
    with_lone_end,
    with_wrong_closures,
)
from umf_ros.pose_graph.closures import State
from umf_ros.pose_graph.pose_graph import PoseGraph
from umf_ros.pose_graph.solver import Edge, between

FIRST_SEED = 20_000
MOST_CLOSURES_OF_A_FILE = 1500
MOST_SOLUTIONS_OF_A_FILE = 150
SETTINGS = PoseGraphSettings(keyframe_spacing_m=1e-6, max_gap_s=1.5, max_closure_m=1e7)
BELIEVING = SETTINGS.model_copy(update={"reject_outliers": False})
KINDS: tuple[Kind, ...] = ("random", "groups", "near")
# per metre; a tenth of it is what the stated noise makes of a hundred metres
BIAS = np.array([0, 0, np.deg2rad(0.1), 0.01, 0, 0])


@dataclass(frozen=True)
class Outcome:
    """One run: shares of closures, RMS position error in metres, seconds of CPU per event."""

    precision: float
    recall: float
    error_m: float
    transient_wrong: float
    seconds: Array


def drive(
    world: GraphWorld, reference: Array, stated: float = 1.0, settings: PoseGraphSettings = SETTINGS, batch: int = 1
) -> Outcome:
    """Feed a world in order; `stated` multiplies the odometry's stated standard deviations."""
    graph, vertex, seconds, wrong_events = PoseGraph(settings), 0, [], 0
    right = {(c.first * PERIOD_NS, c.second * PERIOD_NS): c.right for c in world.closures}
    for start in range(0, len(world.closures), batch):
        rows = range(start, min(start + batch, len(world.closures)))
        vertex = feed_odometry(graph, world, vertex, world.closures[rows[-1]].second + 1, stated)
        before = time.process_time()
        graph.add_closures([world.message(row) for row in rows])
        graph.map_T_odom()
        seconds.append(time.process_time() - before)
        wrong_events += not all(judged(graph, right))
    feed_odometry(graph, world, vertex, len(world.truth), stated)
    graph.settle()
    accepted = judged(graph, right)
    stamps, poses = graph.trajectory()
    error = poses[:, :3, 3] - reference[stamps // PERIOD_NS, :3, 3]
    return Outcome(
        sum(accepted) / max(len(accepted), 1),
        sum(accepted) / max(sum(right.values()), 1),
        float(np.sqrt((error**2).sum(axis=1).mean())),
        wrong_events / max(len(seconds), 1),
        np.array(seconds),
    )


def feed_odometry(graph: PoseGraph, world: GraphWorld, start: int, end: int, stated: float) -> int:
    for k in range(start, end):
        if k and k in world.chains:
            graph.begin_session()
        covariance = world.step_covariance(k)
        graph.add_odometry(k * PERIOD_NS, world.odometry[k], None if covariance is None else covariance * stated**2)
    return max(start, end)


def judged(graph: PoseGraph, right: dict[tuple[int, int], bool]) -> list[bool]:
    """Whether each accepted closure is right."""
    accepted = [v.closure for v in graph.closures() if v.state is State.ACCEPTED]
    return [right[c.match_stamp_ns, c.query_stamp_ns] for c in accepted]


def batch_optimum(world: GraphWorld, initial: Array) -> tuple[Array, float]:
    """(N, 4, 4) Levenberg-Marquardt optimum of odometry and right closures, and its seconds of CPU."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    steps = invert(world.odometry[:-1]) @ world.odometry[1:]
    for k, pose in enumerate(initial):
        values.insert(k, gtsam.Pose3(pose))
        if k not in world.chains:
            graph.add(between(Edge(k - 1, k, steps[k - 1], world.step_covariances[k])))
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(world.odometry[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    for closure in world.closures:
        if closure.right:
            graph.add(between(Edge(closure.first, closure.second, closure.pose, closure.covariance)))
    before = time.process_time()
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    seconds = time.process_time() - before
    return np.stack([result.atPose3(k).matrix() for k in range(len(initial))]), seconds


def optimum_near_truth(world: GraphWorld) -> Array:
    """The outlier-free optimum, reached to the last digit by starting again from where it was found."""
    poses = world.truth
    for _ in range(3):
        poses, _ = batch_optimum(world, poses)
    return poses


class Cell(NamedTuple):
    """What a world is tried with: share and kind of wrong closures, and the factor on the stated odometry noise."""

    share: float
    kind: Kind
    stated: float


@dataclass(frozen=True)
class Trial:
    """A world with the cells it is driven through; closures come in batches; whether its figures are the hard ones."""

    name: str
    world: GraphWorld
    cells: list[Cell]
    batch: int = 1
    hard: bool = False


def generated(first_seed: int, quick: bool) -> list[Trial]:
    """Generated worlds with their cells."""
    full = [("rover", 400), ("garage", 1000), ("sphere", 1000), ("rover", 5000)]
    chosen = [("rover", 400), ("garage", 500), ("sphere", 400)] if quick else full
    seeds = range(first_seed, first_seed + (1 if quick else 5))
    trials = [
        Trial(f"{name} {size} seed {seed}", WORLDS[name](size, seed), cells(quick, misscaled=True))
        for name, size in chosen
        for seed in seeds
    ]
    if quick:
        trials.append(Trial(f"rover 5000 seed {first_seed}", rover_loops(5000, first_seed), cells(True, False)))
    return trials + [
        trial for seed in range(first_seed, first_seed + 5) for trial in hard(rover_loops(400, seed), seed)
    ]


def hard(world: GraphWorld, seed: int) -> list[Trial]:
    """The world with what its stated noise does not tell, and with a last closure that no other supports."""
    chosen = [Cell(0.0, "random", 1.0), *(Cell(0.5, kind, 1.0) for kind in KINDS)]
    return [
        Trial(f"biased seed {seed}", with_bias(world, BIAS), chosen, hard=True),
        Trial(f"biased back seed {seed}", with_bias(world, -BIAS), chosen, hard=True),
        Trial(f"lone end seed {seed}", with_lone_end(world), chosen, hard=True),
    ]


def from_file(path: Path, quick: bool) -> Trial:
    """A g2o file as a world whose truth is its own optimum."""
    recording = as_recording(read_g2o(path))
    chosen = np.unique(np.linspace(0, len(recording.closures) - 1, MOST_CLOSURES_OF_A_FILE).astype(int))
    edges = [recording.closures[row] for row in chosen] if len(recording.closures) else []
    closures = [WorldClosure(e.first, e.second, e.pose, e.covariance, True) for e in edges]
    world = GraphWorld(recording.odometry, recording.odometry, recording.steps, closures, tuple(recording.chains))
    graph = PoseGraph(BELIEVING)
    feed_odometry(graph, world, 0, len(world.truth), 1.0)
    graph.add_closures([world.message(row) for row in range(len(closures))])
    graph.settle()
    stamps, poses = graph.trajectory()
    truth = recording.odometry.copy()
    truth[stamps // PERIOD_NS] = poses
    batch = max(1, len(closures) // MOST_SOLUTIONS_OF_A_FILE)
    return Trial(f"file {path.name}", replace(world, truth=truth), cells(quick, misscaled=False), batch)


def cells(quick: bool, misscaled: bool) -> list[Cell]:
    """Every combination; noise is mis-stated where most is wrong."""
    shares = (0.5,) if quick else (0.1, 0.3, 0.5)
    chosen = [Cell(0.0, "random", 1.0)] + [Cell(share, kind, 1.0) for kind in KINDS for share in shares]
    return chosen + [Cell(shares[-1], kind, stated) for kind in KINDS for stated in (1 / 3, 3.0) if misscaled]


def try_world(trial: Trial) -> list[tuple[Cell, Outcome]]:
    """Drive a world through its cells."""
    reference = optimum_near_truth(trial.world)
    outcomes = []
    for cell in trial.cells:
        world = with_wrong_closures(trial.world, cell.share, cell.kind, 1) if cell.share else trial.world
        outcomes.append((cell, drive(world, reference, cell.stated, batch=trial.batch)))
    return outcomes


def resist(trials: list[Trial], jobs: int) -> dict[str, float]:
    """Every cell of every trial; prints them as they are done."""
    columns = f"{'graph':26s} {'wrong':>10s} {'stated':>7s} {'precision':>9s} {'recall':>7s} {'error m':>8s}"
    print(f"{columns} {'transient':>9s}")
    plain: list[Outcome] = []
    misscaled: list[Outcome] = []
    hardest: list[Outcome] = []
    with ProcessPoolExecutor(jobs) as pool:
        tried = {pool.submit(try_world, trial): trial for trial in trials}
        for done in as_completed(tried):
            trial = tried[done]
            for cell, outcome in done.result():
                (hardest if trial.hard else plain if cell.stated == 1 else misscaled).append(outcome)
                label = f"{cell.share:.0%} {cell.kind}" if cell.share else "none"
                head = f"{trial.name:26s} {label:>10s} {f'x {cell.stated:.2f}':>7s}"
                numbers = f"{outcome.precision:9.3f} {outcome.recall:7.3f} {outcome.error_m:8.4f}"
                print(f"{head} {numbers} {outcome.transient_wrong:9.3f}", flush=True)
    return {
        "precision_worst": min(outcome.precision for outcome in plain),
        "recall_worst": min(outcome.recall for outcome in plain),
        "error_worst_m": max(outcome.error_m for outcome in plain),
        "transient_wrong_share_worst": max(outcome.transient_wrong for outcome in plain),
        "misscaled_error_worst_m": max(outcome.error_m for outcome in misscaled),
        "misscaled_precision_worst": min(outcome.precision for outcome in misscaled),
        "hard_precision_worst": min(outcome.precision for outcome in hardest),
        "hard_recall_worst": min(outcome.recall for outcome in hardest),
        "hard_error_worst_m": max(outcome.error_m for outcome in hardest),
    }


def cost(seed: int) -> dict[str, float]:
    """Milliseconds per event over the last fifth of drives of 1,000, 5,000 and 10,000 poses, 30 % grouped wrong."""
    print(f"\n{'poses':>6s} {'events':>6s} {'p50 ms':>7s} {'p95 ms':>7s} {'full LM ms':>10s} {'ratio':>6s}")
    medians: dict[int, float] = {}
    result: dict[str, float] = {}
    for size in (1000, 5000, 10000):
        world = with_wrong_closures(rover_loops(size, seed), 0.3, "groups", 1)
        seconds = drive(world, world.truth).seconds
        late = 1e3 * seconds[[closure.second >= 0.8 * size for closure in world.closures]]
        p50, p95 = np.percentile(late, [50, 95])
        full = 1e3 * min(batch_optimum(world, world.odometry)[1] for _ in range(3))
        medians[size] = float(p50)
        print(f"{size:6d} {len(late):6d} {p50:7.1f} {p95:7.1f} {full:10.0f} {p50 / full:6.3f}", flush=True)
        if size == 5000:
            result = {"event_ms_p50_5k": float(p50), "event_ms_p95_5k": float(p95), "ratio_to_lm_5k": float(p50 / full)}
    return result | {"growth_1k_10k": medians[10000] / medians[1000]}


def equality(worlds: list[GraphWorld]) -> dict[str, float]:
    """Largest RMS distance to the batch optimum in mm with nothing wrong and everything accepted."""
    errors = [drive(world, optimum_near_truth(world), settings=BELIEVING, batch=20).error_m for world in worlds]
    return {"batch_equality_mm": 1e3 * max(errors)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, help="g2o files to try as well")
    parser.add_argument("--quick", action="store_true", help="fewer and smaller graphs")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="seed of the first generated graph")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="worlds that are driven at a time")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    # the cost first, while nothing else of ours runs
    costs = cost(arguments.seed)
    trials = generated(arguments.seed, arguments.quick)
    files = [from_file(path, arguments.quick) for path in arguments.files]
    print()
    figures = resist(trials + files, arguments.jobs) | costs
    figures |= equality([trial.world for trial in trials if trial.name.endswith(f"seed {arguments.seed}")])
    print()
    for name, value in figures.items():
        print(f"{name:32s} {value:.4g}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
