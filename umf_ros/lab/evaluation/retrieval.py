"""Retrieval tasks: queries, admissible places, ranking and reranking."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Loop, Verification
from umf_ros.core.frames import Candidate, Embedding, Frame, Keyframe, SuperFeatures, combine
from umf_ros.core.geometry import Array
from umf_ros.embedding import Embedder
from umf_ros.lab.datasets.sample import Rule, distances, label, places_of
from umf_ros.places.database import is_past
from umf_ros.places.words import FITTED_ON, fit_words, worth
from umf_ros.verification.rerank import Counter, Counts, count_inliers, mutual_neighbours, rerank, similarities

THESIS_RULE = Rule(positive_m=12.0, positive_deg=30.0, negative_m=60.0, negative_deg=30.0)
ROBOTCAR_RULE = Rule(positive_m=10.0, positive_deg=180.0, negative_m=50.0, negative_deg=180.0)
RULES = {"s3li": THESIS_RULE, "robotcar": ROBOTCAR_RULE}
NEAR_M = 5.0


@dataclass(frozen=True, slots=True)
class RetrievalTask:
    """Queries against references.

    Attributes:
        queries: (Q,) rows of the samples that are queries.
        references: (R,) rows of the samples that are references.
        admissible: (Q, R) references a query may retrieve.
        positive: (Q, R) admissible true matches.
        near: (Q, R) those within 5 m.
        metres: (Q, R) distance.
        turn_deg: (Q, R) difference of heading, 0 to 180; zero where headings are unknown.
    """

    queries: Indices
    references: Indices
    admissible: Mask
    positive: Mask
    near: Mask
    metres: Array
    turn_deg: Array

    @property
    def answerable(self) -> Mask:
        """(Q,) whether a query has a true match."""
        return np.asarray(self.positive.any(axis=1))

    def of_rows(self, rows: Indices) -> RetrievalTask:
        """The same task, its samples being those `rows` of a larger set."""
        return replace(self, queries=rows[self.queries], references=rows[self.references])


def place_recognition(world_T_body: Array, pass_index: Indices, rule: Rule = THESIS_RULE) -> RetrievalTask:
    """Later passes of a place against its first.

    Args:
        world_T_body: (N, 4, 4) true poses.
        pass_index: (N,) which pass a sample belongs to.
        rule: what is a true match.
    """
    first = pass_index == pass_index.min(initial=0)
    queries, references = np.flatnonzero(~first), np.flatnonzero(first)
    everything = np.ones((len(queries), len(references)), bool)
    return _task(world_T_body, queries, references, everything, rule)


def revisits(world_T_body: Array, pass_index: NDArray, rule: Rule = THESIS_RULE) -> RetrievalTask:
    """Each sample of a recording against all earlier passes.

    Args:
        world_T_body: (N, 4, 4) true poses.
        pass_index: (N,) which pass a sample belongs to; two passes differ by one at least.
        rule: what is a true match.
    """
    every = np.arange(len(pass_index))
    return _task(world_T_body, every, every, pass_index[:, None] - pass_index[None] >= 1, rule)


def loop_closure(
    stamps: NDArray[np.int64],
    world_T_body: Array,
    path_length_m: Array,
    gaps: Loop,
    has_orientation: bool = True,
    rule: Rule = THESIS_RULE,
) -> RetrievalTask:
    """Each sample against its own past, as on a rover.

    Args:
        stamps: (N,) ns, ascending.
        world_T_body: (N, 4, 4) true poses.
        path_length_m: (N,) path length, NaN where unknown.
        gaps: how far back in time and along the path a match must lie.
        has_orientation: whether the truth knows headings; without them distance alone decides.
        rule: what is a true match.
    """
    every = np.arange(len(stamps))
    past = is_past(stamps[:, None] - stamps[None], path_length_m[:, None] - path_length_m[None], gaps)
    admissible = (every[None] < every[:, None]) & past
    if not has_orientation:
        flat = np.tile(np.eye(4), (len(stamps), 1, 1))
        flat[:, :3, 3] = world_T_body[:, :3, 3]
        world_T_body = flat
    return _task(world_T_body, every, every, admissible, rule)


def _task(world_T_body: Array, queries: Indices, references: Indices, admissible: Mask, rule: Rule) -> RetrievalTask:
    places = places_of(0, world_T_body[queries]), places_of(0, world_T_body[references])
    metres, turn = distances(*places)
    positive = label(*places, rule)[0] & admissible
    near = positive & (metres < NEAR_M)
    return RetrievalTask(queries, references, admissible, positive, near, metres, np.degrees(turn))


class PairInliers:
    """Counts what the images of a pair share once, whichever method proposes it.

    Args:
        queries: Q keyframes.
        references: R keyframes.
        settings: of the reranker.
    """

    def __init__(self, queries: Sequence[Keyframe], references: Sequence[Keyframe], settings: Verification) -> None:
        self._settings = settings.model_copy(update={"modalities": "image"})
        self._queries, self._references = queries, references
        self._worth = np.full((len(queries), len(references)), np.nan)

    def reorder(self, ranking: Ranking, similarity: Array) -> Ranking:
        """A method's ranking, given its similarities (Q, R), after its 20 best were reranked."""
        heads = ranking.order[:, :TOP_K]
        scores = np.zeros(heads.shape)
        for row, column in np.argwhere(heads != NOTHING):
            reference = heads[row, column]
            scores[row, column] = similarity[row, reference] + self._of(row, reference)
        return ranking.reordered(scores)

    def _of(self, row: int, reference: int) -> float:
        """Share of a pair's inliers that is added to its similarity."""
        if np.isnan(self._worth[row, reference]):
            keyframe = self._references[reference]
            alone = [(Candidate(0, keyframe.stamp_ns, 0.0), keyframe)]
            self._worth[row, reference] = rerank(self._queries[row], alone, self._settings)[0][0].score
        return float(self._worth[row, reference])


Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Descriptors = NDArray[np.float32]

