"""Which references a query is compared with, and which of them are true matches [UMF 5.1.2, 5.2]."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Loop
from umf_ros.core.geometry import Array
from umf_ros.core.keyframes import is_past
from umf_ros.lab.datasets.labels import Rule, distances, label, places_of
from umf_ros.lab.evaluation.retrieval import Indices, Mask

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
