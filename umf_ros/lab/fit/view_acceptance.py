"""Fit the acceptance model and the covariance of views, what a camera alone decides by, to simulated recordings.

python -m umf_ros.lab.fit.view_acceptance BAG... [--keyframes FOLDER] [--out FILE]

The recordings (`umf simulate`, validation seeds) are read without their scans, as a rover without a LiDAR sees them.
Right and wrong examples are hypotheses about what retrieval offers, about nearer places that it missed, and about
places of the other recordings, which are all wrong; each with odometry and without. Only the model of views is
written; everything else in the file stays.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from scipy.spatial.transform import Rotation

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.config import Loop, Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array, heading, relative, wrap_angle
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.lab.fit.acceptance import Example, fit_covariance, fit_logistic, save_acceptance
from umf_ros.lab.simulation.drives import kept_in
from umf_ros.places.database import Mask, is_past
from umf_ros.runs.truth import (
    PLACE_ANGLE_DEG,
    PLACE_RADIUS_M,
    POSE_TOLERANCE_DEG,
    POSE_TOLERANCE_M,
    normalised_errors,
    share_inside,
)
from umf_ros.verification import Verifier
from umf_ros.verification.acceptance import AcceptanceModel, Logistic, load_acceptance, scores
from umf_ros.verification.hypothesis import IMAGE, Hypothesis
from umf_ros.verification.scan_alignment import covariance_of

DEFAULT_OUT = Path("config/verification/calibration.json")
RIGHT_M, RIGHT_DEG = 0.3, 2.0  # examples between right and wrong are left out
RIDGE = 0.03  # measured: with a tenth of it the wrong ones nearest to the threshold come nearer
MARGIN = 0.5  # log-odds that the worst wrong example of a recording left out stays below the threshold
# candidates per query: of retrieval, near ones besides, similar ones that are not near, and of other recordings
EXAMINED, MISSED, ELSEWHERE, FOREIGN = 3, 2, 2, 3
EVERY, CONSECUTIVE = 6, 3  # of so many keyframes the first few are queries: neighbours support each other
THRESHOLD = Verification().min_probability
THRESHOLD_ODDS = math.log(THRESHOLD / (1 - THRESHOLD))


@dataclass(frozen=True)
class Recording:
    """Keyframes (N) of a recording without scans, and their true poses (N, 4, 4)."""

    name: str
    keyframes: list[Keyframe]
    truth: Array

    def past(self, query: int) -> Mask:
        """Which earlier keyframes may be matches, (query,) bool."""
        stamps = np.array([one.stamp_ns for one in self.keyframes[: query + 1]])
        driven = np.array([one.path_length_m for one in self.keyframes[: query + 1]])
        return is_past(stamps[query] - stamps[:query], driven[query] - driven[:query], Loop())

    def near(self, query: int) -> Mask:
        """Which earlier keyframes show the same place, (query,) bool."""
        away = np.linalg.norm(self.truth[:query, :3, 3] - self.truth[query, :3, 3], axis=1)
        turned = np.abs(wrap_angle(heading(self.truth[:query]) - heading(self.truth[query])))
        found: Mask = self.past(query) & (away <= PLACE_RADIUS_M) & (turned <= np.radians(PLACE_ANGLE_DEG))
        return found

    def error(self, query: int, match: int, match_T_query: Array) -> Array:
        """Error (6,) of a pose in ROS order, axes of the match."""
        true = relative(self.truth[match], self.truth[query])
        turn = Rotation.from_matrix(match_T_query[:3, :3] @ true[:3, :3].T).as_rotvec()
        return np.concatenate([match_T_query[:3, 3] - true[:3, 3], turn])


@dataclass(frozen=True)
class ViewFinding:
    """An examined hypothesis of a recording, and the error (6,) of its pose: without bounds for another recording's."""

    recording: str
    examined: Hypothesis
    error: Array
    tracked: bool

    @property
    def right(self) -> bool:
        """Whether the pose is right."""
        return self._within(RIGHT_M, RIGHT_DEG)

    @property
    def wrong(self) -> bool:
        """Whether a published closure would count as wrong."""
        return not self._within(POSE_TOLERANCE_M, POSE_TOLERANCE_DEG)

    def _within(self, metres: float, degrees: float) -> bool:
        shift, turn = np.linalg.norm(self.error[:3]), np.degrees(np.linalg.norm(self.error[3:]))
        return bool(shift <= metres and turn <= degrees)

    @property
    def example(self) -> Example:
        """Data that the acceptance model is fitted to."""
        return Example(self.examined.measurements, self.right)


def main(
    bags: Annotated[list[Path], typer.Argument(help="simulated recordings")],
    keyframes: Annotated[Path | None, typer.Option(help="folder that keeps keyframes for the next time")] = None,
    out: Annotated[Path, typer.Option(help="where the model goes; it must exist")] = DEFAULT_OUT,
) -> None:
    """Examine candidates of recordings without scans, and fit what a camera alone decides by."""
    console = Console()
    recordings = [kept(keyframes, bag) for bag in bags]
    findings = [finding for number in range(len(recordings)) for finding in examine(recordings, number)]
    model, results = fit(findings)
    for name, value in results.items():
        console.print(f"{name:32} {value:.4g}")
    shipped = load_acceptance(str(out))
    models, covariances = shipped.models | model.models, shipped.covariances | model.covariances
    whole = replace(shipped, models=models, covariances=covariances)
    told = f"python -m umf_ros.lab.fit.view_acceptance on {len(bags)} recordings without scans"
    save_acceptance(whole, out, {IMAGE: told}, results)
    console.print(f"wrote {out}")


