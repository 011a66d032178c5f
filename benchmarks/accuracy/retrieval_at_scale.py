"""Whether a rover still finds its places when the database holds those of many other worlds.

python benchmarks/accuracy/retrieval_at_scale.py BAG... [--quick] [--only METHOD] [--json FILE]

Every recording (`umf simulate --preset mapping` and `loops`; with a ground truth) is run through the detector with 0,
1,000, 10,000 and 100,000 places of other worlds beside its own. These compete for the candidates as all others do; as
they lie elsewhere, none of them can become a right closure, so a candidate that is one of them is a candidate lost.
Printed for each method is the share of revisits, of any heading, that still got a right closure.

The other places are seen along trails of validation worlds at training size, some hundred at least; up to the count
asked for, the rest lie between neighbours of these: mixtures of two descriptors that follow each other on a trail,
with as much noise as tells two scans of one place apart.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import BagError
from umf_ros.core.frames import Frame, Keyframe, LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.embedding import Embedder, make_embedder
from umf_ros.lab.evaluation.worlds import FULL, QUICK, TestWorld
from umf_ros.lab.simulation.world import VALIDATION
from umf_ros.runs.truth import find_revisits, judge_closures

sys.path.insert(0, str(Path(__file__).parents[2] / "test"))
from support.crowds import METHODS, PLACES, CrowdedDetector, Method, crowd_of


class Recording:
    """The keyframes of a recording, and the descriptors that every method makes of them."""

    def __init__(self, bag: Path, embedders: dict[Method, Embedder]) -> None:
        source = open_bag(bag)
        self._settings = settings_for(source, None, "auto")
        truth = read_ground_truth(source)
        if truth is None or not truth.has_orientation:
            raise BagError(f"{bag} holds no ground truth with orientations")
        self._truth: Trajectory = truth
        self._embedders = embedders
        self._descriptors: dict[Method, list[Array]] = {method: [] for method in embedders}
        self._keyframes: list[tuple[Frame, Keyframe]] = []
        detector = LoopDetector(self._settings, make_detector_embedder(self._settings))
        for frame in FrameReader(source, self._settings):
            if detector.select(frame):
                bare = replace(frame, left=None, right=None, points=None, intensity=None, motion=None)
                self._keyframes.append((bare, detector.embed(frame)))
                for method, embedder in embedders.items():
                    self._descriptors[method].append(embedder.embed(method.seen(frame)).descriptor)

    def closed(self, method: Method, crowd: Array) -> float:
        """Share of the revisits of any heading that got a right closure beside a crowd of places."""
        detector = CrowdedDetector(self._settings, self._embedders[method], crowd)
        closures: list[LoopClosure] = []
        for (frame, whole), descriptor in zip(self._keyframes, self._descriptors[method], strict=True):
            detector.select(frame)
            keyframe = replace(whole, embedding=replace(whole.embedding, descriptor=descriptor))
            verdicts = detector.match_submaps(keyframe, detector.verify(keyframe, detector.query(keyframe)))
            closures += [verdict.closure for verdict in verdicts if verdict.closure is not None]
            detector.remember(keyframe)
        return self._judge(closures)

    def _judge(self, closures: list[LoopClosure]) -> float:
        stamps = np.array([keyframe.stamp_ns for _, keyframe in self._keyframes], np.int64)
        poses, known = self._truth.at(stamps)
        path_length = np.array([keyframe.path_length_m for _, keyframe in self._keyframes])
        again = stamps[known][
            find_revisits(stamps[known], poses[known], path_length[known], self._settings.loop, same_view=False)
        ]
        true = {closure.query_stamp_ns for closure in closures if self._is_true(closure)}
        return float(np.isin(again, list(true)).mean()) if len(again) else float("nan")

    def _is_true(self, closure: LoopClosure) -> bool:
        (query, match), known = self._truth.at(np.array([closure.query_stamp_ns, closure.match_stamp_ns]))
        return bool(known.all()) and judge_closures([closure], query[None], match[None])[0].is_true


def other_places(worlds: int, quick: bool) -> Iterator[tuple[int, Frame]]:
    """World and frame of places along trails of validation worlds, in the order of the trail."""
    for seed in track(VALIDATION[:worlds], "other worlds"):
        for visit in TestWorld(seed, QUICK if quick else FULL):
            if visit.pass_index == 0:
                yield seed, visit.frame


def main(
    bags: Annotated[list[Path], typer.Argument(help="recordings with ground truth")],
    quick: Annotated[bool, typer.Option(help="two other worlds, and only the smallest and the largest crowd")] = False,
    json_file: Annotated[Path | None, typer.Option("--json", help="write the figures to this file")] = None,
    only: Annotated[str, typer.Option(help="methods whose name contains this")] = "",
) -> None:
    """Share of revisits closed beside ever more places of other worlds."""
    console = Console()
    places = (PLACES[0], PLACES[-1]) if quick else PLACES
    elsewhere = list(other_places(2 if quick else 12, quick))
    worlds = np.array([world for world, _ in elsewhere])
    chosen = [method for method in METHODS if only in method.name]
    embedders = {method: make_embedder(EmbeddingSettings(method=method.embedder)) for method in chosen}
    crowds = {
        method: crowd_of(np.stack([embedder.embed(method.seen(frame)).descriptor for _, frame in elsewhere]), worlds)
        for method, embedder in embedders.items()
    }
    shares: dict[tuple[Method, int], list[float]] = defaultdict(list)
    for bag in bags:
        recording = Recording(bag, embedders)
        for method, count in product(embedders, places):
            shares[method, count].append(recording.closed(method, crowds[method][:count]))
            console.print(f"{method.name} {bag.stem} beside {count} places: {shares[method, count][-1]:.3f} closed")
    figures = {f"{method.name}.closed_{count}": float(np.mean(found)) for (method, count), found in shares.items()}
    table = Table("method", *(f"{count:,} places" for count in places), title="revisits closed, any heading", box=None)
    for method in embedders:
        table.add_row(method.name, *(f"{figures[f'{method.name}.closed_{count}']:.3f}" for count in places))
    console.print(table)
    if json_file:
        json_file.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
