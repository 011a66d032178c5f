"""Fit the decision about submaps, and what odometry adds to their covariance, to simulated validation drives.

python -m umf_ros.lab.fit.submap_acceptance [--drives FOLDER] [--out FILE]

Only LiDAR and odometry are simulated: a drive takes about a minute of one core. Closures of single scans
(revisits in the same direction) are taken from the truth.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from umf_ros.core.config import Database, KeyframePolicy, Loop, Verification
from umf_ros.core.frames import Embedding, Frame, Keyframe, StereoCamera
from umf_ros.core.geometry import Array, make_pose, relative
from umf_ros.core.keyframes import KeyframeSelector, is_past
from umf_ros.lab.fit.acceptance import fit_weights
from umf_ros.lab.simulation.presets import find_preset
from umf_ros.lab.simulation.simulator import Simulator
from umf_ros.places.database import PlaceDatabase
from umf_ros.runs.truth import (
    POSE_TOLERANCE_DEG,
    POSE_TOLERANCE_M,
    find_revisits,
    normalised_errors,
    pose_error,
    share_inside,
)
from umf_ros.submaps import SubmapFinder
from umf_ros.submaps.finder import OdometryError, SubmapAcceptance, Tested, scores
from umf_ros.submaps.submap_index import Proposal
from umf_ros.verification import Measurement
from umf_ros.verification import constants as const
from umf_ros.verification.acceptance import Logistic
from umf_ros.verification.prepared_scan import thin_scan

Truth = dict[int, Array]
NO_CAMERA = StereoCamera(1, 1, 1.0, 1.0, 0.0, 0.0, 0.0)
START = np.log([20.0, 2e-3, 5e-4, 1e-3, 8e-3])  # inflation, then the error of odometry per metre
LIMITS = np.log([[1.0, 1e-4, 1e-5, 1e-4, 1e-4], [1e4, 0.1, 0.1, 1.0, 1.0]])
MOST = 500  # examples that a covariance is fitted to
DRIVES = [
    ("mapping", 10111, "etna", 0.3),
    ("mapping", 10112, "etna", 1.0),
    ("mapping", 10113, "dunes", 1.0),
    ("mapping", 10114, "moon", 1.0),
    ("mapping", 10115, "canyon", 1.0),
    ("mapping", 10116, "terrain", 1.0),
    ("mapping", 10117, "mesa", 1.0),
    ("traverse_2", 10118, "mounds", 1.0),
]
ANYWHERE, BESIDE_M = 3, 4.0  # wrong answers per keyframe at any stop, and how far beside the right ones
EVERY = 10  # keyframes, for wrong answers
DEFAULT_OUT = Path("config/verification/submaps.json")


@dataclass(frozen=True)
class SubmapDrive:
    """Keyframes without a network's help, and their true poses (N, 4, 4)."""

    keyframes: list[Keyframe]
    truth: Array


@dataclass(frozen=True)
class SubmapExample:
    """A tested proposal of a drive: what was measured, the error (6,) of its pose, and whether that was right."""

    drive: int
    measurement: Measurement
    information: Array
    way_m: float
    error: Array
    right: bool


def drive_of(preset: str, seed: int, family: str, aliasing: float, folder: Path | None) -> SubmapDrive:
    """A drive with a LiDAR and odometry; kept in a folder, if there is one."""
    path = folder / f"{preset}_{seed}_{family}_{aliasing:g}.pkl" if folder else None
    if path is not None and path.exists():
        kept: SubmapDrive = pickle.loads(path.read_bytes())
        return kept
    simulator = Simulator(find_preset(preset), seed, family=family, aliasing=aliasing)
    selector, keyframes = KeyframeSelector(KeyframePolicy()), []
    for number, stamp in enumerate(int(stamp) for stamp in simulator.scan_stamps_ns):
        where = Frame(stamp, NO_CAMERA, np.eye(4), np.eye(4), odom_T_body=simulator.odometry_at(stamp))
        if selector.select(where):
            frame = simulator.scan_frame(number)
            points, metres = thin_scan(frame.points), selector.path_length_m(where)
            blind = Embedding(np.zeros(1, np.float32))
            keyframes.append(
                Keyframe(stamp, blind, NO_CAMERA, np.eye(4), points, where.odom_T_body, metres, 0, frame.body_T_lidar)
            )
    drive = SubmapDrive(keyframes, np.stack([simulator.pose(keyframe.stamp_ns) for keyframe in keyframes]))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(drive))
    return drive


