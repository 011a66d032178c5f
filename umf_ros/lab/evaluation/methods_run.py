"""Compare all methods on worlds, sequences or recordings."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from umf_ros.baselines.place_network import count_parameters
from umf_ros.core.config import EmbeddingSettings, Verification
from umf_ros.core.errors import ConfigError, UmfError
from umf_ros.core.frames import Frame, Keyframe, LocalFeatures, SuperFeatures
from umf_ros.embedding import DEFAULT, Embedder, find_methods, make_embedder
from umf_ros.lab.evaluation.methods import (
    MethodAnswers,
    MethodCost,
    MethodResult,
    ask,
    costs_table,
    methods_table,
    plot_methods,
    sets_table,
)
from umf_ros.lab.evaluation.results import EvaluationReport, TextTable, percent
from umf_ros.lab.evaluation.retrieval import (
    METHODS,
    PairInliers,
    PlaceCollection,
    Ranking,
    RetrievalTask,
    rank,
    rerank_all,
    with_words,
    word_similarity,
)
from umf_ros.lab.evaluation.summary import ETNA_RECALL1, measure
from umf_ros.networks.config import locate_weights
from umf_ros.networks.weights import load_weights
from umf_ros.places.database import PlaceIndex

RERANKED = {"umf_superfeatures": "superfeatures both", "umf_ransac": "ransac both"}
"""UMF's rerankers that stand beside the other methods."""
VLAD = "anyloc_vlad"
"""VLAD on the trunk of UMF with words of the first 40 references [AnyLoc 2023], as a place database has them."""
PLACES = 858
"""In the database when matching is timed, as in [UMF table 5.9]."""
TIMED_FRAMES = 6
CURVES = ("umf_ransac", "umf_superfeatures", "umf", "adafusion", "minkloc_fusion", "netvlad")


@dataclass(frozen=True)
class FrameSet:
    """Frames and what is asked of them.

    Attributes:
        name: of the set.
        frames: in order; read once.
        task: who is compared with whom, known once the frames were read.
        unanswerable_count: whether queries without a true match can be wrong.
    """

    name: str
    frames: Iterable[Frame]
    task: Callable[[], RetrievalTask]
    unanswerable_count: bool = False


def make_others(trained: Path | None) -> tuple[dict[str, Embedder], list[str]]:
    """All methods but UMF, and a line for each that cannot be had.

    Args:
        trained: folder of weights, NAME.safetensors or NAME/NAME.safetensors; None: the shipped ones.
    """
    found: dict[str, Embedder] = {}
    missing = []
    for name in find_methods():
        if name == DEFAULT:
            continue
        weights = next((path for path in _places(trained, name) if path.is_file()), None)
        try:
            found[name] = make_embedder(EmbeddingSettings(method=name, weights=str(weights or "")))
        except ConfigError as error:
            missing.append(str(error))
    return found, missing


def _places(trained: Path | None, name: str) -> list[Path]:
    if trained is None:
        return []
    return [trained / f"{name}.safetensors", trained / name / f"{name}.safetensors"]


