"""Fit the acceptance models of scans and of submaps to simulated validation worlds, in all domains together."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from scipy.spatial.transform import Rotation

from umf_ros.core.config import Database, EmbeddingSettings, Loop, Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array, invert, make_pose, near, relative, rotation_angle, transform
from umf_ros.embedding import Embedder, make_embedder
from umf_ros.lab.fit.acceptance import (
    EXAMPLES,
    Example,
    bounds_of,
    fit_decision,
    load_examples,
    save_acceptance,
    save_examples,
)
from umf_ros.lab.simulation.domains import DOMAINS, Domain
from umf_ros.lab.simulation.domains.pairs import ELSEWHERE, QUICK, ScannedPlace, ScanPair, pairs_of, places_of
from umf_ros.lab.simulation.drives import SurveyedDrive, embedded, kept, kept_in, worlds
from umf_ros.lab.simulation.scenes import TRAPS
from umf_ros.lab.simulation.world import VALIDATION
from umf_ros.places.database import PlaceDatabase
from umf_ros.verification import Verifier
from umf_ros.verification.acceptance import (
    CRITERIA,
    AcceptanceModel,
    Logistic,
    Measurements,
    load_acceptance,
    refuted,
)
from umf_ros.verification.hypothesis import SCAN, SUBMAP

RIGHT_M, RIGHT_DEG = 0.3, 2.5
WRONG_M, WRONG_DEG = 0.75, 4.0  # what lies between is neither
SAME_BASIN_M, SAME_BASIN_RAD = 0.1, 0.02
MIN_COMMON = 0.1
STATED = "excess_differences"
"""Its weight is by hand: racks of two warehouses differ in nothing else, and no fitted domain is like them."""
VIEWS = ("whole", "whole", "untimed", "narrow", "near", "sparse")


@dataclass(frozen=True)
class Tried:
    """A pair of keyframes as one variant of the sensor would have seen it."""

    query: Keyframe
    match: Keyframe
    pair: ScanPair

    @property
    def true(self) -> Array | None:
        """The true pose; None between worlds."""
        return self.pair.match_T_query if self.pair.query.world == self.pair.match.world else None

    def is_right(self, pose: Array) -> bool | None:
        """Whether a pose is; None where it is neither right nor quite wrong."""
        if self.true is None:
            return False
        gap = relative(self.true, pose)
        return is_right(float(np.linalg.norm(gap[:3, 3])), float(np.degrees(rotation_angle(gap))))


def is_right(metres: float, degrees: float) -> bool | None:
    """Whether an error is that of a right pose; None between right and wrong."""
    if metres < RIGHT_M and degrees < RIGHT_DEG:
        return True
    return False if metres > WRONG_M or degrees > WRONG_DEG else None


def examples_of(domain: Domain, seeds: range, pairs: int, scans: Path | None, embedder: Embedder) -> Iterator[Example]:
    """Examples from pairs of surveys, of scans and then of submaps."""
    places = places_of(domain, seeds, QUICK, scans, embedder)
    rng = np.random.default_rng([seeds.start, 60])
    verifier = Verifier(Verification())
    for number, pair in enumerate(_mixed(places, domain, pairs, rng)):
        view = VIEWS[number % len(VIEWS)]
        query, match = (_seen(place.keyframe, view, domain.scanner.all_round) for place in (pair.query, pair.match))
        yield from _examples(Tried(query, match, pair), verifier, domain, rng)
    for pair in _mixed(places, domain, pairs, rng):
        if pair.query.before is not None:
            match = pair.match.around or pair.match.keyframe
            yield from _examples(Tried(pair.query.before, match, pair), verifier, domain, rng)


def _mixed(places: list[ScannedPlace], domain: Domain, pairs: int, rng: np.random.Generator) -> list[ScanPair]:
    """So many pairs: half of one place, a quarter of two, a quarter of two worlds."""
    every = list(pairs_of(places, domain, rng))
    mixed = [every[index] for index in rng.permutation(len(every))]
    chosen = [pair for pair in mixed if pair.kind != ELSEWHERE][: pairs // 2]
    chosen += [pair for pair in mixed if pair.kind == ELSEWHERE][: pairs // 4]
    return chosen + [_between_worlds(places, rng) for _ in range(pairs // 4)]


def _examples(tried: Tried, verifier: Verifier, domain: Domain, rng: np.random.Generator) -> Iterator[Example]:
    """Poses that verification finds, and its measurements at poses that it may find another time."""
    verifier.reset()
    candidates = [(Candidate(0, tried.match.stamp_ns, tried.pair.similarity), tried.match)]
    usable = all(verifier.scans[keyframe].usable for keyframe in (tried.query, tried.match))
    guesses = _guesses(tried, domain.scanner.all_round, rng) if usable else []
    kept: list[Array] = []
    for one in verifier.examine(tried.query, candidates, guesses):
        right = tried.is_right(one.pose)
        # scans that share no view cannot show that a pose is right
        if (
            not one.scans
            or right is None
            or (right and one.measurements["common"] < MIN_COMMON)
            or any(near(one.pose, other, SAME_BASIN_M, SAME_BASIN_RAD) for other in kept)
        ):
            continue
        kept.append(one.pose)
        yield Example(one.measurements, right, domain.name)


def _guesses(tried: Tried, all_round: bool, rng: np.random.Generator) -> list[Array]:
    """Poses to align from: near the truth, slid along and across the way, turned round; elsewhere, road on road."""
    beside = [*rng.normal(0, 0.4, 2), 0.0]
    around = [make_pose(_yaw(180.0), [*rng.normal(0, 1, 2), 0.0])] if all_round else []
    if tried.true is None or tried.pair.kind == ELSEWHERE:
        anywhere = make_pose(_yaw(rng.normal(0, 4)), [*rng.normal(0, 1.5, 2), 0.0])
        return [make_pose(np.eye(3), beside), anywhere, *around]
    along, across = rng.choice([-1.0, 1.0], 2) * rng.uniform([1.0, 0.8], [5.0, 3.5])
    moves = [
        make_pose(np.eye(3), [0.0, 0.0, 0.0]),
        make_pose(_yaw(rng.normal(0, 3)), beside),
        make_pose(np.eye(3), [along, 0.0, 0.0]),
        make_pose(_yaw(rng.normal(0, 4)), [rng.normal(), across, 0.0]),
    ]
    return [tried.true @ move for move in moves + around]


def _between_worlds(places: list[ScannedPlace], rng: np.random.Generator) -> ScanPair:
    """Two keyframes of different worlds; with one world only, of any."""
    query = places[int(rng.integers(len(places)))]
    others = [place for place in places if place.world != query.world] or places
    return ScanPair(query, others[int(rng.integers(len(others)))], ELSEWHERE)


def _seen(keyframe: Keyframe, view: str, all_round: bool) -> Keyframe:
    """The keyframe of another sensor: one without time stamps, a narrow, a short-sighted, a sparse one."""
    if view == "untimed":
        return replace(keyframe, motion=None)
    points = transform(invert(keyframe.body_T_lidar), keyframe.points.astype(float))
    if view == "narrow":
        half_deg = 36.0 if all_round else 25.0
        chosen = np.abs(np.degrees(np.arctan2(keyframe.points[:, 1], keyframe.points[:, 0]))) < half_deg
    elif view == "near":
        chosen = np.linalg.norm(points, axis=1) < 14.0
    elif view == "sparse":
        chosen = np.random.default_rng(keyframe.stamp_ns % 1000).random(len(points)) < 0.4
    else:
        return keyframe
    return replace(keyframe, points=keyframe.points[chosen])


def _yaw(degrees: float) -> Array:
    turn: Array = Rotation.from_rotvec([0.0, 0.0, np.radians(degrees)]).as_matrix()
    return turn


EXAMINED = 5  # candidates per query: what retrieval offers first
EVERY, CONSECUTIVE = 12, 3  # of so many keyframes, the first few are queries
THRESHOLD = Verification().min_probability
SURVEYS, PAIRS = range(VALIDATION[0], VALIDATION[0] + 3), 60  # in every domain
ENOUGH = 100  # right examples that a fit needs
Survey = tuple[SurveyedDrive, list[Keyframe]]
DEFAULT_OUT = Path("config/verification/calibration.json")


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
    again: Annotated[bool, typer.Option("--again", help="fit to the examples that the shipped model has")] = False,
    only: Annotated[Literal["", "scan", "submap"], typer.Option(help="fit this part, leave the other as it is")] = "",
) -> None:
    """Examine candidates of validation worlds, fit acceptance to them, and write the model.

    Run it again whenever the weights of the network change. After a change of the criteria alone, `--again` suffices.
    Prints what share of right poses and how many wrong ones a model fitted to the other domains accepts.
    """
    console = Console()
    kinds = (only,) if only else (SCAN, SUBMAP)
    if again:
        _write(console, load_examples(EXAMPLES), kinds, out, "--again")
        return
    settings = EmbeddingSettings(method=method, weights=weights, threads=1)
    elsewhere = in_domains(settings, pairs, folder, examples, jobs)
    embedder = make_embedder(settings)
    surveyed: list[Survey] = []
    for number, family, aliasing in worlds(VALIDATION[0], count):
        with console.status(f"simulating world {number} ({family}, aliasing {aliasing:g})"):
            drive = kept(drives, number, family, aliasing)
        surveyed.append((drive, embedded(drive, embedder)))
    along = [example for survey in surveyed for example in examine(*survey)]
    save_examples(found := along + elsewhere + _sprung_traps(), EXAMPLES)
    _write(console, found, kinds, out, f"--worlds {count}")


def _write(console: Console, examples: list[Example], kinds: Sequence[str], out: Path, options: str) -> None:
    model, results = fit(examples, kinds)
    for name, value in results.items():
        console.print(f"{name:32} {value:.4g}")
    command = f"python -m umf_ros.lab.fit.scan_acceptance {options} --only "
    save_acceptance(model, out, {kind: command + kind for kind in kinds}, results)
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
    """Examples of one, from a file in the folder `kept` where an earlier call left it."""
    path = kept / f"examples_{domain.name}_{SURVEYS.start}_{len(SURVEYS)}_{pairs}.pkl" if kept else None
    return kept_in(path, lambda: list(examples_of(domain, SURVEYS, pairs, folder, make_embedder(settings))))


def fit(examples: list[Example], kinds: Sequence[str] = (SCAN, SUBMAP)) -> tuple[AcceptanceModel, dict[str, float]]:
    """The models that explain the examples of scans, of submaps or of both, and how they do in domains left out.

    The shipped model's parts for images stay, and weights of what no example knows, where that counts in full.
    """
    fitted, results = load_acceptance(), dict[str, float]()
    examples = [replace(example, measurements=_without_stated(example.measurements)) for example in examples]
    for kind in kinds:
        mine = [example for example in examples if example.kind == kind]
        model, odds = fit_decision(mine, kind, THRESHOLD)
        rows = CRITERIA[kind].items()
        new = [name for name, one in rows if all(one(it.measurements) == one.missing == 1 for it in mine)]
        kept = {name: fitted.models[kind].weights[name] for name in new}
        model = Logistic(model.bias - sum(kept.values()), model.weights | kept)
        bounds = fitted.bounds | {kind: bounds_of(mine, kind)}
        fitted = replace(fitted, models=fitted.models | {kind: model}, bounds=bounds)
        results |= _judge(kind, mine, odds)
    return fitted, results


def _without_stated(measurements: Measurements) -> Measurements:
    return {name: value for name, value in measurements.items() if name != STATED}


def examine(drive: SurveyedDrive, keyframes: list[Keyframe]) -> Iterator[Example]:
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
                metres, degrees = drive.error(query, one.candidate.index, one.pose)
                right = is_right(metres, degrees)
                if right is not None:
                    yield Example(one.measurements, right, f"drive {drive.seed}")
        database.add(keyframe)
    database.close()


def _choose(drive: SurveyedDrive, query: int, candidates: list[Candidate], rng: np.random.Generator) -> list[Candidate]:
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
    """Errors of real scans that simulated ones lack: range noise and motion that odometry did not remove."""
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
            found += [Example(one.measurements, False, "traps") for one in examined]
    return found


def _judge(kind: str, examples: list[Example], odds: Array) -> dict[str, float]:
    """Figures of log-odds that every example got without its domain."""
    right, refused = np.array([(example.right, bool(refuted(example.measurements))) for example in examples]).T
    accepted = (odds >= math.log(THRESHOLD / (1 - THRESHOLD))) & ~refused
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
