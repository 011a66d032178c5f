"""Fit the acceptance model and the covariance to simulated validation worlds.

    python benchmarks/fit_verification.py SHARDS... [--weights FILE] [--out config/verification/calibration.json]

Run it again whenever the network's weights change: the features' share of the decision changes with them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from drives import Drive, load_shard
from rich.console import Console
from rich.progress import track
from traps import TRAPS

from umf_ros.config import Database, Loop, Verification
from umf_ros.config import Embedding as EmbeddingSettings
from umf_ros.embedding import make_embedder
from umf_ros.embedding.embedder import Embedder
from umf_ros.frames import Candidate, Keyframe
from umf_ros.geometry import Array
from umf_ros.loop_detector import make_keyframe
from umf_ros.places.database import PlaceDatabase
from umf_ros.simulation.seeds import VALIDATION
from umf_ros.verification import Verifier
from umf_ros.verification.acceptance import Calibration, load_calibration, save_calibration
from umf_ros.verification.covariance import covariance_of
from umf_ros.verification.evidence import Evidence
from umf_ros.verification.fitting import Example, fit_logistic, fit_spread, inside_ellipsoid

RIGHT_M, RIGHT_DEG = 0.4, 3.0
EXAMINED = 5  # candidates per query: what retrieval offers first
KINDS = ("scan", "image")
DEFAULT_OUT = Path(__file__).parent.parent / "config" / "verification" / "calibration.json"


@dataclass(frozen=True)
class Finding:
    """One examined pose of a drive."""

    drive: int
    evidence: Evidence
    error: Array
    right: bool
    pristine: bool


def main(
    shards: Annotated[list[Path], typer.Argument(help="validation shards, or folders of them")],
    weights: Annotated[str, typer.Option(help="safetensors; empty: the shipped ones")] = "",
    method: Annotated[str, typer.Option(help="embedder")] = "umf",
    stride: Annotated[int, typer.Option(help="every so many-th keyframe is a query")] = 4,
    out: Annotated[Path, typer.Option(help="where the model goes")] = DEFAULT_OUT,
) -> None:
    """Examine candidates of validation worlds, fit, and write the model."""
    files = [file for path in shards for file in (sorted(path.glob("*.npz")) if path.is_dir() else [path])]
    embedder = make_embedder(EmbeddingSettings(method=method, weights=weights, threads=1))
    findings: list[Finding] = []
    for number, file in enumerate(files):
        drive = load_shard(file)
        if int(drive.name.split()[0]) not in VALIDATION:
            raise typer.BadParameter(f"{file.name} is not a validation world")
        findings += [Finding(number, *rest) for rest in _examine(drive, embedder, number, stride)]
    console = Console()
    examples = {kind: [_example(finding) for finding in findings if finding.evidence.kind == kind] for kind in KINDS}
    sprung = _sprung_traps()
    # an embedder without local features has nothing to say about images: what is shipped stays
    fitted = [kind for kind in KINDS if any(example.right for example in examples[kind])]
    shipped = load_calibration()
    models = shipped.models | {kind: fit_logistic(examples[kind] + sprung, kind) for kind in fitted}
    spreads = shipped.spreads | {kind: fit_spread(*_right(findings, kind)) for kind in fitted}
    calibration = Calibration(models, spreads)
    results: dict[str, float] = {"worlds": float(len(files))}
    for kind in fitted:
        results |= _judge(kind, examples[kind], findings, calibration)
    for name, value in results.items():
        console.print(f"{name:32} {value:.4g}")
    command = f"python benchmarks/fit_verification.py {' '.join(file.stem for file in files)} --stride {stride}"
    save_calibration(calibration, out, command, results)
    console.print(f"wrote {out}")


def _examine(
    drive: Drive, embedder: Embedder, number: int, stride: int
) -> Iterator[tuple[Evidence, Array, bool, bool]]:
    """Evidence of candidates along a drive, with whole keyframes and without scans, and how wrong each pose is."""
    rng = np.random.default_rng(number)
    rules = Loop()
    database = PlaceDatabase(Database(), embedder.name, embedder.dimension)
    whole, blind = Verifier(Verification()), Verifier(Verification())
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(drive.truth[:, :3, 3], axis=0), axis=1))])
    frames = track(drive.frames, f"world {drive.name}", transient=True)
    for query, (frame, distance) in enumerate(zip(frames, travelled, strict=True)):
        keyframe = make_keyframe(frame, embedder, float(distance))
        candidates = database.query(keyframe, rules)
        if candidates and query % stride == 0:
            chosen = _choose(drive, query, candidates, rng)
            strength = float(rng.choice([0.0, 0.0, 1.0, 2.0]))
            pairs = [(one, _degraded(database[one.index], strength, rng)) for one in chosen]
            scanless = [(one, _without_scan(match)) for one, match in pairs]
            found = whole.examine(_degraded(keyframe, strength, rng), pairs)
            for evidence in found + blind.examine(_without_scan(keyframe), scanless):
                match = evidence.proposal.ranked.candidate.index
                metres, degrees = drive.error(query, match, evidence.pose)
                error = drive.error_vector(query, match, evidence.pose)
                right = metres < RIGHT_M and degrees < RIGHT_DEG
                yield evidence, error, right, strength == 0 or evidence.kind == "image"
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


def _without_scan(keyframe: Keyframe) -> Keyframe:
    return replace(keyframe, points=np.empty((0, 3), np.float32), embedding=replace(keyframe.embedding, cloud=None))


def _sprung_traps() -> list[Example]:
    """Every trap a few times over, as wrong examples of its kind of evidence."""
    found = []
    for trap in TRAPS.values():
        for seed in range(100, 110):
            query, match = trap(seed)
            for evidence in Verifier(Verification()).examine(query, [(Candidate(0, match.stamp_ns, 0.9), match)]):
                found.append(Example(evidence.numbers, evidence.kind, False))
    return found


def _example(finding: Finding) -> Example:
    return Example(finding.evidence.numbers, finding.evidence.kind, finding.right)


def _right(findings: list[Finding], kind: str) -> tuple[Array, Array]:
    """Errors and informations of right poses; of untouched scans only, for the covariance describes the sensor."""
    right = [one for one in findings if one.right and one.pristine and one.evidence.kind == kind]
    return np.array([item.error for item in right]), np.array([item.evidence.information for item in right])


def _judge(kind: str, examples: list[Example], findings: list[Finding], calibration: Calibration) -> dict[str, float]:
    """Figures of the fit, the wrongly accepted counted with every world judged by a fit to the others."""
    threshold = Verification().min_probability
    mine = [finding for finding in findings if finding.evidence.kind == kind]
    held_out = np.full(len(mine), np.nan)
    worlds = np.array([finding.drive for finding in mine])
    for world in np.unique(worlds):
        others = [example for example, where in zip(examples, worlds, strict=True) if where != world]
        if any(example.right for example in others):
            model = Calibration(calibration.models | {kind: fit_logistic(others, kind)}, calibration.spreads)
            for index in np.flatnonzero(worlds == world):
                held_out[index] = model.probability(mine[index].evidence.numbers, kind)
    right = np.array([finding.right for finding in mine])
    errors, informations = _right(findings, kind)
    accepted = held_out >= threshold
    return {
        f"{kind}_examples": float(len(mine)),
        f"{kind}_right": float(right.sum()),
        f"{kind}_recall_held_out": float(accepted[right].mean()),
        f"{kind}_wrong_held_out": float(accepted[~right].sum()),
        f"{kind}_largest_wrong": float(np.nanmax(held_out[~right], initial=0.0)),
        f"{kind}_inside_95": inside_ellipsoid(errors, covariance_of(informations, calibration.spreads[kind])),
    }


if __name__ == "__main__":
    typer.run(main)
