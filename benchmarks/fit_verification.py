"""Fit the acceptance model of scans to simulated validation worlds, in all domains together.

python benchmarks/fit_verification.py [--drives FOLDER] [--folder FOLDER] [--jobs N] [--weights FILE] [--out FILE]

Run it again whenever the network's weights, the hypotheses or the measures change, for the decision changes with
them; no other step is needed. With `--drives` and `--folder` the simulated drives and the scans of the domains are
kept for the next time. Beside the model it writes the examples, which `domains.py` leaves single domains out of.
The model of views is fitted by `fit_views.py`, the covariance of scans by `fit_covariance.py`: both on recordings.
"""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from domain_examples import is_right, kept_examples
from domains import EXAMPLES
from drives import Drive, embedded, kept, worlds
from rich.console import Console
from rich.progress import track
from traps import TRAPS

from umf_ros.core.config import Database, EmbeddingSettings, Loop, Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array
from umf_ros.embedding import make_embedder
from umf_ros.lab.fit.acceptance import (
    Example,
    bounds_of,
    fit_decision,
    save_acceptance,
    save_examples,
)
from umf_ros.lab.simulation.domains import DOMAINS, Domain
from umf_ros.lab.simulation.world import VALIDATION
from umf_ros.places.database import PlaceDatabase
from umf_ros.verification import Verifier
from umf_ros.verification.acceptance import AcceptanceModel, load_acceptance, refuted
from umf_ros.verification.measurement import SCAN

EXAMINED = 5  # candidates per query: what retrieval offers first
EVERY, CONSECUTIVE = 12, 3  # of so many keyframes, the first few are queries
THRESHOLD = Verification().min_probability
ACCEPTED_ODDS = math.log(THRESHOLD / (1 - THRESHOLD))
SURVEYS, PAIRS = range(VALIDATION[0], VALIDATION[0] + 3), 60  # in every domain
ENOUGH = 100  # right examples that a fit needs
Survey = tuple[Drive, list[Keyframe]]
DEFAULT_OUT = Path(__file__).parent.parent / "config" / "verification" / "calibration.json"


def main(
    count: Annotated[int, typer.Option("--worlds", help="how many validation worlds")] = 4,
    drives: Annotated[Path | None, typer.Option(help="folder that keeps simulated drives for the next time")] = None,
    weights: Annotated[str, typer.Option(help="safetensors; empty: the shipped ones")] = "",
    method: Annotated[str, typer.Option(help="embedder")] = "umf",
    folder: Annotated[Path | None, typer.Option(help="keeps the domains' simulated scans for the next time")] = None,
    pairs: Annotated[int, typer.Option(help="pairs per domain")] = PAIRS,
    jobs: Annotated[int, typer.Option(help="processes", min=1)] = 1,
    examples: Annotated[Path | None, typer.Option(help="keeps the domains' examples, for the same code")] = None,
    out: Annotated[Path, typer.Option(help="where the model goes")] = DEFAULT_OUT,
) -> None:
    """Examine candidates of validation worlds, fit acceptance and covariance to them, and write the model.

    Run it again whenever the weights of the network change; no other step is needed.

    Prints how many poses were right, what share of them a model fitted to the other worlds accepts, how many
    wrong ones, and how many errors lie inside the 95 % ellipsoid. Zero wrong is what counts.
    """
    console = Console()
    settings = EmbeddingSettings(method=method, weights=weights, threads=1)
    elsewhere = in_domains(settings, pairs, folder, examples, jobs)
    embedder = make_embedder(settings)
    surveyed: list[Survey] = []
    for number, family, aliasing in worlds(VALIDATION[0], count):
        with console.status(f"simulating world {number} ({family}, aliasing {aliasing:g})"):
            drive = kept(drives, number, family, aliasing)
        surveyed.append((drive, embedded(drive, embedder)))
    model, results = fit([example for survey in surveyed for example in examine(*survey)] + elsewhere)
    for name, value in results.items():
        console.print(f"{name:32} {value:.4g}")
    save_acceptance(model, out, {SCAN: f"python benchmarks/fit_verification.py --worlds {count}"}, results)
    console.print(f"wrote {out}")


def in_domains(
    settings: EmbeddingSettings, pairs: int, folder: Path | None, kept: Path | None, jobs: int
) -> list[Example]:
    """Examples of all domains."""
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(_in_domain, domain, settings, pairs, folder, kept) for domain in DOMAINS]
        found = [one.result() for one in track(waiting, "domains", transient=True)]
    return [example for domain in found for example in domain]


def _in_domain(
    domain: Domain, settings: EmbeddingSettings, pairs: int, folder: Path | None, kept: Path | None
) -> list[Example]:
    return kept_examples(domain, SURVEYS, pairs, folder, make_embedder(settings), kept)