class MethodsRun:
    """Embeds every frame by every method, asks, reranks and takes times.

    Args:
        weights: of UMF; None: the default.
        others: embedders by name.
        report: called with the name of what is worked on, and 1 for every frame done.
    """

    def __init__(
        self,
        weights: Path | None,
        others: Mapping[str, Embedder],
        report: Callable[[str, int], None] = lambda what, done: None,
    ) -> None:
        self._weights, self._others, self._report = locate_weights(weights), others, report
        self._settings = Verification()
        self._wanted = EmbeddingSettings(weights=str(self._weights))
        self._umf = make_embedder(self._wanted, super_features=True, features=self._settings.features)
        self._answers: dict[str, dict[str, MethodAnswers]] = {}
        self._xfeat: dict[str, list[float]] = {}
        self._reranked: dict[str, list[MethodAnswers]] = {name: [] for name in METHODS}
        self._rerank_ms: dict[str, list[float]] = {}
        self._seen: list[Frame] = []
        self._keyframe: Keyframe | None = None

    def add(self, places: FrameSet) -> bool:
        """Ask one set; returns whether any of its queries has a true match, without which nothing can be said.

        Raises:
            UmfError: what its frames raise.
        """
        ours = PlaceCollection(self._umf)
        theirs: dict[str, list[np.ndarray]] = {name: [] for name in self._others}
        for frame in places.frames:
            ours.add(frame)
            for name, embedder in self._others.items():
                theirs[name].append(embedder.embed(frame).descriptor)
            if len(self._seen) < TIMED_FRAMES:
                self._seen.append(frame)
            self._report(places.name, 1)
        task = places.task()
        if not task.positive.any():
            return False
        self._keyframe = ours.keyframes[0]
        queries, references = ([ours.keyframes[row] for row in rows] for rows in (task.queries, task.references))
        inliers = PairInliers(queries, references, self._settings)
        described = {DEFAULT: ours.descriptors("fused")} | {name: np.stack(rows) for name, rows in theirs.items()}
        similarities = {name: found[task.queries] @ found[task.references].T for name, found in described.items()}
        similarities[VLAD] = word_similarity(queries, references)
        similarities[DEFAULT] = with_words(similarities[DEFAULT], similarities[VLAD], queries)
        for name, similarity in similarities.items():
            ranking = rank(similarity, task.admissible)
            self._keep(name, places.name, ask(task, ranking, places.unanswerable_count))
            if name == DEFAULT:
                self._rerank(places, task, ranking, similarity, queries, references)
            else:
                again = inliers.reorder(ranking, similarity)
                self._xfeat.setdefault(name, []).append(ask(task, again).scores.recall1)
            self._report(f"{places.name}: {name}", 0)
        return True

    def _rerank(
        self,
        places: FrameSet,
        task: RetrievalTask,
        ranking: Ranking,
        similarity: np.ndarray,
        queries: list[Keyframe],
        references: list[Keyframe],
    ) -> None:
        again = rerank_all(queries, references, ranking, similarity, self._settings)
        for method, found in self._reranked.items():
            found.append(ask(task, again.after(method), places.unanswerable_count))
        for name, method in RERANKED.items():
            self._keep(name, places.name, self._reranked[method][-1])
            if method.split()[0] in again.milliseconds:
                self._rerank_ms.setdefault(name, []).append(again.milliseconds[method.split()[0]])

    def _keep(self, name: str, place: str, answers: MethodAnswers) -> None:
        self._answers.setdefault(name, {})[place] = answers

    def results(self, repeats: int) -> list[MethodResult]:
        """Results and costs, measured now, in the thesis's order."""
        self._report("taking times", 0)
        costs = self._costs(repeats)
        found = [
            MethodResult(name, sets, costs.get(name), self._xfeat.get(name, ())) for name, sets in self._answers.items()
        ]
        return sorted(found, key=lambda one: one.of("recall1"))

    def _costs(self, repeats: int) -> dict[str, MethodCost]:
        costs = {}
        for name, embedder in self._others.items():
            parameters = int(getattr(embedder, "parameters", 0))
            costs[name] = self._cost(embedder, parameters, repeats)
        parameters = count_parameters(load_weights(self._weights))
        plain = make_embedder(self._wanted)
        costs[DEFAULT] = self._cost(plain, parameters, repeats)
        for name in RERANKED:
            of_supers = name == "umf_superfeatures"
            features = "umf" if of_supers else self._settings.features
            cost = self._cost(make_embedder(self._wanted, of_supers, features), parameters, repeats)
            again = float(np.median(self._rerank_ms.get(name, [0.0])))
            kept = cost.bytes + self._local_bytes(of_supers)
            costs[name] = MethodCost(parameters, cost.extract_ms, cost.match_ms + again, kept)
        return costs

    def _cost(self, embedder: Embedder, parameters: int, repeats: int) -> MethodCost:
        took = measure(embedder, self._seen, repeats)
        return MethodCost(parameters, took, search_ms(embedder.dimension), 4 * embedder.dimension)

    def _local_bytes(self, of_supers: bool) -> int:
        assert self._keyframe is not None
        embedding = self._keyframe.embedding
        parts = (embedding.super_image, embedding.super_cloud) if of_supers else (embedding.image, embedding.cloud)
        return sum(size_of(part) for part in parts if part is not None)

    def report(self, notes: list[str], repeats: int) -> EvaluationReport:
        """Tables, figures and pictures, with the times taken now."""
        results = self.results(repeats)
        by_name = {found.name: found for found in results}
        tables = {
            "Place recognition by all methods (as UMF table 5.4)": methods_table(results),
            "Recall@1 by set": sets_table(results),
            "UMF's rerankers (as UMF tables 5.7 and 5.8)": self._rerankers(by_name[DEFAULT]),
            "Cost (as UMF table 5.9)": costs_table(results),
        }
        figures = {name: value for found in results for name, value in found.figures().items()}
        shown = {name: [one.scores for one in by_name[name].sets.values()] for name in CURVES if name in by_name}
        drawn = {"methods.png": partial(plot_methods, results=results)}
        return EvaluationReport(TITLE, notes, figures, tables, shown, drawn)

    def _rerankers(self, plain: MethodResult) -> TextTable:
        rows = {"fused": list(plain.sets.values())} | self._reranked
        head = ["reranked by", "R@1", "R@5", "top 1 %", "UMF, Etna R@1"]
        names = ("recall1", "recall5", "recall_top_percent")
        found = []
        for name, each in rows.items():
            shares = [percent(float(np.mean([getattr(one.scores, figure) for one in each]))) for figure in names]
            found.append([name, *shares, f"{ETNA_RECALL1[name]:.1f}"])
        return head, found


