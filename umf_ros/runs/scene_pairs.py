"""The pairs of keyframes that a reader of the report can click."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, relative, rotation_angle
from umf_ros.pose_graph.closures import State
from umf_ros.runs.findings import PENDING, ExaminedRun
from umf_ros.runs.tables import Endpoints, TestedCandidate
from umf_ros.runs.truth import JudgedClosure
from umf_ros.runs.why import ClosureDiagnosis

Kind = Literal["accepted", "pending", "rejected", "false", "missed", "tested"]
ORDER: tuple[Kind, ...] = ("false", "missed", "rejected", "pending", "tested", "accepted")
"""Of whose pictures come first where not all find room."""
MOST = {"missed": 60, "tested": 20, "accepted": 400}
"""Pairs of a kind that are explained in full."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two keyframes, and what became of them.

    Attributes:
        kind: how it is drawn.
        number: of the closure, from 1; 0 for what is none.
        pose: (4, 4) `match_T_query`, or None where no source knows it.
        pose_source: who says so.
        closure, judged, candidate, why: what is known.
    """

    kind: Kind
    endpoints: Endpoints
    number: int
    pose: Array | None
    pose_source: str
    closure: LoopClosure | None = None
    judged: JudgedClosure | None = None
    candidate: TestedCandidate | None = None
    why: ClosureDiagnosis | None = None


def pairs_of(about: ExaminedRun) -> list[Pair]:
    """Every closure, the missed revisits, and the most promising of what was rejected before it became one."""
    run, judged = about.run, about.judged.by_endpoints()
    tested = {one.endpoints: one for one in run.candidates}
    pairs = []
    for number, closure in enumerate(run.closures, 1):
        key = closure.query_stamp_ns, closure.match_stamp_ns
        kind = _kind(about, key, judged.get(key))
        found = tested.get(key)
        pairs.append(Pair(kind, key, number, closure.match_T_query, "the closure", closure, judged.get(key), found))
    pairs += _missed(about, tested)
    return pairs + _nearly(about, {pair.endpoints for pair in pairs}, {one.query_stamp_ns for one in run.closures})


def by_need(pairs: Sequence[Pair]) -> list[Pair]:
    """The pairs whose details are worth their room, the most telling first, spread over the run."""
    chosen: list[Pair] = []
    for kind in ORDER:
        mine = [pair for pair in pairs if pair.kind == kind]
        most = MOST.get(kind, len(mine))
        chosen += [mine[i] for i in _spread(len(mine), most)]
    return chosen


def _spread(count: int, most: int) -> Iterable[int]:
    """Up to `most` of `count`, coarse before fine, so that whoever stops early has seen the whole run."""
    kept = np.linspace(0, count - 1, min(count, most)).astype(int).tolist() if count else []
    strides = [1 << power for power in range(len(kept).bit_length(), -1, -1)]
    return list(dict.fromkeys(kept[i] for stride in strides for i in range(0, len(kept), stride)))


def _kind(about: ExaminedRun, key: Endpoints, judged: JudgedClosure | None) -> Kind:
    if judged is not None and not judged.is_true:
        return "false"
    verdict = about.run.verdicts.get(key)
    if verdict is None or verdict.state == State.ACCEPTED:
        return "accepted"
    return "pending" if verdict.state in PENDING else "rejected"


def _missed(about: ExaminedRun, tested: dict[Endpoints, TestedCandidate]) -> list[Pair]:
    pairs = []
    for why in about.missed():
        if why.match_stamp_ns is None:
            continue
        key = why.stamp_ns, why.match_stamp_ns
        pose, source = _pose(about, key)
        pairs.append(Pair("missed", key, 0, pose, source, candidate=tested.get(key), why=why))
    return pairs


def _nearly(about: ExaminedRun, shown: set[Endpoints], found: set[int]) -> list[Pair]:
    """The most probable candidates of keyframes without a closure."""
    best: dict[int, TestedCandidate] = {}
    for one in about.run.candidates:
        if one.query_stamp_ns in found or one.endpoints in shown or one.probability is None:
            continue
        known = best.get(one.query_stamp_ns)
        if known is None or one.probability > (known.probability or 0):
            best[one.query_stamp_ns] = one
    chosen = sorted(best.values(), key=lambda one: -(one.probability or 0))[: MOST["tested"]]
    pairs = []
    for one in chosen:
        row = about.places.row(one.query_stamp_ns)
        pose, source = _pose(about, one.endpoints)
        why = about.gates.explain(row) if row is not None else None
        pairs.append(Pair("tested", one.endpoints, 0, pose, source, candidate=one, why=why))
    return pairs


def _pose(about: ExaminedRun, key: Endpoints) -> tuple[Array | None, str]:
    """Where the two stood by the truth, else by the optimised trajectory: the run keeps no pose of what it rejected."""
    run = about.run
    with_turns = run.truth if run.truth is not None and run.truth.has_orientation else None
    for source, trajectory in (("the truth", with_turns), ("the optimised trajectory", run.optimized)):
        if trajectory is None:
            continue
        poses, known = trajectory.at(np.array(key, np.int64))
        if known.all():
            return relative(poses[1], poses[0]), source
    return None, "no one"


def describe(about: ExaminedRun, pair: Pair, full: bool) -> dict[str, Any]:
    """What the page gets of a pair; the bars and the pose only in full."""
    rows = [about.places.row(stamp) for stamp in pair.endpoints]
    told: dict[str, Any] = {"kind": pair.kind, "number": pair.number, "q": rows[0], "m": rows[1]}
    told["stamps"] = [str(stamp) for stamp in pair.endpoints]  # no number of a browser holds nanoseconds
    told["p"] = _finite(_probability(pair))
    told["s"] = _finite(pair.candidate.similarity if pair.candidate else None)
    told["graph"] = _graph_words(about, pair)
    told["truth"] = _truth_words(pair)
    if pair.why is not None:
        told["why"], told["parameter"] = pair.why.what, pair.why.parameter
    if not full:
        return told
    if pair.candidate is not None:
        given, missing = about.gates.contributions(pair.candidate), about.gates.missing(pair.candidate)
        names = sorted({*given, *missing} - {"bias"}, key=lambda name: -(given.get(name, 0) + missing.get(name, 0)))
        told["bars"] = [[name, round(given.get(name, 0), 2), round(missing.get(name, 0), 2)] for name in names]
        told["bias"] = round(given.get("bias", 0), 2)
    if pair.pose is not None:
        told["pose"] = [round(float(value), 4) for value in pair.pose[:3].ravel()]
        told["pose_source"] = pair.pose_source
        told["shift_m"] = round(float(np.linalg.norm(pair.pose[:3, 3])), 2)
        told["turn_deg"] = round(float(np.degrees(rotation_angle(pair.pose))), 1)
    return told


def _probability(pair: Pair) -> float | None:
    if pair.closure is not None:
        return pair.closure.probability
    return None if pair.candidate is None else pair.candidate.probability


def _graph_words(about: ExaminedRun, pair: Pair) -> str:
    verdict = about.run.verdicts.get(pair.endpoints)
    if verdict is None:
        return ""
    figures = f" ({verdict.sigma:.1f} sigma, {verdict.misfit_m:.2f} m)" if np.isfinite(verdict.sigma) else ""
    return f"{verdict.state}: {verdict.reason}{figures}"


def _truth_words(pair: Pair) -> str:
    judged = pair.judged
    if judged is None:
        return "" if pair.why is None or not np.isfinite(pair.why.distance_m) else f"{pair.why.distance_m:.1f} m apart"
    turned = f", {judged.rotation_error_deg:.2f} deg" if np.isfinite(judged.rotation_error_deg) else ""
    return f"{'true' if judged.is_true else 'FALSE'}: {judged.translation_error_m:.2f} m{turned} off"


def _finite(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), 4)
