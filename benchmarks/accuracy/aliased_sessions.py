"""Sessions that share one graph, and as many wrong closures as right ones: what the joint graph believes.

    python benchmarks/accuracy/aliased_sessions.py --json F  # seconds each: five sessions, four kinds, ten worlds

A drive of 750 m is cut into five sessions, each with an origin of its own; wrong closures come in groups that agree
with each other, as where a world repeats itself: between places far apart (`groups`) or 3 to 15 m apart (`near`). They
are 30 % or 50 % of all. Counted are those between sessions: `wrong_between` are wrong ones that are believed.
"""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import expmap
from umf_ros.lab.program import parser_of, write_figures
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld, Kind, rover_loops, with_wrong_closures
from umf_ros.lab.simulation.world import TEST
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import State
from umf_ros.runs.truth import absolute_trajectory_error

SESSIONS, LENGTH = 5, 150


def cut(world: GraphWorld, seed: int) -> GraphWorld:
    """The drive as sessions, each with odometry from an origin of its own."""
    rng, odometry = np.random.default_rng(seed), world.odometry.copy()
    starts = tuple(range(0, len(world.truth), LENGTH))
    for start in starts:
        gauge = expmap(rng.normal(size=(1, 6)) * np.array([0, 0, 1, 20, 20, 1]))[0]
        odometry[start : start + LENGTH] = gauge @ odometry[start : start + LENGTH]
    return replace(world, odometry=odometry, chains=starts)


def solve(world: GraphWorld) -> PoseGraph:
    """The settled joint graph."""
    graph = PoseGraph(PoseGraphSettings(max_gap_s=1.5))
    for start, end in pairwise([*world.chains, len(world.truth)]):
        if start:
            graph.begin_session()
        for row in range(start, end):
            graph.add_odometry(row * PERIOD_NS, world.odometry[row], world.step_covariance(row))
    graph.add_closures([world.message(row) for row in range(len(world.closures))])
    graph.settle()
    return graph


def judge(seed: int, kind: Kind, share: float) -> dict[str, Any]:
    """The joint graph of one world."""
    world = cut(with_wrong_closures(rover_loops(SESSIONS * LENGTH, seed), share, kind, seed), seed)
    graph = solve(world)
    between = {
        (one.first * PERIOD_NS, one.second * PERIOD_NS): one.right
        for one in world.closures
        if one.first // LENGTH != one.second // LENGTH
    }
    verdicts = [verdict for verdict in graph.closures() if verdict.state is State.ACCEPTED]
    believed = [(verdict.closure.match_stamp_ns, verdict.closure.query_stamp_ns) for verdict in verdicts]
    right = [between[pair] for pair in believed if pair in between]
    poses, known = graph.poses_at(np.arange(len(world.truth)) * PERIOD_NS)
    return {
        "seed": seed,
        "kind": kind,
        "share": share,
        "wrong": len(between) - sum(between.values()),
        "wrong_between": len(right) - sum(right),
        "right": sum(between.values()),
        "right_between": sum(right),
        "joined": len(graph.sessions_of_map()),
        "ate_joint_m": absolute_trajectory_error(poses[known, :3, 3], world.truth[known, :3, 3]),
    }


CASES: tuple[tuple[Kind, float], ...] = (("groups", 0.3), ("near", 0.3), ("groups", 0.5), ("near", 0.5))


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--quick", action="store_true", help="two worlds")
    parser.add_argument("--seed", type=int, default=TEST.start + 1, help="seed of the first world")
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
    write_figures(arguments.json, figures | {"all": found})


if __name__ == "__main__":
    main()
