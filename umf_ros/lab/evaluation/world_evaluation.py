"""One world, embedded and scored in every way the thesis compares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from umf_ros.config import Verification
from umf_ros.embedding.embedder import Embedder
from umf_ros.frames import Frame
from umf_ros.geometry import Array
from umf_ros.lab.evaluation.embedded import MODES, PlaceCollection
from umf_ros.lab.evaluation.protocol import Task, YawBin, place_recognition, recall_by_yaw
from umf_ros.lab.evaluation.reranking import METHODS, gather_evidence, recall1_by_candidates
from umf_ros.lab.evaluation.retrieval import Indices, Ranking, rank
from umf_ros.lab.evaluation.scores import Scores, score
from umf_ros.lab.evaluation.worlds import FIRST, OPPOSITE, REVISIT, SAME_LIGHT, TestWorld, Visit

ASKED = {
    # what the queries and the references are embedded with
    "fused": ("fused", "fused"),
    "image": ("image", "image"),
    "lidar": ("lidar", "lidar"),
    "image black": ("image black", "fused"),
    "cloud empty": ("cloud empty", "fused"),
}
SHOWN = 3
"""Queries whose frames are kept for pictures."""


@dataclass(frozen=True, slots=True)
class WorldResult:
    """What was found in one world.

    Attributes:
        name: family and seed.
        references: samples of the first pass.
        scores: by what was asked: modes, rerankers, "same light".
        yaw: recall@1 by difference of heading, opposite direction included.
        by_candidates: (K,) recall@1 by number of reranked candidates, by reranker.
        milliseconds: of search and rerankers per query.
        descriptors: (N, D) fused.
        world_T_body: (N, 4, 4).
        pass_index: (N,).
        examples: frames of queries and of their best match after RANSAC.
    """

    name: str
    references: int
    scores: dict[str, Scores]
    yaw: list[YawBin]
    by_candidates: dict[str, Array]
    milliseconds: dict[str, float]
    descriptors: Array
    world_T_body: Array
    pass_index: Indices
    examples: list[tuple[Frame, Frame]] = field(default_factory=list)


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
        task, ranking = self._ask(REVISIT, "fused", "fused")
        scores = {name: score(*self._ask(REVISIT, *modes)) for name, modes in ASKED.items()}
        scores["same light"] = score(*self._ask(SAME_LIGHT, "fused", "fused"))
        similarity = self._similarity(task, "fused", "fused")
        queries, references = (
            [self._places.keyframes[row] for row in rows] for rows in (task.queries, task.references)
        )
        evidence = gather_evidence(queries, references, ranking, similarity, self._settings, self._report)
        scores |= {method: score(task, evidence.ranking(ranking, method)) for method in METHODS}
        best = evidence.ranking(ranking, "ransac both")
        return WorldResult(
            name=self._world.name,
            references=len(task.references),
            scores=scores,
            yaw=recall_by_yaw(*self._ask((REVISIT, OPPOSITE), "fused", "fused")),
            by_candidates={
                name: recall1_by_candidates(ranking, evidence, f"{name} both", task.positive)
                for name in ("superfeatures", "ransac")
            },
            milliseconds=evidence.milliseconds,
            descriptors=self._places.descriptors("fused"),
            world_T_body=np.stack(self._poses),
            pass_index=np.array(self._passes),
            examples=self._examples(task, best),
        )

    def compare(self, embedder: Embedder) -> Scores:
        """Score another embedder on the same frames, after `run`."""
        places = PlaceCollection(embedder)
        for frame, number in zip(self._frames, self._passes, strict=True):
            if number in (FIRST, REVISIT):
                places.add(frame)
        found = places.descriptors("fused")
        rows = np.flatnonzero(np.isin(self._passes, (FIRST, REVISIT)))
        task = place_recognition(np.stack(self._poses)[rows], np.array(self._passes)[rows])
        return score(task, rank(found[task.queries] @ found[task.references].T))

    def _remember(self, visit: Visit) -> None:
        modes = {FIRST: ("image", "lidar"), REVISIT: tuple(MODES)}.get(visit.pass_index, ())
        self._places.add(visit.frame, modes)
        self._frames.append(visit.frame)
        self._poses.append(visit.world_T_body)
        self._passes.append(visit.pass_index)

    def _ask(self, passes: int | tuple[int, ...], of_query: str, of_reference: str) -> tuple[Task, Ranking]:
        """Some passes against the first."""
        rows = np.flatnonzero(np.isin(self._passes, [FIRST, *np.atleast_1d(passes)]))
        task = place_recognition(np.stack(self._poses)[rows], np.array(self._passes)[rows])
        task = task.of_rows(rows)
        return task, rank(self._similarity(task, of_query, of_reference))

    def _similarity(self, task: Task, of_query: str, of_reference: str) -> Array:
        queries, references = self._places.descriptors(of_query), self._places.descriptors(of_reference)
        return queries[task.queries] @ references[task.references].T

    def _examples(self, task: Task, ranking: Ranking) -> list[tuple[Frame, Frame]]:
        found = np.flatnonzero(ranking.hits(task.positive)[:, 0])
        chosen = found[np.linspace(0, len(found) - 1, min(SHOWN, len(found))).astype(int)]
        return [
            (self._frames[task.queries[row]], self._frames[task.references[ranking.order[row, 0]]]) for row in chosen
        ]


def work(world: TestWorld) -> int:
    """How often a `WorldEvaluation` of the world reports, nearly."""
    return len(world) + world.revisits
