"""Verification in other domains: other LiDARs, other places, other mounts, LiDAR alone.

python benchmarks/accuracy/domains.py [--quick] [--strange] [--seed N] [--jobs N] [--folder FOLDER] [--json FILE]

With `--folder` the simulated scans are kept and used again. Descriptors and local features are those of the shipped
network; every pair is verified on its own, so that no other pair supports it, first by its scans and, where these show
too little of the place, by its submaps: the scans of the metres around them, merged by an odometry that drifts as the
rover's does.

Every domain is verified twice: by what is shipped, and by a decision fitted without any example of the domain
(`left out`), from the examples that `umf_ros/lab/fit/scan_acceptance.py` keeps beside it.
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from umf_ros.core.config import EmbeddingSettings, Verification
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.embedding import make_embedder
from umf_ros.lab.fit.acceptance import EXAMPLES, load_examples, save_acceptance
from umf_ros.lab.fit.scan_acceptance import fit
from umf_ros.lab.program import JsonFile, write_figures
from umf_ros.lab.simulation.domains import DOMAINS, STRANGE_DOMAINS, Domain
from umf_ros.lab.simulation.domains.pairs import (
    ELSEWHERE,
    FULL,
    QUICK,
    SAME,
    TURNED,
    Extent,
    ScanPair,
    is_wrong,
    pairs_of,
    places_of,
    verified,
)
from umf_ros.lab.simulation.world import TEST, VALIDATION
from umf_ros.runs.truth import normalised_errors, pose_error, share_inside
from umf_ros.verification import Verifier


@dataclass
class Outcome:
    """Decisions on one domain's pairs; `left_out`: those of a model that was fitted without the domain."""

    name: str
    pairs: dict[str, int] = field(default_factory=lambda: dict.fromkeys((SAME, TURNED, ELSEWHERE), 0))
    right: dict[str, int] = field(default_factory=lambda: dict.fromkeys((SAME, TURNED, ELSEWHERE), 0))
    wrong: dict[str, int] = field(default_factory=lambda: dict.fromkeys((SAME, TURNED, ELSEWHERE), 0))
    errors: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    verify_ms: list[float] = field(default_factory=list)
    by_submaps: int = 0
    left_out: Outcome | None = None

    def judge(self, pair: ScanPair, closure: LoopClosure | None, by_submaps: bool = False) -> None:
        """Count one verdict."""
        self.pairs[pair.kind] += 1
        if closure is None:
            return
        self.by_submaps += by_submaps
        elsewhere = pair.query.world != pair.match.world  # within one world, distant places may well share a view
        if elsewhere or is_wrong(closure.match_T_query, pair.match_T_query):
            self.wrong[pair.kind] += 1
            return
        self.right[pair.kind] += 1
        self.errors.append(pose_error(closure.match_T_query, pair.match_T_query))
        self.covariances.append(closure.covariance)

    def share(self, kind: str) -> float:
        """Share of the pairs of a kind that were rightly accepted."""
        return self.right[kind] / self.pairs[kind] if self.pairs[kind] else float("nan")

    @property
    def figures(self) -> dict[str, Any]:
        """The domain's own figures."""
        errors, covariances = np.array(self.errors), np.array(self.covariances)
        inside = share_inside(normalised_errors(errors, covariances)) if self.errors else float("nan")
        return {
            "pairs": sum(self.pairs.values()),
            "accepted": sum(self.right.values()) + sum(self.wrong.values()),
            "wrong": sum(self.wrong.values()),
            "wrong_elsewhere": self.wrong[ELSEWHERE],
            "wrong_left_out": sum(self.left_out.wrong.values()) if self.left_out else 0,
            "recall_left_out": self.left_out.share(SAME) if self.left_out else float("nan"),
            "recall": self.share(SAME),
            "turned_recall": self.share(TURNED),
            "inside_95": inside,
            "by_submaps": self.by_submaps,
            "verify_ms": float(np.median(self.verify_ms)) if self.verify_ms else float("nan"),
        }