def examples_of(number: int, drive: SubmapDrive) -> Iterator[SubmapExample]:
    """Hypotheses of the finder along a drive when every right one is accepted, and wrong answers on top."""
    database = PlaceDatabase(Database(), "none", 1)
    finder = SubmapFinder(Verification(), Loop(), database)
    truth = {one.stamp_ns: pose for one, pose in zip(drive.keyframes, drive.truth, strict=True)}
    by_scan = _found_by_scan(drive)
    for i, query in enumerate(track(drive.keyframes, f"drive {number}", transient=True)):
        tested = [] if i in by_scan else finder.examine(query)
        found = [_example(number, truth, one) for one in tested]
        yield from found
        if i % EVERY == 0:
            yield from _wrong_answers(number, truth, finder, query)
        right = [
            (one.match.keyframe, one.alignment.pose) for one, known in zip(tested, found, strict=True) if known.right
        ]
        closures = by_scan.get(i, right)
        if closures:
            finder.find(query, closures)
        database.add(query)
        finder.remember(query)
    database.close()


def _found_by_scan(drive: SubmapDrive) -> dict[int, list[tuple[Keyframe, Array]]]:
    """The nearest earlier keyframe of every revisit in the same direction, with the true pose."""
    stamps = np.array([one.stamp_ns for one in drive.keyframes], np.int64)
    path_length = np.array([one.path_length_m for one in drive.keyframes])
    positions, found = drive.truth[:, :3, 3], {}
    for i in np.flatnonzero(find_revisits(stamps, drive.truth, path_length, Loop())):
        past = is_past(stamps[i] - stamps[:i], path_length[i] - path_length[:i], Loop())
        away = np.where(past, np.linalg.norm(positions[:i] - positions[i], axis=1), np.inf)
        nearest = int(away.argmin())
        found[int(i)] = [(drive.keyframes[nearest], relative(drive.truth[nearest], drive.truth[i]))]
    return found


def _wrong_answers(number: int, truth: Truth, finder: SubmapFinder, query: Keyframe) -> Iterator[SubmapExample]:
    """Similar views of other places, poses beside the right ones, and poses anywhere."""
    if query.path_length_m < const.SUBMAP_BEFORE_M:
        return
    rng = np.random.default_rng([number, query.stamp_ns % 2**32])
    rows = rng.permutation(len(finder.trail.stops))[:ANYWHERE].tolist()
    proposals = finder.lookalikes(query) + [Proposal(row, _anywhere(rng), planar=True) for row in rows]
    here, way_m = truth[query.stamp_ns], query.path_length_m - const.SUBMAP_BEFORE_M
    right = {row: relative(truth[stop.stamp_ns], here) for row, stop in enumerate(finder.trail.stops)}
    near = [row for row, pose in right.items() if np.linalg.norm(pose[:3, 3]) < BESIDE_M]
    near = [row for row in near if finder.trail.stops[row].path_length_m < way_m]
    proposals += [Proposal(row, _beside(rng) @ right[row]) for row in rng.permutation(near)[:1].tolist()]
    for proposal in proposals:
        tested = finder.test(query, proposal)
        if tested is not None:
            yield _example(number, truth, tested)


def _anywhere(rng: np.random.Generator) -> Array:
    return make_pose(Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)]).as_matrix(), [*rng.uniform(-5, 5, 2), 0])


def _beside(rng: np.random.Generator) -> Array:
    turn = Rotation.from_rotvec([0, 0, rng.normal(0, 0.15)]).as_matrix()
    return make_pose(turn, [*rng.normal(0, BESIDE_M / 2, 2), 0])


