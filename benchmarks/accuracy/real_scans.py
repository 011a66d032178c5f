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

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from umf_ros.core.config import EmbeddingSettings, Settings, Verification
from umf_ros.core.frames import Frame, Keyframe
from umf_ros.core.geometry import Array, expmap, relative
from umf_ros.detector import LoopDetector, make_detector_embedder, make_keyframe
from umf_ros.embedding import make_embedder
from umf_ros.lab.evaluation.comparison import judge
from umf_ros.lab.scan_files import make_snapshot, read_scan
from umf_ros.lab.simulation.domains.pairs import is_wrong
from umf_ros.verification import Verifier

sys.path.insert(0, str(Path(__file__).parents[2] / "test"))
from support.real_pairs import cropped, draw_pairs, is_misplaced, read_pairs, summary

KEPT = 1000  # keyframes in memory
STEP_NS, PAUSE_NS = 2_000_000_000, 60_000_000_000
LONGER, DRIFT_DEG = 0.015, 0.3


def main(
    folder: Annotated[Path, typer.Argument(help="scans and pairs.csv")],
    sample: Annotated[int, typer.Option(help="pairs drawn where there is no pairs.csv")] = 200,
    apart: Annotated[int, typer.Option(help="scans between the two of such a pair, at least")] = 20,
    drive: Annotated[bool, typer.Option(help="drive along the scans twice instead")] = False,
    crop: Annotated[float, typer.Option(help="keep what lies at most this far to either side, deg")] = 180.0,
    json_file: Annotated[Path | None, typer.Option("--json", help="write the figures to this file")] = None,
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
    if json_file:
        json_file.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


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
