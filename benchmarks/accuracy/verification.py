"""Verification on unseen worlds: is every published closure right, how exact, how honest, how fast.

python benchmarks/accuracy/verification.py [--quick] [--seed N] [--drives FOLDER] [--json FILE]

A world takes about a minute and a half of one core: half a minute to simulate, the rest to embed and verify.
With `--drives` the simulated drives are kept and used again.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from umf_ros.core.config import Database, EmbeddingSettings, Loop, Verification
from umf_ros.core.frames import Candidate, Keyframe, LoopClosure
from umf_ros.core.geometry import Array, heading, relative, wrap_angle
from umf_ros.embedding import make_embedder
from umf_ros.lab.program import JsonFile, write_figures
from umf_ros.lab.simulation.drives import SurveyedDrive, embedded, kept, worlds
from umf_ros.lab.simulation.scenes import TRAPS, spring
from umf_ros.lab.simulation.world import TEST
from umf_ros.places.database import PlaceDatabase, is_past
from umf_ros.runs.truth import normalised_errors, pose_error, share_inside
from umf_ros.verification import Verifier

WRONG_M, WRONG_DEG = 1.0, 5.0
STRICT_M = 0.5
REVISIT_M, REVISIT_DEG, REVISIT_OVERLAP = 5.0, 30.0, 0.3
THREADS = (1, 4)
Query = tuple[Keyframe, list[tuple[Candidate, Keyframe]]]


@dataclass
class World:
    """Results of one world."""

    name: str
    queries: int = 0
    errors: list[tuple[float, float]] = field(default_factory=list)
    vectors: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    revisits: int = 0
    retrieved: int = 0
    recalled: int = 0
    rerank_ms: list[float] = field(default_factory=list)
    refine_ms: list[float] = field(default_factory=list)

    @property
    def wrong(self) -> int:
        """Accepted closures beyond 1 m or 5 deg."""
        return sum(metres > WRONG_M or degrees > WRONG_DEG for metres, degrees in self.errors)


def main(
    quick: Annotated[bool, typer.Option(help="one world")] = False,
    seed: Annotated[int, typer.Option(help="other worlds")] = 0,
    json_file: JsonFile = None,
    count: Annotated[int, typer.Option("--worlds", help="how many worlds")] = 10,
    drives: Annotated[Path | None, typer.Option(help="folder that keeps simulated drives for the next time")] = None,
    weights: Annotated[str, typer.Option(help="safetensors; empty: the shipped ones")] = "",
    method: Annotated[str, typer.Option(help="embedder")] = "umf",
) -> None:
    """Drive through unseen worlds and check every closure against the truth."""
    console = Console()
    embedder = make_embedder(EmbeddingSettings(method=method, weights=weights))
    results: list[World] = []
    sample: list[Query] = []
    for number, family, aliasing in worlds(TEST[100 * seed % len(TEST)], 1 if quick else count):
        with console.status(f"simulating world {number} ({family}, aliasing {aliasing:g})"):
            drive = kept(drives, number, family, aliasing)
        result, queries = replay(drive, embedded(drive, embedder), Verifier(Verification()))
        console.print(f"world {result.name}: {len(result.errors)} accepted, {result.wrong} wrong")
        results.append(result)
        sample = sample or queries
    figures = _figures(results) | {"traps_accepted": _sprung(4 if quick else 20), "deterministic": _same_bits(sample)}
    console.print(_per_world(results))
    console.print(_summary(figures))
    write_figures(json_file, figures)


def verify_sample(path: Path) -> str:
    """Fingerprint of all closures for pickled queries: every bit of every pose, covariance and probability."""
    verifier, digest = Verifier(Verification()), hashlib.sha256()
    for query, candidates in pickle.loads(path.read_bytes()):
        for verdict in verifier.verify(query, candidates):
            digest.update(repr((verdict.candidate.stamp_ns, verdict.reason, sorted(verdict.numbers.items()))).encode())
            if verdict.closure is not None:
                digest.update(verdict.closure.match_T_query.tobytes() + verdict.closure.covariance.tobytes())
    return digest.hexdigest()


def replay(drive: SurveyedDrive, keyframes: list[Keyframe], verifier: Verifier) -> tuple[World, list[Query]]:
    """Verify along a drive as the loop detector does; also returns some queries with their candidates."""
    result = World(drive.name)
    sample: list[Query] = []
    rules = Loop()
    database = PlaceDatabase(Database(), "drive", len(keyframes[0].embedding.descriptor))
    for query, keyframe in enumerate(track(keyframes, f"verifying {drive.name}", transient=True)):
        found = [(one, database[one.index]) for one in database.query(keyframe, rules)]
        verdicts = verifier.verify(keyframe, found)
        closures = [verdict.closure for verdict in verdicts if verdict.closure is not None]
        _record(result, drive, query, found, closures)
        if found:
            result.queries += 1
            result.rerank_ms.append(verifier.latency_ms["rerank"])
            if closures:
                result.refine_ms.append(verifier.latency_ms["refine"])
                if len(sample) < 40:
                    sample.append((keyframe, found))
        database.add(keyframe)
    database.close()
    return result, sample


def _record(
    result: World,
    drive: SurveyedDrive,
    query: int,
    found: list[tuple[Candidate, Keyframe]],
    closures: list[LoopClosure],
) -> None:
    index = {keyframe.stamp_ns: candidate.index for candidate, keyframe in found}
    right = False
    for closure in closures:
        match = index[closure.match_stamp_ns]
        error = drive.error(query, match, closure.match_T_query)
        result.errors.append(error)
        true = relative(drive.truth[match], drive.truth[query])
        result.vectors.append(pose_error(closure.match_T_query, true))
        result.covariances.append(closure.covariance)
        right |= error[0] <= WRONG_M and error[1] <= WRONG_DEG
    revisited = _revisited(drive, query)
    result.revisits += bool(revisited)
    result.retrieved += bool(revisited & set(index.values()))
    result.recalled += bool(revisited) and right


def _revisited(drive: SurveyedDrive, query: int) -> set[int]:
    """Earlier keyframes within 5 m and 30 deg whose view overlaps by 30 % or more."""
    rules, truth, path_length = Loop(), drive.truth, drive.path_length
    stamps = np.array([frame.stamp_ns for frame in drive.frames[: query + 1]])
    earlier = is_past(stamps[query] - stamps[:query], path_length[query] - path_length[:query], rules)
    away = np.linalg.norm(truth[:query, :2, 3] - truth[query, :2, 3], axis=1)
    turned = np.abs(wrap_angle(heading(truth[:query]) - heading(truth[query])))
    near = np.flatnonzero(earlier & (away <= REVISIT_M) & (turned <= np.radians(REVISIT_DEG)))
    return {int(match) for match in near if drive.overlap(query, int(match)) >= REVISIT_OVERLAP}


def _figures(results: list[World]) -> dict[str, float]:
    errors = np.array([error for result in results for error in result.errors]).reshape(-1, 2)
    vectors = np.array([vector for result in results for vector in result.vectors])
    covariances = np.array([matrix for result in results for matrix in result.covariances])
    if not len(errors):
        errors, inside = np.full((1, 2), np.nan), float("nan")
    else:
        inside = share_inside(normalised_errors(vectors, covariances))
    figures = {
        "accepted": sum(len(result.errors) for result in results),
        "wrong": sum(result.wrong for result in results),
        "recall_overlapping": sum(r.recalled for r in results) / max(sum(r.revisits for r in results), 1),
        "translation_median_m": float(np.median(errors[:, 0])),
        "translation_p95_m": float(np.percentile(errors[:, 0], 95)),
        "rotation_median_deg": float(np.median(errors[:, 1])),
        "rotation_p95_deg": float(np.percentile(errors[:, 1], 95)),
        "inside_95_ellipsoid": inside,
        "rerank_ms": float(np.median(np.concatenate([result.rerank_ms for result in results]))),
        "refine_ms": float(np.median(np.concatenate([result.refine_ms for result in results]))),
    }
    return figures


def _sprung(repeats: int) -> int:
    verifier = Verifier(Verification())
    return sum(spring(verifier, trap, seed).closure is not None for trap in TRAPS.values() for seed in range(repeats))


def _same_bits(sample: list[Query]) -> bool:
    """Whether separate processes with different thread counts give the same closures."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "queries.pkl"
        path.write_bytes(pickle.dumps(sample))
        prints = set()
        for count in THREADS:
            threads = {name: str(count) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
            code = f"from pathlib import Path; import verification as v; print(v.verify_sample(Path({str(path)!r})))"
            done = subprocess.run(
                [sys.executable, "-c", code],
                env=os.environ | threads,
                cwd=Path(__file__).parent,
                capture_output=True,
                text=True,
                check=True,
            )
            prints.add(done.stdout.strip())
    return len(prints) == 1


def _per_world(results: list[World]) -> Table:
    table = Table(title="closures by world (seed, family, aliasing)")
    for name in ("world", "queries", "accepted", "wrong", ">0.5 m", "revisits", "retrieved", "recalled"):
        table.add_column(name, justify="left" if name == "world" else "right")
    for r in results:
        loose = sum(metres > STRICT_M for metres, _ in r.errors)
        counts = (r.queries, len(r.errors), r.wrong, loose, r.revisits, r.retrieved, r.recalled)
        table.add_row(r.name, *map(str, counts))
    return table


def _summary(figures: dict[str, float]) -> Table:
    targets = {
        "accepted": ">= 2000",
        "wrong": "0",
        "recall_overlapping": ">= 0.60",
        "translation_median_m": "<= 0.10",
        "translation_p95_m": "<= 0.40",
        "rotation_median_deg": "<= 0.5",
        "rotation_p95_deg": "<= 2",
        "inside_95_ellipsoid": "0.90 - 0.98",
        "rerank_ms": "<= 25",
        "refine_ms": "<= 40",
        "traps_accepted": "0",
        "deterministic": "True",
    }
    table = Table("figure", "value", "target", title="verification")
    for name, target in targets.items():
        value = figures[name]
        table.add_row(name, f"{value:.4g}" if isinstance(value, float) else str(value), target)
    return table


if __name__ == "__main__":
    typer.run(main)
