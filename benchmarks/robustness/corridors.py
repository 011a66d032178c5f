"""Verification in long narrow passages: corridors, hospital hallways, tunnels, hangar aisles and street canyons.

python benchmarks/robustness/corridors.py [--seed N] [--worlds N] [--every N] [--jobs N] [--only NAME] [--json FILE]

In every passage 25 scans are taken 0.6 m apart, by turns of two visits; all 600 ordered pairs are verified, LiDAR alone
and each on its own. A closure is wrong when it is more than 1 m or 5 deg off, and precise below 0.3 m. Most passages
look alike everywhere along them: they count for what is refused, not for recall.
"""

from __future__ import annotations

import multiprocessing
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from umf_ros.core.config import EmbeddingSettings, Verification
from umf_ros.core.frames import Candidate
from umf_ros.core.geometry import relative
from umf_ros.embedding import make_embedder
from umf_ros.lab.program import JsonFile, write_figures
from umf_ros.lab.simulation.domains.pairs import SAME, ScanPair, is_wrong, passage_places
from umf_ros.lab.simulation.domains.passages import PASSAGES, Passage
from umf_ros.lab.simulation.world import TEST
from umf_ros.verification import Verifier

PRECISE_M = 0.3


def main(
    seed: Annotated[int, typer.Option(help="of the first passage; 10000 to 19999 are for development")] = TEST.start,
    worlds: Annotated[int, typer.Option(help="passages of each kind, sensor, mount and relief", min=1)] = 1,
    every: Annotated[int, typer.Option(help="verify every n-th pair only", min=1)] = 1,
    jobs: Annotated[int, typer.Option(help="processes", min=1)] = 1,
    only: Annotated[str, typer.Option(help="passages whose name contains this")] = "",
    json_file: JsonFile = None,
) -> None:
    """Verify all pairs of every passage and compare with the truth."""
    console = Console()
    chosen = [passage for passage in PASSAGES if only in passage.name]
    total: Counter[str] = Counter()
    details: dict[str, dict[str, int]] = {}
    latency: list[float] = []
    # a thread pool of Open3D or torch does not survive a fork
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(run, passage, seed + world, every) for passage in chosen for world in range(worlds)]
        for done in as_completed(waiting):
            name, counts, refine_ms = done.result()
            total += counts
            latency += refine_ms
            details[name] = dict(counts)
            console.print(
                f"{name}: {counts['accepted']} accepted, {counts['wrong']} wrong, {counts['precise']} precise"
            )
    figures = {name: total[name] for name in ("pairs", "accepted", "wrong", "precise")}
    for name, value in figures.items():
        console.print(f"{name:12} {value}")
    console.print(f"{'refine_ms':12} {np.median(latency):.0f}")
    write_figures(json_file, figures | {"refine_ms": float(np.median(latency)), "passages": details})


def run(passage: Passage, seed: int, every: int) -> tuple[str, Counter[str], list[float]]:
    """Name, counts of verdicts and milliseconds of refinement of every n-th pair of one passage."""
    embedder = make_embedder(EmbeddingSettings(threads=1))
    places = passage_places(passage, seed, embedder)
    verifier, counts, refine_ms = Verifier(Verification()), Counter[str](), []
    pairs = [ScanPair(query, match, SAME) for query in places for match in places if query is not match]
    for pair in pairs[::every]:
        verifier.reset()
        candidate = Candidate(0, pair.match.keyframe.stamp_ns, pair.similarity)
        closure = verifier.verify(pair.query.keyframe, [(candidate, pair.match.keyframe)])[0].closure
        refine_ms.append(verifier.latency_ms["refine"])
        counts["pairs"] += 1
        if closure is not None:
            counts["accepted"] += 1
            counts["wrong"] += is_wrong(closure.match_T_query, pair.match_T_query)
            off = float(np.linalg.norm(relative(pair.match_T_query, closure.match_T_query)[:3, 3]))
            counts["precise"] += off < PRECISE_M
    return f"{passage.name}-{seed}", counts, refine_ms


if __name__ == "__main__":
    typer.run(main)