def search_ms(dimension: int, repeats: int = 30) -> float:
    """Median milliseconds to find the best of 858 places by descriptors of so many numbers."""
    places = np.random.default_rng(0).standard_normal((PLACES, dimension)).astype(np.float32)
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    index = PlaceIndex(dimension)
    index.add(places)
    everywhere = np.ones(PLACES, bool)
    took = []
    for _ in range(repeats):
        started = time.perf_counter()
        index.search(places[0], 20, everywhere.__getitem__)
        took.append(time.perf_counter() - started)
    return 1e3 * float(np.median(took))


def size_of(features: LocalFeatures | SuperFeatures) -> int:
    """Bytes of their arrays."""
    names = ("positions", "descriptors", "saliency", "points", "strength")
    return sum(getattr(features, name).nbytes for name in names if hasattr(features, name))


TITLE = "All methods"


def compare_methods(
    sets: Iterable[FrameSet],
    notes: list[str],
    weights: Path | None,
    trained: Path | None,
    repeats: int,
    report: Callable[[str, int], None],
) -> EvaluationReport:
    """Ask all sets by all methods.

    Args:
        sets: what is asked.
        notes: of the sets, for the report.
        weights: of UMF; None: the default.
        trained: folder with the weights of other methods; None: the shipped ones.
        repeats: how often each frame is embedded when time is taken.
        report: called with the name of what is worked on, and 1 for every frame done.

    Raises:
        UmfError: a set or the weights cannot be read, or no place is seen twice.
    """
    others, missing = make_others(trained)
    run = MethodsRun(weights, others, report)
    asked = {places.name: run.add(places) for places in sets}
    if not any(asked.values()):
        raise UmfError(f"no place is seen twice in {', '.join(asked)}, so that nothing can be asked")
    said = [
        "Intervals: queries drawn anew within each set, 1000 times. Matching: the best of 858 places, then 20 of them "
        "again by local features where a reranker is named. R@1 + XFeat: UMF's default features of images rerank the "
        "method's own 20 best. Times are medians on this machine, as busy as it was."
    ]
    said += [f"Not asked: {name}, where no place is seen twice in one direction." for name in asked if not asked[name]]
    said += [f"Not compared: {line}." for line in missing]
    return run.report([*notes, *said], repeats)
