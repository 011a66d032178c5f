"""How well the pose graph resists wrong closures, and what it costs.

`python benchmarks/accuracy/pose_graph.py [--quick] [--seed N] [--jobs N] [--json FILE] [FILES.g2o ...]`
`python benchmarks/accuracy/pose_graph.py --short 20 [--seed N] [--json FILE]`

Generated graphs and, if given, g2o files (their closures count as right) get 0 to 50 % wrong
closures: far at random, in groups that agree with each other, and as such groups to similar places
close by. Some have odometry that is wrong in one direction all the time, or but one closure at the end of a long
way (figures named hard). Times are CPU time of this process, which is wall time on a quiet core and does not depend
on what else the machine does.

Two standard methods run on the same worlds, as a batch over the whole graph: graduated non-convexity (`gnc`, GTSAM's
GncLMOptimizer with truncated least squares, odometry as known inliers) [Yang 2020] and pairwise consistency
maximisation (`pcm`, the largest set of pairwise consistent closures, then Levenberg-Marquardt) [Mangelson 2018].
`gnc_scaled` and `pcm_scaled` multiply the stated covariances by the noise scale that the back-end estimated in the
same world.

With `--short`, as many drives of one short revisit instead: their odometry is stated as surely as it is, or 3, 10 or 30
times too surely, and its constant errors are not stated; or it jumps once by 1 or 1.9 m in the middle, between two
messages. Each runs without wrong closures and with as many groups of near ones.
"""

from __future__ import annotations

import os
import time
from argparse import Namespace
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array, adjoint, expmap, invert, logmap, propagate
from umf_ros.core.trajectory import interpolated
from umf_ros.lab.datasets.g2o import read_g2o
from umf_ros.lab.datasets.graph_recording import PERIOD_NS, as_recording
from umf_ros.lab.program import parser_of, write_figures
from umf_ros.lab.simulation.pose_graphs import (
    WORLDS,
    GraphWorld,
    Kind,
    WorldClosure,
    rover_loops,
    short_revisit,
    with_bias,
    with_lone_end,
    with_wrong_closures,
)
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import State
from umf_ros.pose_graph.consistency import NoiseScale
from umf_ros.pose_graph.solver import between

FIRST_SEED = 20_000
MOST_CLOSURES_OF_A_FILE = 1500
MOST_SOLUTIONS_OF_A_FILE = 150
SETTINGS = PoseGraphSettings(keyframe_spacing_m=1e-6, max_gap_s=1.5, max_closure_m=1e7)
BELIEVING = SETTINGS.model_copy(update={"reject_outliers": False})
KINDS: tuple[Kind, ...] = ("random", "groups", "near")
# per metre; a tenth of it is what the stated noise makes of a hundred metres
BIAS = np.array([0, 0, np.deg2rad(0.1), 0.01, 0, 0])
SHORT = [(1, 0.0), (3, 0.0), (10, 0.0), (30, 0.0), (1, 1.0), (1, 1.9)]
"""Short drives: how many times too surely the odometry is stated, and the jump in m."""
MESSAGES_PER_POSE = 20


STATED = NoiseScale()
"""Covariances as they are stated."""


@dataclass(frozen=True)
class Outcome:
    """One run: shares of closures, RMS position error in metres, seconds of CPU per event."""

    precision: float
    recall: float
    error_m: float
    transient_wrong: float
    seconds: Array
    scale: NoiseScale = STATED


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
        graph.scale,
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