NOTHING = -1
"""Stands in a ranking where there is no further reference."""

TOP_K = 20
"""Candidates that are reranked [UMF 5.5.2]."""

SUPER = ("super_image", "super_cloud")


def eligible_superfeatures(query: SuperFeatures, match: SuperFeatures, ratio: float = 0.9) -> Indices:
    """IDs whose super-features are each other's nearest, and nearer than `ratio` times the second [UMF eq. 4.1]."""
    count = min(len(query.descriptors), len(match.descriptors))
    if count < 2:
        return np.empty(0, np.intp)
    similarity = similarities(query.descriptors, match.descriptors)
    squared = np.maximum(2 - 2 * similarity, 0)
    pairs = mutual_neighbours(-squared)
    ids = pairs[pairs[:, 0] == pairs[:, 1], 0]
    nearest, second = np.partition(squared[ids], 1, axis=1)[:, :2].T
    return ids[nearest <= ratio**2 * second]


def count_superfeatures(query: Keyframe, match: Keyframe, settings: Verification) -> Counts:
    """Count the eligible super-features of images and of scans."""
    pairs = {name: (getattr(query.embedding, name), getattr(match.embedding, name)) for name in SUPER}
    return {name: len(eligible_superfeatures(*pair)) if all(pair) else None for name, pair in pairs.items()}


RERANKERS: dict[str, Counter] = {"superfeatures": count_superfeatures, "ransac": count_inliers}
PARTS = {"image": "image", "lidar": "cloud", "both": "both"}
"""Which local features a reranker uses: what it is called here and in the settings."""

METHODS = {f"{reranker} {part}": (reranker, modalities) for reranker in RERANKERS for part, modalities in PARTS.items()}
"""Name in `RERANKERS` and setting `modalities` of every way to rerank."""

NO_POINTS = np.empty((0, 3), np.float32)

MODES: dict[str, Callable[[Frame], Frame]] = {
    "fused": lambda frame: frame,
    "image": lambda frame: replace(frame, points=None, intensity=None),
    "lidar": lambda frame: replace(frame, left=None, right=None),
    "image black": lambda frame: replace(frame, left=np.zeros_like(frame.left), right=None),
    "cloud empty": lambda frame: replace(frame, points=NO_POINTS, intensity=np.empty(0, np.float32)),
}
"""A frame without the sensors that are not used or failed."""


class PlaceCollection:
    """Descriptors of frames in several modes, and the keyframes of the whole frames for reranking."""

    def __init__(self, embedder: Embedder) -> None:
        self._embedder = embedder
        self._descriptors: dict[str, list[Descriptors]] = {mode: [] for mode in MODES}
        self.keyframes: list[Keyframe] = []

    def add(self, frame: Frame, modes: Collection[str] = ("fused",)) -> None:
        """Embed a frame whole ("fused") and in further modes; in the others it holds NaN."""
        for mode, change in MODES.items():
            row = np.full(self._embedder.dimension, np.nan, np.float32)
            if mode == "fused" or mode in modes:
                embedding = self._embedder.embed(change(frame))
                row = embedding.descriptor
                if mode == "fused":
                    self.keyframes.append(as_keyframe(frame, embedding))
            self._descriptors[mode].append(row)

    def descriptors(self, mode: str) -> Descriptors:
        """(N, D), NaN for the frames that were not embedded in this mode."""
        return np.stack(self._descriptors[mode])


def as_keyframe(frame: Frame, embedding: Embedding) -> Keyframe:
    """A keyframe that can be retrieved and reranked; it keeps no points for registration."""
    return Keyframe(
        stamp_ns=frame.stamp_ns,
        embedding=embedding,
        camera=frame.camera,
        body_T_camera=frame.body_T_camera,
        points=NO_POINTS,
        odom_T_body=frame.odom_T_body,
        session=frame.session,
    )


