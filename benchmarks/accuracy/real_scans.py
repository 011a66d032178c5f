"""Verification on real scans in a plain folder, LiDAR alone: how many true and how many false pairs are accepted.

python benchmarks/accuracy/real_scans.py FOLDER [--sample N] [--apart N] [--crop DEG] [--json FILE]

The folder holds scans as `umf compare` reads them, and `pairs.csv` with the columns match_scan, query_scan (paths
relative to the folder) and same_place (1 or 0), and where it is known the true pose of the query in the match: x, y,
z, qx, qy, qz, qw.

Without `pairs.csv` the scans in `scans/`, in the order of their names, are taken for a drive that sees no place
twice: of pairs further apart in that order, half are drawn at random, the other half are those most alike.
"""

from __future__ import annotations

import json
import sys
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track

from umf_ros.core.config import EmbeddingSettings, Verification
from umf_ros.core.frames import Keyframe
from umf_ros.detector import make_keyframe
from umf_ros.embedding import make_embedder
from umf_ros.lab.evaluation.comparison import judge
from umf_ros.lab.scan_files import make_snapshot, read_scan
from umf_ros.verification import Verifier

sys.path.insert(0, str(Path(__file__).parents[2] / "test"))
from support.real_pairs import cropped, draw_pairs, is_misplaced, read_pairs, summary

KEPT = 1000  # keyframes in memory


def main(
    folder: Annotated[Path, typer.Argument(help="scans and pairs.csv")],
    sample: Annotated[int, typer.Option(help="pairs drawn where there is no pairs.csv")] = 200,
    apart: Annotated[int, typer.Option(help="scans between the two of such a pair, at least")] = 20,
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


if __name__ == "__main__":
    typer.run(main)