def fit(examples: list[Example]) -> tuple[AcceptanceModel, dict[str, float]]:
    """The model that explains the examples, and how it does in domains left out.

    What the shipped model says of other kinds than scans stays.
    """
    shipped = load_acceptance()
    mine = [example for example in examples + _sprung_traps() if example.measurement.kind == SCAN]
    save_examples(mine, EXAMPLES)
    model, odds = fit_decision(mine, SCAN, THRESHOLD)
    bounds = shipped.bounds | {SCAN: bounds_of(mine, SCAN)}
    fitted = replace(shipped, models=dict(shipped.models) | {SCAN: model}, bounds=bounds)
    return fitted, _judge(SCAN, mine, odds)


def examine(drive: Drive, keyframes: list[Keyframe]) -> Iterator[Example]:
    """Hypotheses about candidates along a drive, and whether their poses are right; its world counts as a domain."""
    rng = np.random.default_rng(drive.seed)
    rules = Loop()
    database = PlaceDatabase(Database(), "drive", len(keyframes[0].embedding.descriptor))
    verifier = Verifier(Verification())
    for query, keyframe in enumerate(track(keyframes, f"world {drive.name}", transient=True)):
        candidates = database.query(keyframe, rules)
        # consecutive ones, for a keyframe is supported by what its neighbours found
        if candidates and query % EVERY < CONSECUTIVE:
            chosen = _choose(drive, query, candidates, rng)
            strength = float(rng.choice([0.0, 0.0, 1.0, 2.0]))
            pairs = [(one, _degraded(database[one.index], strength, rng)) for one in chosen]
            for one in verifier.examine(_degraded(keyframe, strength, rng), pairs):
                metres, degrees = drive.error(query, one.aligned.hypothesis.ranked.candidate.index, one.aligned.pose)
                right = is_right(metres, degrees)
                if right is not None:
                    yield Example(one.measurement, right, f"drive {drive.seed}")
        database.add(keyframe)
    database.close()


def _choose(drive: Drive, query: int, candidates: list[Candidate], rng: np.random.Generator) -> list[Candidate]:
    """The first candidates of the retrieval, and a near and a far one that it may have missed."""
    chosen = candidates[:EXAMINED]
    places = drive.truth[:, :2, 3]
    away = np.linalg.norm(places[: max(candidate.index for candidate in candidates) + 1] - places[query], axis=1)
    for pool in (np.flatnonzero(away < 5), np.flatnonzero(away > 8)):
        if len(pool):
            index = int(rng.choice(pool))
            if drive.frames[query].stamp_ns - drive.frames[index].stamp_ns > 20e9:
                chosen.append(Candidate(index, drive.frames[index].stamp_ns, candidates[-1].similarity))
    return list({candidate.index: candidate for candidate in chosen}.values())


def _degraded(keyframe: Keyframe, strength: float, rng: np.random.Generator) -> Keyframe:
    """What real scans suffer and simulated ones do not: range noise and motion that odometry did not remove."""
    points = keyframe.points.astype(float)
    reach = np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1.0)
    points *= 1 + strength * 0.01 * rng.standard_normal((len(points), 1)) / reach
    moment = np.clip(np.arctan2(points[:, 2:], reach) / 0.26, -1, 1)  # a scan sweeps upwards
    turn, shift = strength * np.radians(0.15) * rng.standard_normal(), strength * 0.01 * rng.standard_normal(3)
    points[:, :2] += moment * turn * np.column_stack([-points[:, 1], points[:, 0]])
    embedding = keyframe.embedding
    if rng.random() < 0.2:
        embedding = replace(embedding, image=None)
    return replace(keyframe, points=(points + moment * shift).astype(np.float32), embedding=embedding)


def _sprung_traps() -> list[Example]:
    """Every trap a few times over, as wrong examples of its kind."""
    found = []
    for trap in TRAPS.values():
        for seed in range(100, 110):
            query, match = trap(seed)
            examined = Verifier(Verification()).examine(query, [(Candidate(0, match.stamp_ns, 0.9), match)])
            found += [Example(one.measurement, False, "traps") for one in examined]
    return found


def _judge(kind: str, examples: list[Example], odds: Array) -> dict[str, float]:
    """Figures of log-odds that every example got without its domain."""
    right, refused = np.array([(example.right, bool(refuted(example.measurement))) for example in examples]).T
    accepted = (odds >= ACCEPTED_ODDS) & ~refused
    domains = np.array([example.domain for example in examples])
    recall = [float(accepted[right & (domains == name)].mean()) for name in np.unique(domains[right])]
    return {
        f"{kind}_examples": float(len(examples)),
        f"{kind}_right": float(right.sum()),
        f"{kind}_recall_left_out": float(np.mean(recall)),
        f"{kind}_recall_left_out_worst": min(recall),
        f"{kind}_wrong_left_out": float(accepted[~right].sum()),
    }


if __name__ == "__main__":
    typer.run(main)