def fit(findings: list[ViewFinding]) -> tuple[AcceptanceModel, dict[str, float]]:
    """The model that explains the findings best, and how it does on recordings it was not fitted to."""
    findings = [finding for finding in findings if finding.right or finding.wrong]
    right = np.array([finding.right for finding in findings])
    odds = _held_out(findings)
    # the highest that a wrong one climbs in a recording that was left out stays below the threshold
    strictness = max(0.0, float(odds[~right].max(initial=-np.inf)) - THRESHOLD_ODDS + MARGIN)
    accepted = odds - strictness >= THRESHOLD_ODDS
    tracked = np.array([finding.tracked for finding in findings])
    sure = [one for one, good in zip(findings, right & accepted, strict=True) if good]
    errors = np.array([one.error for one in sure])
    informations = np.array([one.examined.alignment.information for one in sure if one.examined.alignment])
    covariance = fit_covariance(errors, informations)
    results = {
        "image_examples": float(len(findings)),
        "image_right": float(right.sum()),
        "image_recall_held_out": float(accepted[right & tracked].mean()),
        "image_recall_without_odometry": float(accepted[right & ~tracked].mean()),
        "image_wrong_held_out": float((accepted & ~right).sum()),
        "image_strictness": strictness,
        "image_inside_95": share_inside(normalised_errors(errors, covariance_of(informations, covariance))),
    }
    fitted = fit_logistic([finding.example for finding in findings], IMAGE, RIDGE)
    return AcceptanceModel({IMAGE: Logistic(fitted.bias - strictness, fitted.weights)}, {IMAGE: covariance}), results


def examine(recordings: list[Recording], number: int) -> Iterator[ViewFinding]:
    """Hypotheses about candidates of one recording, with odometry and without, and whether they are right."""
    mine = recordings[number]
    foreign = [one for other in recordings if other is not mine for one in other.keyframes]
    looks = np.array([one.embedding.descriptor for one in mine.keyframes])
    foreign_looks = np.array([one.embedding.descriptor for one in foreign]).reshape(-1, looks.shape[1])
    rng = np.random.default_rng(number)
    verifiers = {True: Verifier(Verification()), False: Verifier(Verification())}
    for query in track(range(len(mine.keyframes)), mine.name, transient=True):
        past = np.flatnonzero(mine.past(query))
        if query % EVERY >= CONSECUTIVE or not len(past):
            continue
        ordered = past[np.argsort(-looks[past] @ looks[query], kind="stable")]
        near = np.flatnonzero(mine.near(query))
        elsewhere = [row for row in ordered if row not in near][:ELSEWHERE]
        rows = np.unique(np.concatenate([ordered[:EXAMINED], rng.permutation(near)[:MISSED], elsewhere])).astype(int)
        strangers = np.argsort(-foreign_looks @ looks[query], kind="stable")[:FOREIGN]
        chosen = [(int(row), mine.keyframes[row]) for row in rows]
        chosen += [(-1, foreign[row]) for row in strangers]
        for tracked, verifier in verifiers.items():
            yield from _examined(mine, query, chosen, verifier, tracked)


def _examined(
    mine: Recording, query: int, chosen: list[tuple[int, Keyframe]], verifier: Verifier, tracked: bool
) -> Iterator[ViewFinding]:
    asked = mine.keyframes[query] if tracked else _untracked(mine.keyframes[query])
    pairs = []
    for row, match in chosen:
        similarity = float(asked.embedding.descriptor @ match.embedding.descriptor)
        # a stranger has another session, or its odometry would be compared
        match = replace(match, session=1) if row < 0 else match
        pairs.append((Candidate(row, match.stamp_ns, similarity), match if tracked else _untracked(match)))
    for one in verifier.examine(asked, pairs):
        row, pose = one.candidate.index, one.pose
        yield ViewFinding(mine.name, one, mine.error(query, row, pose) if row >= 0 else np.full(6, np.inf), tracked)


def _untracked(keyframe: Keyframe) -> Keyframe:
    return replace(keyframe, odom_T_body=None, path_length_m=float("nan"))


def kept(folder: Path | None, bag: Path) -> Recording:
    """The keyframes of a recording without its scans, from a file in the folder where an earlier call left it."""
    return kept_in(folder / f"{bag.stem}.pkl" if folder else None, lambda: read(bag))


def read(bag: Path) -> Recording:
    """The keyframes of a recording without its scans, where the truth knows their poses.

    Raises:
        BagError: it cannot be read.
    """
    recording = open_bag(bag)
    settings = settings_for(recording, None, "auto", topics__cloud="")
    truth = read_ground_truth(recording)
    assert truth is not None, f"{bag} has no ground truth"
    detector = LoopDetector(settings, make_detector_embedder(settings))
    found = [detector.embed(frame) for frame in FrameReader(recording, settings) if detector.select(frame)]
    poses, known = truth.at(np.array([keyframe.stamp_ns for keyframe in found], np.int64))
    return Recording(bag.stem, [one for one, good in zip(found, known, strict=True) if good], poses[known])


def _held_out(findings: list[ViewFinding]) -> Array:
    """Log-odds (N,) of each finding, every recording judged by a fit to the others."""
    odds = np.zeros(len(findings))
    names = np.array([finding.recording for finding in findings])
    for name in np.unique(names):
        others = [finding.example for finding in findings if finding.recording != name]
        model = fit_logistic(others, IMAGE, RIDGE)
        for index in np.flatnonzero(names == name):
            odds[index] = model.odds(scores(findings[index].examined.measurements))
    return odds


if __name__ == "__main__":
    typer.run(main)
