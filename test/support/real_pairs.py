"""Pairs of real scans: read, drawn, and counted by their decisions."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from rich.progress import track

from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, adjoint, from_quaternion, invert, logmap, propagate, ros_to_gtsam_covariance
from umf_ros.lab.simulation.domains.pairs import is_wrong
from umf_ros.runs.truth import normalised_errors, pose_error, share_inside
from umf_ros.sensors.decode import Cloud
from umf_ros.verification import Hypothesis

INSIDE_95 = 12.59
"""95 % of squared Mahalanobis distances in six dimensions are below."""
POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class RealPair:
    """Two scans and what is known of them.

    Attributes:
        match: path relative to the folder.
        query: likewise.
        same_place: whether they show the same place.
        match_T_query: the true pose, or None.
    """

    match: str
    query: str
    same_place: bool
    match_T_query: Array | None = None


def cropped(cloud: Cloud, half_width_deg: float) -> Cloud:
    """The part of a scan that a LiDAR sees which looks forward and no further than this to either side."""
    ahead = np.abs(np.degrees(np.arctan2(cloud.points[:, 1], cloud.points[:, 0]))) <= half_width_deg
    return Cloud(cloud.points[ahead], None if cloud.intensity is None else cloud.intensity[ahead])


def read_pairs(path: Path) -> Iterator[RealPair]:
    """Rows of a list of pairs."""
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            pose = [row.get(name) or "" for name in POSE_COLUMNS]
            known = all(pose)
            numbers = [float(value) for value in pose] if known else []
            match_T_query = from_quaternion(numbers[:3], numbers[3:]) if known else None
            yield RealPair(row["match_scan"], row["query_scan"], row["same_place"] == "1", match_T_query)


def draw_pairs(
    folder: Path, keyframe: Callable[[str], Keyframe], count: int, apart: int, seed: int = 0
) -> Iterator[RealPair]:
    """Pairs of a drive without revisits: every one shows two places."""
    names = sorted(str(path.relative_to(folder)) for path in (folder / "scans").iterdir())
    rng = np.random.default_rng(seed)
    descriptors = np.array([keyframe(name).embedding.descriptor for name in track(names, "embedding", transient=True)])
    similarity = descriptors @ descriptors.T
    order = np.arange(len(names))
    similarity[order[:, None] - order[None] <= apart] = -np.inf
    queries = rng.permutation(order[apart + 1 :])[: count // 2]
    for query in queries:
        yield RealPair(names[int(rng.integers(query - apart))], names[query], False)
        yield RealPair(names[int(similarity[query].argmax())], names[query], False)


def summary(verdicts: list[tuple[RealPair, Hypothesis]]) -> dict[str, float]:
    """Counts, and for true pairs with a known pose how far off and how honest the closures are."""
    accepted = [(pair, verdict) for pair, verdict in verdicts if verdict.closure is not None]
    true = [pair for pair, _ in verdicts if pair.same_place]
    right = [one for one in accepted if one[0].same_place and not is_misplaced(*one)]
    errors, covariances = [], []
    for pair, verdict in right:
        if pair.match_T_query is not None and verdict.closure is not None:
            errors.append(pose_error(verdict.closure.match_T_query, pair.match_T_query))
            covariances.append(verdict.closure.covariance)
    nan = float("nan")
    return {
        "true_pairs": len(true),
        "true_accepted": len(right),
        "true_misplaced": sum(pair.same_place for pair, _ in accepted) - len(right),
        "false_pairs": len(verdicts) - len(true),
        "false_accepted": sum(not pair.same_place for pair, _ in accepted),
        "error_median_m": float(np.median(np.linalg.norm(np.array(errors)[:, :3], axis=1))) if errors else nan,
        "inside_95": share_inside(normalised_errors(np.array(errors), np.array(covariances))) if errors else nan,
    } | among_themselves(right)


def among_themselves(verdicts: list[tuple[RealPair, Hypothesis]]) -> dict[str, float]:
    """How many triangles right closures form, and the share of those that close within their 95 % ellipsoid.

    No reference is needed: the third closure was measured apart from the two that lead to the same scan.
    """
    known = {(pair.match, pair.query): verdict.closure for pair, verdict in verdicts if verdict.closure is not None}
    pose = {key: closure.match_T_query for key, closure in known.items()}
    noise = {key: ros_to_gtsam_covariance(closure.covariance, pose[key]) for key, closure in known.items()}
    distances = []
    for (first, middle), (other, last) in product(known, known):
        if middle == other and (first, last) in known:
            left = logmap((invert(pose[first, last]) @ pose[first, middle] @ pose[middle, last])[None])[0]
            carried = propagate(adjoint(invert(pose[middle, last])), noise[first, middle])
            spread = carried + noise[middle, last] + noise[first, last]
            distances.append(float(left @ np.linalg.solve(spread, left)))
    inside = float(np.mean(np.array(distances) <= INSIDE_95)) if distances else float("nan")
    return {"triangles": len(distances), "triangles_inside_95": inside}


def is_misplaced(pair: RealPair, verdict: Hypothesis) -> bool:
    if pair.match_T_query is None or verdict.closure is None:
        return False
    return is_wrong(verdict.closure.match_T_query, pair.match_T_query)
