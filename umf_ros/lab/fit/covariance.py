"""Fit the covariance model of scans to recordings."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from scipy.optimize import minimize
from scipy.stats import chi2

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import BagError
from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, relative, rotation_angle
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.embedding import make_embedder
from umf_ros.lab.simulation.domains import DOMAINS, Domain
from umf_ros.lab.simulation.domains.pairs import QUICK, SAME, TURNED, pairs_of, places_of
from umf_ros.lab.simulation.drives import kept_in
from umf_ros.lab.simulation.world import VALIDATION
from umf_ros.runs.truth import MEDIAN_EXPECTED, normalised_errors, pose_error, share_inside
from umf_ros.verification.hypothesis import SCAN
from umf_ros.verification.prepared_scan import PreparedScan
from umf_ros.verification.scan_alignment import (
    Alignment,
    CovarianceModel,
    align_scans,
    covariance_of,
    motion_covariance,
)

TAIL_EXPECTED = float(chi2.ppf(0.95, 6))
SHARPNESS = 0.3  # by hand: of the likelihood, against how well each group's quantiles are met
# m and deg; measured: with less, closures of a dense scan in a street are stated to 4 mm, and 5 to 7 % are outside 95 %
FLOOR = (0.005, 0.02)
START = np.log([8.0, 3.0, 0.8, 0.03, 0.1])
LOWEST = np.log([0.5, 0.01, 0.3, 0.003, 0.01])


@dataclass(frozen=True, slots=True)
class PoseSample:
    """A right closure.

    Attributes:
        error: (6,) of its pose, ROS order.
        information: (6, 6) of its residuals.
        overlap: of the alignment.
        walked: (6, 6) what the measured noise of the odometry adds.
        grown: (6, 6) what the wrong scale of the odometry adds.
        removed: whether the motion was removed from both scans; the two matrices are zero where not.
    """

    error: Array
    information: Array
    overlap: float
    walked: Array
    grown: Array
    removed: bool


def sample_of(match: Keyframe, query: Keyframe, alignment: Alignment, true: Array) -> PoseSample:
    """An aligned pair, with its true pose `match_T_query`."""
    bare = CovarianceModel(1.0, 0.0, 0.0, motion=0.0)
    grown = motion_covariance(match, query, alignment, bare)
    walked = motion_covariance(match, query, alignment, replace(bare, motion=1.0)) - grown
    removed = match.motion is not None and query.motion is not None
    error = pose_error(alignment.pose, true)
    return PoseSample(error, alignment.information, alignment.overlap, walked, grown, removed)


def covariances_of(samples: Sequence[PoseSample], model: CovarianceModel) -> Array:
    """Covariances (N, 6, 6) that the model states for samples."""
    information, overlap, walked, grown = (
        np.array([getattr(sample, name) for sample in samples])
        for name in ("information", "overlap", "walked", "grown")
    )
    unknown = np.array([not sample.removed for sample in samples])[:, None, None] * model.unknown_motion
    return np.asarray(covariance_of(information, model, overlap) + model.motion**2 * walked + grown + unknown)


def honesty(samples: Sequence[PoseSample], model: CovarianceModel) -> tuple[float, float]:
    """Median of the normalised errors squared, and their share inside the 95 % ellipsoid."""
    squared = normalised_errors(np.array([sample.error for sample in samples]), covariances_of(samples, model))
    return float(np.median(squared)), share_inside(squared)


def fit_scan_covariance(groups: Mapping[str, Sequence[PoseSample]], weights: Mapping[str, float]) -> CovarianceModel:
    """The model that is honest about every group, and among such ones the most likely.

    Args:
        groups: right closures by recording or domain, each of which counts the same.
        weights: of groups that count more.
    """

    def loss(logarithms: Array) -> float:
        model = _model_of(logarithms)
        total = sum(weights.get(name, 1.0) * _dishonesty(samples, model) for name, samples in groups.items())
        # an estimate of the odometry's noise is believed until many groups say otherwise
        return float(total + logarithms[2] ** 2 + 0.02 * np.exp(2 * logarithms[1]))

    return _model_of(minimize(loss, START, method="Nelder-Mead", options={"maxiter": 600, "adaptive": True}).x)


def _dishonesty(samples: Sequence[PoseSample], model: CovarianceModel) -> float:
    """How far median and 95 % quantile are from what is expected, a tail too wide twice as bad; and the likelihood."""
    covariances = covariances_of(samples, model)
    squared = normalised_errors(np.array([sample.error for sample in samples]), covariances)
    middle = np.log(np.median(squared) / MEDIAN_EXPECTED)
    tail = np.log(np.quantile(squared, 0.95) / TAIL_EXPECTED)
    # a heavy tail, so that a few bad fits do not widen all others
    surprise = np.mean(np.linalg.slogdet(covariances)[1] + 16 * np.log1p(squared / 10))
    return float(middle**2 + (2 if tail > 0 else 1) * tail**2 + SHARPNESS * surprise)


def _model_of(logarithms: Array) -> CovarianceModel:
    inflation, disorder, motion, metres, degrees = (float(x) for x in np.exp(np.maximum(logarithms, LOWEST)))
    return CovarianceModel(inflation, *FLOOR, disorder, motion, metres, degrees)


RIGHT_M, RIGHT_DEG = 1.0, 5.0
NEAR_M = 0.1  # from so far the domains' pairs are aligned: it is the covariance that is fitted, not the search
WEIGHT = 3.0  # of a recording against a domain: it has all that a rover meets
DEFAULT_OUT = Path("config/verification/calibration.json")
Groups = dict[str, list[PoseSample]]


def main(
    bags: Annotated[list[Path], typer.Argument(help="recordings with ground truth")],
    folder: Annotated[Path | None, typer.Option(help="keeps the domains' simulated scans")] = None,
    kept: Annotated[Path | None, typer.Option(help="keeps what was found in recordings and domains")] = None,
    leave_out: Annotated[bool, typer.Option(help="judge every recording by a fit to the others")] = False,
    out: Annotated[Path, typer.Option(help="the acceptance model whose covariance is replaced")] = DEFAULT_OUT,
) -> None:
    """Fit, and print how honest the model is about every recording and domain."""
    console = Console()
    groups: Groups = {}
    for domain in DOMAINS:
        groups[domain.name] = remembered(kept, domain.name, partial(in_domain, domain, folder))
    for bag in bags:
        groups[bag.stem] = remembered(kept, bag.stem, partial(in_recording, bag))
    weights = {bag.stem: WEIGHT for bag in bags}
    model = fit_scan_covariance(groups, weights)
    for name, samples in groups.items():
        console.print(f"{name:28} n {len(samples):4}  nees {{:5.1f}}  inside {{:.3f}}".format(*honesty(samples, model)))
    for bag in bags if leave_out else []:
        others = {name: samples for name, samples in groups.items() if name != bag.stem}
        figures = honesty(groups[bag.stem], fit_scan_covariance(others, weights))
        console.print(f"left out {bag.stem:19} nees {{:5.1f}}  inside {{:.3f}}".format(*figures))
    content = json.loads(out.read_text(encoding="utf-8"))
    content["covariance"][SCAN] = {name: float(f"{value:.4g}") for name, value in asdict(model).items()}
    content["fitted_with"]["covariance of scans"] = f"python -m umf_ros.lab.fit.covariance on {len(bags)} recordings"
    out.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    console.print(f"{content['covariance'][SCAN]}\nwrote {out}")


def in_recording(bag: Path) -> Iterator[PoseSample]:
    """The right closures of a recording."""
    recording = open_bag(bag)
    settings = settings_for(recording, None, "auto")
    truth = read_ground_truth(recording)
    if truth is None or not truth.has_orientation:
        raise BagError(f"{bag} holds no ground truth with orientations")
    detector = LoopDetector(settings, make_detector_embedder(settings))
    remembered: dict[int, Keyframe] = {}
    for frame in FrameReader(recording, settings):
        detection = detector.process(frame)
        if detection.keyframe is None:
            continue
        remembered[frame.stamp_ns] = detection.keyframe
        for closure in detection.closures:
            stamps = np.array([closure.query_stamp_ns, closure.match_stamp_ns])
            (query, match), known = truth.at(stamps)
            if known.all():
                pair = remembered[closure.match_stamp_ns], detection.keyframe
                yield from right_sample(*pair, closure.match_T_query, relative(match, query))


def in_domain(domain: Domain, folder: Path | None) -> list[PoseSample]:
    """Pairs of one domain, aligned from near their true poses."""
    rng = np.random.default_rng(VALIDATION[0])
    seeds = range(VALIDATION[0], VALIDATION[0] + QUICK.worlds)
    places = places_of(domain, seeds, QUICK, folder, make_embedder(EmbeddingSettings(threads=1)))
    samples: list[PoseSample] = []
    for pair in pairs_of(places, domain, rng):
        if pair.kind in (SAME, TURNED):
            guess = pair.match_T_query.copy()
            guess[:3, 3] += NEAR_M * rng.standard_normal(3)
            samples += right_sample(pair.match.keyframe, pair.query.keyframe, guess, pair.match_T_query)
    return samples


def right_sample(match: Keyframe, query: Keyframe, guess: Array, true: Array) -> list[PoseSample]:
    """The sample of a pair, none where its alignment is wrong or there is nothing to align."""
    scans = PreparedScan(match.points), PreparedScan(query.points)
    if not all(scan.usable for scan in scans):
        return []
    alignment = align_scans(*scans, guess)
    gap = relative(true, alignment.pose)
    right = np.linalg.norm(gap[:3, 3]) < RIGHT_M and np.degrees(rotation_angle(gap)) < RIGHT_DEG
    return [sample_of(match, query, alignment, true)] if right else []


def remembered(folder: Path | None, name: str, find: Callable[[], Iterable[PoseSample]]) -> list[PoseSample]:
    """Samples that an earlier call left in the folder, else new ones."""
    path = None if folder is None else folder / f"{name}.samples.pkl"
    return kept_in(path, lambda: list(find()))


if __name__ == "__main__":
    typer.run(main)
