"""Verification on real scans in a plain folder, LiDAR alone: how many true and how many false pairs are accepted.

python benchmarks/accuracy/real_scans.py FOLDER [--sample N] [--apart N] [--crop DEG] [--json FILE]

The folder holds scans as `umf compare` reads them, and `pairs.csv` with the columns match_scan, query_scan (paths
relative to the folder) and same_place (1 or 0), and where it is known the true pose of the query in the match: x, y,
z, qx, qy, qz, qw.

Without `pairs.csv` the scans in `scans/`, in the order of their names, are taken for a drive that sees no place
twice: of pairs further apart in that order, half are drawn at random, the other half are those most alike.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from umf_ros.comparison import judge
from umf_ros.core.config import EmbeddingSettings, Verification
from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, from_quaternion
from umf_ros.detector import make_keyframe
from umf_ros.embedding import make_embedder
from umf_ros.lab.fit.acceptance import inside_ellipsoid
from umf_ros.lab.simulation.domains.pairs import error_vector, is_wrong
from umf_ros.sensors.decode import Cloud
from umf_ros.sensors.scan_files import make_snapshot, read_scan
from umf_ros.verification import Hypothesis, Verifier

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
KEPT = 1000  # keyframes in memory


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


def main(
    folder: Annotated[Path, typer.Argument(help="scans and pairs.csv")],
    sample: Annotated[int, typer.Option(help="pairs drawn where there is no pairs.csv")] = 200,
    apart: Annotated[int, typer.Option(help="scans between the two of such a pair, at least")] = 20,
    crop: Annotated[float, typer.Option(help="keep what lies at most this far to either side, deg")] = 180.0,
    json_file: Annotated[Path | None, typer.Option("--json", help="write the figures here")] = None,
) -> None:
    """Verify the pairs of a folder and compare with what is known."""
    console = Console()
    embedder = make_embedder(EmbeddingSettings(threads=1))

    @lru_cache(KEPT)
    def keyframe(path: str) -> Keyframe:
        cloud = cropped(read_scan(folder / path), crop)
        return make_keyframe(make_snapshot(cloud), embedder)

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
        if verdict.closure is not None and (not pair.same_place or _misplaced(pair, verdict)):
            console.print(f"wrong: {pair.match} {pair.query} probability {verdict.closure.probability:.3f}")
    if json_file:
        json_file.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


def cropped(cloud: Cloud, half_width_deg: float) -> Cloud:
    """What a LiDAR that looks forward and no further than this to either side would have seen."""
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
    right = [one for one in accepted if one[0].same_place and not _misplaced(*one)]
    errors, covariances = [], []
    for pair, verdict in right:
        if pair.match_T_query is not None and verdict.closure is not None:
            errors.append(error_vector(verdict.closure.match_T_query, pair.match_T_query))
            covariances.append(verdict.closure.covariance)
    nan = float("nan")
    return {
        "true_pairs": len(true),
        "true_accepted": len(right),
        "true_misplaced": sum(pair.same_place for pair, _ in accepted) - len(right),
        "false_pairs": len(verdicts) - len(true),
        "false_accepted": sum(not pair.same_place for pair, _ in accepted),
        "error_median_m": float(np.median(np.linalg.norm(np.array(errors)[:, :3], axis=1))) if errors else nan,
        "inside_95": inside_ellipsoid(np.array(errors), np.array(covariances)) if errors else nan,
    }


def _misplaced(pair: RealPair, verdict: Hypothesis) -> bool:
    if pair.match_T_query is None or verdict.closure is None:
        return False
    return is_wrong(verdict.closure.match_T_query, pair.match_T_query)


if __name__ == "__main__":
    typer.run(main)