def summary(outcomes: list[Outcome]) -> dict[str, float]:
    """The figures over all domains; means and worst are of the domains, whatever their size."""
    recall = [outcome.share(SAME) for outcome in outcomes]
    inside = [outcome.figures["inside_95"] for outcome in outcomes]
    turned = [sum(outcome.right[TURNED] for outcome in outcomes), sum(outcome.pairs[TURNED] for outcome in outcomes)]
    known = [value for value in inside if np.isfinite(value)]
    return {
        "accepted": sum(outcome.figures["accepted"] for outcome in outcomes),
        "wrong": sum(outcome.figures["wrong"] for outcome in outcomes),
        "wrong_left_out": sum(outcome.figures["wrong_left_out"] for outcome in outcomes),
        "recall_mean": float(np.mean(recall)),
        "recall_worst": float(np.min(recall)),
        "inside_95_mean": float(np.mean(known)) if known else float("nan"),
        "inside_95_worst": float(np.min(known)) if known else float("nan"),
        "turned_recall": turned[0] / max(turned[1], 1),
        "verify_ms": float(np.median(np.concatenate([outcome.verify_ms for outcome in outcomes]))),
    }


def main(
    quick: Annotated[bool, typer.Option(help="fewer scans of fewer worlds")] = False,
    seed: Annotated[int, typer.Option(help="other worlds; from 10000 on those of validation")] = 0,
    json_file: JsonFile = None,
    jobs: Annotated[int, typer.Option(help="processes", min=1)] = 1,
    folder: Annotated[Path | None, typer.Option(help="keeps the simulated scans for the next time")] = None,
    only: Annotated[str, typer.Option(help="domains whose name contains this")] = "",
    strange: Annotated[bool, typer.Option(help="the domains that no decision is fitted to")] = False,
) -> None:
    """Verify true and false pairs of every domain and compare with the truth."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    extent = QUICK if quick else FULL
    chosen = [domain for domain in (STRANGE_DOMAINS if strange else DOMAINS) if only in domain.name]
    outcomes: dict[str, Outcome] = {}
    # a thread pool of Open3D or torch does not survive a fork
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(run, domain, seed, extent, folder) for domain in chosen]
        for done in as_completed(waiting):
            outcome = done.result()
            outcomes[outcome.name] = outcome
            console.print(f"{outcome.name}: {outcome.figures['accepted']} accepted, {outcome.figures['wrong']} wrong")
    ordered = [outcomes[domain.name] for domain in chosen]
    figures = summary(ordered)
    console.print(_table(ordered))
    for name, value in figures.items():
        console.print(f"{name:20} {value:.4g}")
    write_figures(json_file, figures | {"domains": {outcome.name: outcome.figures for outcome in ordered}})


def run(domain: Domain, seed: int, extent: Extent, folder: Path | None) -> Outcome:
    """Survey one domain and verify its pairs."""
    embedder = make_embedder(EmbeddingSettings(threads=1))
    start = seed if seed in VALIDATION else TEST[100 * seed % len(TEST)]
    places = places_of(domain, range(start, start + extent.worlds), extent, folder, embedder)
    outcome, left_out = Outcome(domain.name), Outcome(domain.name)
    verifier = Verifier(Verification())
    # the shipped decision has no example of a strange domain
    stranger = _without(domain) if domain in DOMAINS else None
    for pair in pairs_of(places, domain, np.random.default_rng(seed)):
        began_s = time.process_time()
        outcome.judge(pair, *verified(verifier, pair))
        outcome.verify_ms.append(1e3 * (time.process_time() - began_s))
        if stranger:
            left_out.judge(pair, *verified(stranger, pair))
    outcome.left_out = left_out if stranger else outcome
    return outcome


def _without(domain: Domain) -> Verifier:
    """A verifier whose decision was fitted, threshold and all, without any example of the domain."""
    model, _ = fit([one for one in load_examples(EXAMPLES) if one.domain != domain.name])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "acceptance.json"
        save_acceptance(model, path, {}, {})
        return Verifier(Verification(calibration=str(path)))


def _table(outcomes: list[Outcome]) -> Table:
    table = Table(title="pairs (same way, other way, elsewhere) and verdicts", box=None)
    for name in (
        "sensor-place-mount",
        "same",
        "other",
        "else",
        "acc.",
        "wrong",
        "left out",
        "recall",
        "turned",
        "in 95 %",
        "submaps",
        "ms",
    ):
        first = name == "sensor-place-mount"
        table.add_column(name, justify="left" if first else "right", no_wrap=True)
    for outcome in outcomes:
        figures = outcome.figures
        counts = (*outcome.pairs.values(), figures["accepted"], figures["wrong"], figures["wrong_left_out"])
        shares = (f"{figures[key]:.3f}" for key in ("recall", "turned_recall", "inside_95"))
        rest = (str(figures["by_submaps"]), f"{figures['verify_ms']:.0f}")
        table.add_row(outcome.name, *map(str, counts), *shares, *rest)
    return table


if __name__ == "__main__":
    typer.run(main)