def _example(number: int, truth: Truth, tested: Tested) -> SubmapExample:
    true = relative(truth[tested.match.keyframe.stamp_ns], truth[tested.query.keyframe.stamp_ns])
    error = pose_error(tested.alignment.pose, true)
    right = np.linalg.norm(error[:3]) <= POSE_TOLERANCE_M and np.linalg.norm(error[3:]) <= np.radians(
        POSE_TOLERANCE_DEG
    )
    return SubmapExample(number, tested.measurement, tested.alignment.information, tested.way_m, error, bool(right))


def fit(examples: list[SubmapExample]) -> SubmapAcceptance:
    """The decision and the covariance that these examples speak for."""
    right = np.array([one.right for one in examples])
    model = fit_weights([scores(one.measurement) for one in examples], right)
    return SubmapAcceptance(model, *fit_covariance([one for one in examples if one.right]))


def fit_covariance(examples: list[SubmapExample]) -> tuple[float, OdometryError]:
    """Inflation and error of the odometry under which the errors are most likely, 95 % of them inside."""
    examples = examples[:: max(len(examples) // MOST, 1)]
    errors = np.stack([one.error for one in examples])

    def model(logarithms: Array) -> SubmapAcceptance:
        inflation, *odometry = np.exp(np.clip(logarithms, *LIMITS))
        return SubmapAcceptance(Logistic(0.0, {}), float(inflation), OdometryError(*map(float, odometry)))

    def covariances(logarithms: Array) -> Array:
        guess = model(logarithms)
        return np.stack([guess.covariance(one.information, one.way_m) for one in examples])

    def surprise(logarithms: Array) -> float:
        found = covariances(logarithms)
        # a heavy tail, so that a few bad fits do not widen all others
        return float(np.mean(np.linalg.slogdet(found)[1] + 16 * np.log1p(normalised_errors(errors, found) / 10)))

    options = {"maxiter": 400, "maxfev": 400}
    best = minimize(surprise, START, method="Nelder-Mead", options=options).x
    variance = np.quantile(normalised_errors(errors, covariances(best)), 0.95) / chi2.ppf(0.95, 6)
    found = model(best + np.log(variance) * np.array([1.0, 0.5, 0.5, 0.5, 0.5]))
    return found.inflation, found.odometry


def results(examples: list[SubmapExample], model: SubmapAcceptance, threshold: float) -> dict[str, float]:
    """Results of the decision on examples."""
    accepted = [one for one in examples if model.probability(one.measurement) >= threshold]
    right = [one for one in accepted if one.right]
    squared = [float(normalised_errors(one.error, model.covariance(one.information, one.way_m))) for one in right]
    return {
        "examples": len(examples),
        "right": sum(one.right for one in examples),
        "accepted": len(accepted),
        "wrong": len(accepted) - len(right),
        "recall": round(len(right) / max(sum(one.right for one in examples), 1), 4),
        "inside_95": round(share_inside(np.array(squared)), 4),
    }


def main(
    drives: Annotated[Path | None, typer.Option(help="Keep the simulated drives here.")] = None,
    out: Annotated[Path, typer.Option(help="Where to write the fitted decision.")] = DEFAULT_OUT,
) -> None:
    """Fit, leave every drive out once to see what that costs, and write."""
    console = Console()
    examples = [example for i, plan in enumerate(DRIVES) for example in examples_of(i, drive_of(*plan, drives))]
    threshold = Verification().min_probability
    for i, plan in enumerate(DRIVES):
        others = fit([one for one in examples if one.drive != i])
        console.print(*plan, "left out:", results([one for one in examples if one.drive == i], others, threshold))
    model = fit(examples)
    found = results(examples, model, threshold)
    console.print("all:", found, model)
    content = {
        "fitted_with": "umf_ros/lab/fit/submap_acceptance.py",
        "results": found,
        "bias": model.model.bias,
        "weights": model.model.weights,
        "inflation": model.inflation,
        "odometry": asdict(model.odometry),
    }
    out.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
