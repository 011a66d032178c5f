"""Evaluate on simulated worlds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from umf_ros.core.config import EmbeddingSettings, Verification
from umf_ros.core.frames import WORDS_WEIGHT, Frame, ScanMotion
from umf_ros.core.geometry import Array, evenly
from umf_ros.embedding import Embedder, make_embedder
from umf_ros.lab.evaluation.results import Scores, YawBin, recall_by_yaw, score
from umf_ros.lab.evaluation.retrieval import (
    METHODS,
    MODES,
    Indices,
    PlaceCollection,
    Ranking,
    RetrievalTask,
    place_recognition,
    rank,
    rerank_all,
    word_similarity,
)
from umf_ros.lab.evaluation.summary import WorldResult, WorldsSummary, at_full_size, cost_of_weights
from umf_ros.lab.simulation.camera import resized
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.route import SETTINGS, Pass, plan_passes, thinned
from umf_ros.lab.simulation.survey import Survey, SurveyFrame
from umf_ros.lab.simulation.world import TEST, VALIDATION, World, ground
from umf_ros.networks.config import locate_weights
from umf_ros.sensors.calibration import Calibration, load_calibration

WORLDS = 4
FIRST_SEEDS = {"test": TEST.start, "validation": VALIDATION.start}
FIRST, REVISIT, SAME_LIGHT, OPPOSITE = range(4)
"""Numbers of the passes."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """How densely the passes are driven: metres between references, and every how many steps a pass is asked.

    Attributes:
        step_m: distance between the samples of the first pass.
        revisit: the pass on an offset path under another sun takes every so many-th sample.
        same_light: so does the same pass under the first one's sun.
        opposite: so does the pass in the opposite direction.
    """

    step_m: float
    revisit: int
    same_light: int
    opposite: int


FULL = Sampling(step_m=1.6, revisit=2, same_light=4, opposite=4)
QUICK = Sampling(step_m=3.2, revisit=4, same_light=8, opposite=8)


@dataclass(frozen=True, slots=True)
class Visit:
    """A frame and where it was taken.

    Attributes:
        frame: at training resolution, with the intrinsics of that resolution.
        world_T_body: true pose.
        pass_index: which pass.
    """

    frame: Frame
    world_T_body: Array
    pass_index: int


class TestWorld:
    """One world in the hard setting (offset to 4.5 m, yaw 16 deg, sun moved 70 deg, aliasing).

    Args:
        seed: of the world; its family follows from it.
        sampling: how densely it is driven.
        calibration: of the rover; None: the simulated one.
    """

    __test__ = False  # no test of pytest's, whatever the name suggests

    def __init__(self, seed: int, sampling: Sampling, calibration: Calibration | None = None) -> None:
        self.seed, self.family = seed, FAMILIES[seed % len(FAMILIES)]
        self.name = f"{self.family} {seed}"
        self._sampling = sampling
        self._calibration = calibration or load_calibration("simulated")

    @cached_property
    def passes(self) -> list[Pass]:
        """The drives by their numbers."""
        return _drives(self.seed, self.family, self._sampling)

    def __len__(self) -> int:
        return sum(len(drive.path) for drive in self.passes)

    @property
    def revisits(self) -> int:
        """Samples of the pass that is reranked."""
        return len(self.passes[REVISIT].path)

    def __iter__(self) -> Iterator[Visit]:
        """Build the world and drive; takes some seconds before the first frame."""
        return self.driven(range(len(self.passes)))

    def driven(self, wanted: Collection[int]) -> Iterator[Visit]:
        """The same, of some passes alone."""
        path = np.concatenate([drive.path for drive in self.passes])
        world = World(self.seed, self.family, SETTINGS["hard"].aliasing, path)
        calibration = self._calibration
        drives = [
            drive if number in wanted else thinned(drive, len(drive.path)) for number, drive in enumerate(self.passes)
        ]
        for stamp, sample in enumerate(Survey(world, drives, calibration)):
            if sample.pass_index in wanted:
                yield visit_of(stamp, sample, calibration)


def test_worlds(first_seed: int, sampling: Sampling, count: int = WORLDS) -> list[TestWorld]:
    """So many worlds of different families, made from `first_seed` on."""
    return [TestWorld(first_seed + number, sampling) for number in range(count)]


def _drives(seed: int, family: str, sampling: Sampling) -> list[Pass]:
    setting = SETTINGS["hard"]
    trail = ground(seed, family, setting.aliasing).trail
    first, offset, opposite = plan_passes(trail, ("first", "offset", "opposite"), setting, sampling.step_m, seed)
    same_light = replace(offset, label="same light", sun=first.sun)
    return [
        first,
        thinned(offset, sampling.revisit),
        thinned(same_light, sampling.same_light),
        thinned(opposite, sampling.opposite),
    ]


def visit_of(stamp_ns: int, sample: SurveyFrame, calibration: Calibration) -> Visit:
    """A simulated sample as a frame, its intrinsics those of its resolution."""
    height, width = sample.image.shape
    points = sample.points.astype(np.float32)
    frame = Frame(
        stamp_ns=stamp_ns,
        camera=resized(calibration.camera, width, height),
        body_T_camera=calibration.body_T_camera,
        body_T_lidar=calibration.body_T_lidar,
        left=sample.image,
        points=points[:, :3],
        intensity=points[:, 3],
        motion=ScanMotion.none(len(points)),
    )
    return Visit(frame, sample.world_T_body.astype(float), sample.pass_index)


ASKED = {
    # what the queries and the references are embedded with, and what descriptor and words count
    "fused": ("fused", "fused", 1.0, 0.0),
    "image": ("image", "image", 1.0, WORDS_WEIGHT),
    "lidar": ("lidar", "lidar", 1.0, 0.0),
    "image black": ("image black", "fused", 1.0, 0.0),
    "cloud empty": ("cloud empty", "fused", 1.0, WORDS_WEIGHT),
    "image, network": ("image", "image", 1.0, 0.0),
    "cloud empty, network": ("cloud empty", "fused", 1.0, 0.0),
    "words": ("image", "image", 0.0, 1.0),
    "fused, words": ("fused", "fused", 1.0, WORDS_WEIGHT),
}
TIMED_FRAMES = 8


class WorldEvaluation:
    """Drives through a world and asks its questions.

    Args:
        world: to drive through.
        embedder: what is evaluated; with super-features where their reranking is wanted.
        settings: of the rerankers.
        report: called after every frame and every reranked query.
    """

    def __init__(
        self, world: TestWorld, embedder: Embedder, settings: Verification, report: Callable[[], None] = lambda: None
    ) -> None:
        self._world, self._settings, self._report = world, settings, report
        self._places = PlaceCollection(embedder)
        self._frames: list[Frame] = []
        self._poses: list[Array] = []
        self._passes: list[int] = []

    def run(self) -> WorldResult:
        """Embed, retrieve, rerank and score."""
        for visit in self._world:
            self._remember(visit)
            self._report()
        task, similarity = self._ask((REVISIT,))
        ranking = rank(similarity)
        sides = task.queries, task.references
        queries, references = ([self._places.keyframes[row] for row in rows] for rows in sides)
        reranking = rerank_all(queries, references, ranking, similarity, self._settings, self._report)
        return WorldResult(
            name=self._world.name,
            references=len(task.references),
            scores={
                **self._score_modes(word_similarity(queries, references)),
                "same light": score(*self._ranked((SAME_LIGHT,))),
                **{method: score(task, reranking.after(method)) for method in METHODS},
            },
            yaw=self._recall_by_yaw(),
            milliseconds=reranking.milliseconds,
            examples=[self._frames[row] for row in evenly(len(self._frames), TIMED_FRAMES)],
        )

    def _remember(self, visit: Visit) -> None:
        modes = {FIRST: ("image", "lidar"), REVISIT: tuple(MODES)}.get(visit.pass_index, ())
        self._places.add(visit.frame, modes)
        self._frames.append(visit.frame)
        self._poses.append(visit.world_T_body)
        self._passes.append(visit.pass_index)

    def _rows(self, passes: tuple[int, ...]) -> Indices:
        """Samples of the first pass and of some others."""
        return np.flatnonzero(np.isin(self._passes, (FIRST, *passes)))

    def _task(self, rows: Indices) -> RetrievalTask:
        return place_recognition(np.stack(self._poses)[rows], np.array(self._passes)[rows])

    def _ask(
        self, passes: tuple[int, ...], of_query: str = "fused", of_reference: str = "fused"
    ) -> tuple[RetrievalTask, Array]:
        """Some passes against the first: the task, and (Q, R) how alike they are."""
        rows = self._rows(passes)
        task = self._task(rows).of_rows(rows)
        queries, references = self._places.descriptors(of_query), self._places.descriptors(of_reference)
        return task, queries[task.queries] @ references[task.references].T

    def _score_modes(self, words: Array) -> dict[str, Scores]:
        """Scores of all `ASKED`, given the similarity (Q, R) by words."""
        found = {}
        for name, (*modes, of_network, of_words) in ASKED.items():
            task, similarity = self._ask((REVISIT,), *modes)
            found[name] = score(task, rank(of_network * similarity + of_words * words))
        return found

    def _ranked(self, passes: tuple[int, ...]) -> tuple[RetrievalTask, Ranking]:
        task, similarity = self._ask(passes)
        return task, rank(similarity)

    def _recall_by_yaw(self) -> list[YawBin]:
        return recall_by_yaw(*self._ranked((REVISIT, OPPOSITE)))


def evaluate_worlds(
    weights: Path | None, worlds: list[TestWorld], repeats: int, report: Callable[[str, int], None]
) -> WorldsSummary:
    """Drive through all worlds, then take times.

    Args:
        weights: safetensors file or name of shipped weights, or None for the default.
        worlds: to drive through.
        repeats: how often each frame is embedded when time is taken.
        report: called with the name of what is worked on, and 1 for every frame or query done.
    """
    located, settings = locate_weights(weights), Verification()
    wanted = EmbeddingSettings(weights=str(located))
    embedder = make_embedder(wanted, super_features=True, features=settings.features)
    results = []
    for world in worlds:
        evaluation = WorldEvaluation(world, embedder, settings, lambda: report(world.name, 1))  # noqa: B023
        results.append(evaluation.run())
    report("taking times", 0)
    frames = [at_full_size(frame) for frame in results[0].examples]
    return WorldsSummary(results, cost_of_weights(located, frames, repeats))


def work(world: TestWorld) -> int:
    """How often a `WorldEvaluation` of the world reports, nearly."""
    return len(world) + world.revisits