def odometry_graph(world: GraphWorld, scale: NoiseScale = STATED) -> gtsam.NonlinearFactorGraph:
    """The world's odometry as a chain with an anchored first pose; N factors, the anchor last."""
    graph = gtsam.NonlinearFactorGraph()
    steps = invert(world.odometry[:-1]) @ world.odometry[1:]
    for k in range(len(world.odometry)):
        if k not in world.chains:
            graph.add(between(k - 1, k, steps[k - 1], scale.odometry**2 * world.step_covariances[k]))
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(world.odometry[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    return graph


def closure_factor(closure: WorldClosure, scale: NoiseScale = STATED) -> gtsam.BetweenFactorPose3:
    return between(closure.first, closure.second, closure.pose, scale.closures**2 * closure.covariance)


def as_values(poses: Array) -> gtsam.Values:
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(k, gtsam.Pose3(pose))
    return values


def as_poses(values: gtsam.Values) -> Array:
    return np.stack([values.atPose3(k).matrix() for k in range(values.size())])


def batch_optimum(world: GraphWorld, initial: Array) -> tuple[Array, float]:
    """(N, 4, 4) Levenberg-Marquardt optimum of odometry and right closures, and its seconds of CPU."""
    graph, values = odometry_graph(world), as_values(initial)
    for closure in world.closures:
        if closure.right:
            graph.add(closure_factor(closure))
    before = time.process_time()
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    seconds = time.process_time() - before
    return as_poses(result), seconds


def solve_gnc(world: GraphWorld, scale: NoiseScale) -> tuple[NDArray[np.bool_], Array]:
    """(M,) closures that graduated non-convexity accepts, and its (N, 4, 4) poses."""
    graph = odometry_graph(world, scale)
    known = list(range(graph.size()))
    for closure in world.closures:
        graph.add(closure_factor(closure, scale))
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(known)
    optimizer = gtsam.GncLMOptimizer(graph, as_values(world.odometry), parameters)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    poses = as_poses(optimizer.optimize())
    return np.asarray(optimizer.getWeights())[len(known) :] > 0.5, poses


def solve_pcm(world: GraphWorld, scale: NoiseScale) -> tuple[NDArray[np.bool_], Array]:
    """(M,) closures of the largest pairwise consistent set, and the (N, 4, 4) optimum with them."""
    chosen = largest_clique(pairwise_consistent(world, scale))
    graph = odometry_graph(world, scale)
    for row in np.flatnonzero(chosen):
        graph.add(closure_factor(world.closures[row], scale))
    values, parameters = as_values(world.odometry), gtsam.LevenbergMarquardtParams()
    return chosen, as_poses(gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize())


def pairwise_consistent(world: GraphWorld, scale: NoiseScale) -> NDArray[np.bool_]:
    """(M, M) whether the loop through two closures and the odometry between their endpoints closes."""
    steps = propagate(adjoint(world.odometry), scale.odometry**2 * world.step_covariances)
    steps[list(world.chains)] = 0
    noise = np.cumsum(steps, axis=0)
    first = np.array([closure.first for closure in world.closures], int)
    second = np.array([closure.second for closure in world.closures], int)
    poses = np.array([closure.pose for closure in world.closures]).reshape(-1, 4, 4)
    own = scale.closures**2 * np.array([closure.covariance for closure in world.closures]).reshape(-1, 6, 6)
    consistent = np.zeros((len(first), len(first)), bool)
    for row in range(len(first)):
        # from the match of `row` through its query, the query and the match of each other closure, and back
        last = invert(world.odometry[first]) @ world.odometry[first[row]]
        before = invert(poses) @ last
        after = invert(world.odometry[second[row]]) @ world.odometry[second] @ before
        walks = [(second[row], second, second), (first, np.full(len(first), first[row]), first[row])]
        covariance = propagate(adjoint(invert(after)), own[row]) + propagate(
            adjoint(invert(last)) @ adjoint(poses), own
        )
        for (start, end, at), back in zip(walks, (invert(before), np.eye(4)), strict=True):
            sign = np.where(np.asarray(start) <= np.asarray(end), 1.0, -1.0)[:, None, None]
            walked = propagate(adjoint(invert(world.odometry[at])), sign * (noise[end] - noise[start]))
            covariance = covariance + (walked if back.ndim == 2 else propagate(adjoint(back), walked))
        residuals = logmap(poses[row] @ after)
        distances = np.einsum("ni,ni->n", residuals, np.linalg.solve(covariance, residuals[..., None])[..., 0])
        consistent[row] = distances <= SETTINGS.pair_chi2
    return consistent & consistent.T


def largest_clique(consistent: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(M,) members of a large clique: from each vertex on, the neighbour with most candidates left comes next."""
    best = np.zeros(len(consistent), bool)
    joined = consistent & ~np.eye(len(consistent), dtype=bool)
    for row in np.argsort(-joined.sum(axis=0), kind="stable"):
        if joined[row].sum() < best.sum():
            break
        clique, candidates = np.zeros(len(consistent), bool), joined[row].copy()
        clique[row] = True
        while candidates.any() and clique.sum() + candidates.sum() > best.sum():
            rows = np.flatnonzero(candidates)
            chosen = rows[np.argmax(joined[np.ix_(rows, rows)].sum(axis=0))]
            clique[chosen] = True
            candidates &= joined[chosen]
        if not candidates.any() and clique.sum() > best.sum():
            best = clique
    return best


PEERS: dict[str, Callable[[GraphWorld, NoiseScale], tuple[NDArray[np.bool_], Array]]] = {
    "gnc": solve_gnc,
    "pcm": solve_pcm,
}


def run_peers(world: GraphWorld, reference: Array, stated: float, scale: NoiseScale) -> dict[str, Outcome]:
    """The standard methods in one cell, with the stated covariances and with those that `scale` corrects."""
    if len(world.chains) > 1:  # both start from one chain of odometry
        return {}
    world = replace(world, step_covariances=stated**2 * world.step_covariances)
    right = np.array([closure.right for closure in world.closures])
    outcomes: dict[str, Outcome] = {}
    for name, solve in PEERS.items():
        for suffix, factors in (("", STATED), ("_scaled", scale)):
            if suffix and scale == STATED:
                outcomes[name + suffix] = outcomes[name]
                continue
            before = time.process_time()
            accepted, poses = solve(world, factors)
            seconds = time.process_time() - before
            error = poses[:, :3, 3] - reference[:, :3, 3]
            outcomes[name + suffix] = Outcome(
                float(right[accepted].mean()) if accepted.any() else 1.0,
                float(accepted[right].mean()) if right.any() else 1.0,
                float(np.sqrt((error**2).sum(axis=1).mean())),
                0.0,
                np.array([seconds]),
            )
    return outcomes


def optimum_near_truth(world: GraphWorld) -> Array:
    """The outlier-free optimum, reached to the last digit by starting again from where it was found."""
    poses = world.truth
    for _ in range(3):
        poses, _ = batch_optimum(world, poses)
    return poses


class Cell(NamedTuple):
    """Conditions of a drive: share and kind of wrong closures, and the factor on the stated odometry noise."""

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


def try_world(trial: Trial) -> list[tuple[Cell, dict[str, Outcome]]]:
    """Drive a world through its cells; outcomes by method, the back-end's under an empty name."""
    reference = optimum_near_truth(trial.world)
    outcomes = []
    for cell in trial.cells:
        world = with_wrong_closures(trial.world, cell.share, cell.kind, 1) if cell.share else trial.world
        ours = drive(world, reference, cell.stated, batch=trial.batch)
        outcomes.append((cell, {"": ours} | run_peers(world, reference, cell.stated, ours.scale)))
    return outcomes


def resist(trials: list[Trial], jobs: int) -> dict[str, float]:
    """Every cell of every trial; prints them as they are done."""
    columns = f"{'graph':26s} {'wrong':>10s} {'stated':>7s} {'method':>10s} {'precision':>9s} {'recall':>7s}"
    print(f"{columns} {'error m':>8s} {'transient':>9s}")
    found: dict[str, list[tuple[str, Outcome]]] = {}
    with ProcessPoolExecutor(jobs) as pool:
        tried = {pool.submit(try_world, trial): trial for trial in trials}
        for done in as_completed(tried):
            trial = tried[done]
            for cell, outcomes in done.result():
                group = "hard" if trial.hard else "plain" if cell.stated == 1 else "misscaled"
                label = f"{cell.share:.0%} {cell.kind}" if cell.share else "none"
                for method, outcome in outcomes.items():
                    found.setdefault(method, []).append((group, outcome))
                    head = f"{trial.name:26s} {label:>10s} {f'x {cell.stated:.2f}':>7s} {method or 'umf_ros':>10s}"
                    numbers = f"{outcome.precision:9.3f} {outcome.recall:7.3f} {outcome.error_m:8.4f}"
                    print(f"{head} {numbers} {outcome.transient_wrong:9.3f}", flush=True)
    figures: dict[str, float] = {}
    for method, grouped in found.items():
        figures |= {f"{method}_{name}".lstrip("_"): value for name, value in worst(grouped).items()}
    return figures


def worst(outcomes: list[tuple[str, Outcome]]) -> dict[str, float]:
    """The worst figures of one method by group of cells."""
    plain, misscaled, hardest = (
        [outcome for group, outcome in outcomes if group == name] for name in ("plain", "misscaled", "hard")
    )
    return {
        "precision_worst": min(outcome.precision for outcome in plain),
        "recall_worst": min(outcome.recall for outcome in plain),
        "error_worst_m": max(outcome.error_m for outcome in plain),
        "transient_wrong_share_worst": max(outcome.transient_wrong for outcome in plain),
        "misscaled_error_worst_m": max(outcome.error_m for outcome in misscaled),
        "misscaled_precision_worst": min(outcome.precision for outcome in misscaled),
        "misscaled_recall_worst": min(outcome.recall for outcome in misscaled),
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


def short(first_seed: int, count: int) -> dict[str, float]:
    """Drives of one short revisit; shares of the right closures accepted and wrong ones accepted of each case."""
    print(f"{'stated':>7s} {'jump m':>7s} {'wrong':>10s} {'right accepted':>14s} {'all':>5s} {'wrong accepted':>14s}")
    figures: dict[str, float] = {}
    for sure, jump_m in SHORT:
        for share in (0.0, 0.5):
            accepted, right = [], 0
            for seed in range(first_seed, first_seed + count):
                world = short_revisit(seed)
                world = with_wrong_closures(world, share, "near", seed) if share else world
                right += sum(closure.right for closure in world.closures)
                accepted += drive_short(world, sure, jump_m, seed)
            label = f"{share:.0%} near" if share else "none"
            wrong = len(accepted) - sum(accepted)
            print(
                f"{f'/ {sure}':>7s} {jump_m:7.1f} {label:>10s} {sum(accepted):14d} {right:5d} {wrong:14d}", flush=True
            )
            name = f"short_{label.replace('50% ', '')}_stated_{sure}_jump_{jump_m:g}"
            figures |= {f"{name}_recall": sum(accepted) / right, f"{name}_wrong": float(wrong)}
    return figures


def drive_short(world: GraphWorld, sure: float, jump_m: float, seed: int) -> list[bool]:
    """Whether each accepted closure is right; messages of odometry come 20 times a pose and state no covariances."""
    stamps = np.arange(0, (len(world.truth) - 1) * PERIOD_NS + 1, PERIOD_NS // MESSAGES_PER_POSE)
    poses = interpolated(np.arange(len(world.truth)) * PERIOD_NS, world.odometry, stamps)
    direction = np.random.default_rng([seed, 5]).uniform(0, 2 * np.pi)
    jump = expmap(jump_m * np.array([[0, 0, 0, np.cos(direction), np.sin(direction), 0]]))[0]
    at = len(poses) // 2
    poses[at:] = poses[at - 1] @ jump @ invert(poses[at - 1]) @ poses[at:]
    graph = PoseGraph(PoseGraphSettings(odometry_sigma_m=0.05 / sure, odometry_sigma_deg=0.5 / sure))
    ends = [int(np.searchsorted(stamps, closure.second * PERIOD_NS, side="right")) for closure in world.closures]
    fed = 0
    for row, end in enumerate([*ends, len(stamps)]):
        for k in range(fed, end):
            graph.add_odometry(int(stamps[k]), poses[k])
        fed = max(fed, end)
        if row < len(world.closures):
            graph.add_closure(world.message(row))
    graph.settle()
    return judged(graph, {(c.first * PERIOD_NS, c.second * PERIOD_NS): c.right for c in world.closures})


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="further g2o files")
    parser.add_argument("--quick", action="store_true", help="fewer and smaller graphs")
    parser.add_argument("--short", type=int, metavar="N", help="N drives of one short revisit instead")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="seed of the first generated graph")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="worlds in parallel")
    arguments = parser.parse_args()
    figures = short(arguments.seed, arguments.short) if arguments.short else run(arguments)
    print()
    for name, value in figures.items():
        print(f"{name:32s} {value:.4g}")
    write_figures(arguments.json, figures)


def run(arguments: Namespace) -> dict[str, float]:
    """All figures but those of short drives."""
    # the cost first, while no other world is driven
    costs = cost(arguments.seed)
    trials = generated(arguments.seed, arguments.quick)
    files = [from_file(path, arguments.quick) for path in arguments.files]
    print()
    figures = resist(trials + files, arguments.jobs) | costs
    return figures | equality([trial.world for trial in trials if trial.name.endswith(f"seed {arguments.seed}")])


if __name__ == "__main__":
    main()