@dataclass(frozen=True, slots=True)
class Ranking:
    """References that each query retrieved.

    Attributes:
        order: (Q, N) references, best first, `NOTHING` where a query has no more.
        score: (Q,) how sure the best match is, -inf where there is none.
        admissible: (Q,) how many references each query could retrieve.
    """

    order: Indices
    score: Array
    admissible: Indices

    def hits(self, positive: Mask) -> Mask:
        """(Q, N) whether each retrieved reference is a true match, given (Q, R) `positive`."""
        found = np.take_along_axis(positive, np.maximum(self.order, 0), axis=1)
        return found & (self.order != NOTHING)

    def reordered(self, scores: Array) -> Ranking:
        """The ranking with its first K references ordered by other scores (Q, K); equals keep their order."""
        wanted = scores.shape[1]
        head = self.order[:, :wanted]
        scores = np.where(head == NOTHING, -np.inf, scores)
        better = np.argsort(-scores, axis=1, kind="stable")
        order = np.concatenate([np.take_along_axis(head, better, 1), self.order[:, wanted:]], axis=1)
        return Ranking(order, scores.max(axis=1, initial=-np.inf), self.admissible)


def rank(similarity: Array, admissible: Mask | None = None) -> Ranking:
    """Order all references for every query; equals by index.

    Args:
        similarity: (Q, R), larger is more alike.
        admissible: (Q, R) references a query may retrieve; None: all.
    """
    allowed = np.ones(similarity.shape, bool) if admissible is None else admissible
    masked = np.where(allowed, similarity, -np.inf)
    order = np.argsort(-masked, axis=1, kind="stable")
    count = allowed.sum(axis=1)
    order[np.arange(similarity.shape[1])[None] >= count[:, None]] = NOTHING
    return Ranking(order, masked.max(axis=1, initial=-np.inf), count)


@dataclass(frozen=True, slots=True)
class Reranking:
    """A ranking after reranking by local features.

    Attributes:
        before: the ranking by descriptors alone.
        scores: (Q, K) of its first candidates, by method.
        milliseconds: median per query of each reranker with both modalities.
    """

    before: Ranking
    scores: dict[str, Array]
    milliseconds: dict[str, float] = field(default_factory=dict)

    def after(self, method: str, candidates: int = TOP_K) -> Ranking:
        """The ranking after reranking the first `candidates`."""
        return self.before.reordered(self.scores[method][:, :candidates])


def word_similarity(queries: Sequence[Keyframe], references: Sequence[Keyframe]) -> Array:
    """(Q, R) similarity by words of the first references, as in a place database; 0 where there are none or too few."""
    found = np.zeros((len(queries), len(references)))
    scenes = [one.embedding.scene for one in references]
    if len(known := [scene for scene in scenes if scene is not None]) < FITTED_ON:
        return found
    words = fit_words(known[:FITTED_ON])
    ours, theirs = (
        {row: code for row, scene in enumerate(each) if (code := words.describe(scene)) is not None}
        for each in ([one.embedding.scene for one in queries], scenes)
    )
    codes = np.stack(list(theirs.values()))
    for row, code in ours.items():
        found[row, list(theirs)] = words.compare(code, codes)
    return found


def with_words(similarity: Array, words: Array, queries: Sequence[Keyframe]) -> Array:
    """(Q, R) both similarities for queries of one sensor, the network's for the others: those of a place database."""
    combined: Array = combine(similarity, words * np.array([[worth(one.embedding)] for one in queries]))
    return combined


def rerank_all(
    queries: Sequence[Keyframe],
    references: Sequence[Keyframe],
    ranking: Ranking,
    similarity: Array,
    settings: Verification,
    report: Callable[[], None] = lambda: None,
) -> Reranking:
    """Rerank the candidates of every query with the verifier's reranker, in each of the `METHODS`.

    Args:
        queries: Q keyframes.
        references: R keyframes.
        ranking: of the references for every query.
        similarity: (Q, R) of the global descriptors, with the words where they count.
        settings: of the reranker.
        report: called after every query.
    """
    heads = ranking.order[:, :TOP_K]
    chosen = {name: (settings.model_copy(update={"modalities": m}), RERANKERS[r]) for name, (r, m) in METHODS.items()}
    scores: dict[str, Array] = {method: np.zeros(heads.shape) for method in METHODS}
    took: dict[str, list[float]] = {method: [] for method in METHODS}
    for row, (query, head) in enumerate(zip(queries, heads, strict=True)):
        candidates = [
            (Candidate(column, references[index].stamp_ns, float(similarity[row, index])), references[index])
            for column, index in enumerate(head)
            if index != NOTHING
        ]
        for method, way in chosen.items():
            started = time.perf_counter()
            ranked = rerank(query, candidates, *way)
            took[method].append(1e3 * (time.perf_counter() - started))
            for candidate, _ in ranked:
                scores[method][row, candidate.index] = candidate.score
        report()
    timed = {reranker: took.get(f"{reranker} both", []) for reranker in RERANKERS}
    medians = {reranker: float(np.median(each)) for reranker, each in timed.items() if each}
    return Reranking(ranking, scores, medians)
