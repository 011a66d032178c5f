"""Verification on real scans in a plain folder, LiDAR alone: how many true and how many false pairs are accepted.

python benchmarks/accuracy/real_scans.py FOLDER [--drive] [--sample N] [--apart N] [--crop DEG] [--json FILE]

The folder holds scans as `umf compare` reads them, and `pairs.csv` with the columns match_scan, query_scan (paths
relative to the folder) and same_place (1 or 0), and where it is known the true pose of the query in the match: x, y,
z, qx, qy, qz, qw.

`--drive` drives along the scans of `pairs.csv` in the order of their names: every second scan, then those between, with
odometry that is too long by 1.5 % and drifts in heading by .3 deg per root metre. Printed is how many scans of the
second pass close a loop, and how many of these closures are wrong.

Without `pairs.csv` the scans in `scans/`, in the order of their names, are taken for a drive that sees no place
twice: of pairs further apart in that order, half are drawn at random, the other half are those most alike.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from umf_ros.core.config import EmbeddingSettings, Settings, Verification
from umf_ros.core.frames import Frame, Keyframe
from umf_ros.core.geometry import (
    Array,
    adjoint,
    expmap,
    from_quaternion,
    invert,
    logmap,
    propagate,
    relative,
    ros_to_gtsam_covariance,
)
from umf_ros.detector import LoopDetector, make_detector_embedder, make_keyframe
from umf_ros.embedding import make_embedder
from umf_ros.lab.evaluation.comparison import judge
from umf_ros.lab.program import JsonFile, write_figures
from umf_ros.lab.scan_files import make_snapshot, read_scan
from umf_ros.lab.simulation.domains.pairs import is_wrong
from umf_ros.runs.truth import normalised_errors, pose_error, share_inside
from umf_ros.sensors.decode import Cloud
from umf_ros.verification import Hypothesis, Verifier

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


KEPT = 1000  # keyframes in memory
STEP_NS, PAUSE_NS = 2_000_000_000, 60_000_000_000
LONGER, DRIFT_DEG = 0.015, 0.3


def main(
    folder: Annotated[Path, typer.Argument(help="scans and pairs.csv")],
    sample: Annotated[int, typer.Option(help="pairs drawn where there is no pairs.csv")] = 200,
    apart: Annotated[int, typer.Option(help="scans between the two of such a pair, at least")] = 20,
    drive: Annotated[bool, typer.Option(help="drive along the scans twice instead")] = False,
    crop: Annotated[float, typer.Option(help="keep what lies at most this far to either side, deg")] = 180.0,
    json_file: JsonFile = None,
) -> None:
    """Verify the pairs of a folder and compare with what is known."""
    console = Console()
    embedder = make_embedder(EmbeddingSettings(threads=1))

    @lru_cache(KEPT)
    def keyframe(path: str) -> Keyframe:
        cloud = cropped(read_scan(folder / path), crop)
        frame = make_snapshot(cloud)
        return make_keyframe(frame, embedder)

    if drive:
        for name, count in drive_figures(folder, lambda path: make_snapshot(cropped(read_scan(folder / path), crop))):
            console.print(f"{name:24} {count}")
        return
    listed = (folder / "pairs.csv").is_file()
    pairs = list(read_pairs(folder / "pairs.csv") if listed else draw_pairs(folder, keyframe, sample, apart))
    verifier = Verifier(Verification())
    verdicts = [
        (pair, judge(verifier, keyframe(pair.match), keyframe(pair.query)))
        for pair in track(pairs, folder.name, transient=True)
    ]
    figures = summary(verdicts)
    for name, value in figures.items():
        console.print(f"{name:24} {value:.4g}")
    for pair, verdict in verdicts:
        if verdict.closure is not None and (not pair.same_place or is_misplaced(pair, verdict)):
            console.print(f"wrong: {pair.match} {pair.query} probability {verdict.closure.probability:.3f}")
    write_figures(json_file, figures)


def drive_figures(folder: Path, frame: Callable[[str], Frame]) -> Iterator[tuple[str, int]]:
    """Yield the numbers of scans of the second pass, of those with a right closure, and of wrong closures."""
    pairs = list(read_pairs(folder / "pairs.csv"))
    poses: dict[str, Array] = {pairs[0].match: np.eye(4)}  # in the first scan
    for pair in pairs:
        if pair.match == pairs[0].match and pair.match_T_query is not None:
            poses[pair.query] = pair.match_T_query
    names, rng, settings = sorted(poses, key=lambda name: (len(name), name)), np.random.default_rng(0), Settings()
    detector = LoopDetector(settings, make_detector_embedder(settings))
    first, second = names[::2], names[1::2]
    odom_T_body, stamp_ns, right, wrong = np.eye(4), 0, 0, 0
    taken: dict[int, str] = {}
    for name in first + second:
        if taken:
            moved = relative(poses[taken[stamp_ns]], poses[name])
            drift = np.radians(DRIFT_DEG) * np.sqrt(np.linalg.norm(moved[:3, 3])) * rng.normal()
            odom_T_body = odom_T_body @ moved @ expmap(np.array([0, 0, drift, *(LONGER * moved[:3, 3])]))
        stamp_ns += PAUSE_NS if name == second[0] else STEP_NS
        taken[stamp_ns] = name
        closures = detector.process(replace(frame(name), stamp_ns=stamp_ns, odom_T_body=odom_T_body)).closures
        true = [relative(poses[taken[one.match_stamp_ns]], poses[name]) for one in closures]
        misplaced = sum(is_wrong(one.match_T_query, pose) for one, pose in zip(closures, true, strict=True))
        wrong += misplaced
        right += name in second and len(closures) > misplaced
    detector.close()
    yield from {"second pass": len(second), "right": right, "wrong": wrong}.items()


if __name__ == "__main__":
    typer.run(main)
