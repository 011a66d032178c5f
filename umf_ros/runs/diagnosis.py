"""Explain why a keyframe closed no loop."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from math import inf
from typing import Literal

import numpy as np
from scipy.special import logit

from umf_ros.runs.truth import JudgedRun
from umf_ros.verification.acceptance import load_acceptance
from umf_ros.verification.hypothesis import Hypothesis, RejectReason

Gate = Literal["found", "gap rules", "retrieval", "selection", "depth", "pose", "probability", "objection"]
_LIMITS = {
    RejectReason.TURNED: "verification.max_turn_deg: a wider limit",
    RejectReason.TOO_FAR: "verification.max_shift_m: a wider limit",
}
_acceptance = cache(load_acceptance)


@dataclass(frozen=True, slots=True)
class ClosureDiagnosis:
    """Outcome of one keyframe's search.

    Attributes:
        stamp_ns: the keyframe.
        gate: the stage that rejected it.
        what: the reason in a sentence, with its margin.
        parameter: parameter that would accept it, and the cost of that; empty without one.
        match_stamp_ns: the matched place: the right one, if the truth covers it and it was returned, else the
            most promising; None if none was returned.
        distance_m: true distance of both, infinite where it is unknown.
        contributions: log-odds of each criterion, where a pose was judged; "bias" is the constant term.
    """

    stamp_ns: int
    gate: Gate
    what: str
    parameter: str = ""
    match_stamp_ns: int | None = None
    distance_m: float = inf
    contributions: dict[str, float] = field(default_factory=dict)


def explain(about: JudgedRun, row: int) -> ClosureDiagnosis:
    """Return the diagnosis of the keyframe in this row, also of one with a closure."""
    stamp = int(about.run.stamps[row])
    allowed, tested = np.flatnonzero(about.admissible(row)), about.tested[stamp]
    if not len(allowed) and not tested:
        return _gaps(about, row, stamp)
    right = about.same_places(row)
    rightly = [one for one in tested if about.is_same_place(*one.endpoints)] if len(right) else []
    if (len(right) and not rightly) or not tested:
        return _retrieval(about, row, allowed, right)
    best = max(rightly or tested, key=lambda one: (one.accepted, one.probability or 0, one.candidate.similarity))
    distance_m = about.distance(*best.endpoints)
    return ClosureDiagnosis(stamp, *_decision(about, best), best.match_stamp_ns, distance_m, contributions(about, best))


def contributions(about: JudgedRun, candidate: Hypothesis) -> dict[str, float]:
    """Return log-odds of each criterion, where a pose was judged by the fitted decision."""
    if not candidate.kind:
        return {}
    acceptance = _acceptance(about.run.settings.verification.calibration)
    return {name: value for name, value in acceptance.contributions(candidate.measurements).items() if value}


def missing(about: JudgedRun, candidate: Hypothesis) -> dict[str, float]:
    """Return log-odds that each criterion could have added and did not, the most first."""
    if not candidate.kind:
        return {}
    lost = _acceptance(about.run.settings.verification.calibration).lost(candidate.measurements)
    return dict(sorted(lost.items(), key=lambda one: -one[1]))


def most_probable(about: JudgedRun, stamp_ns: int) -> Hypothesis | None:
    """Return the candidate of a keyframe that only its probability keeps from being a closure, if there is one."""
    tested = [one for one in about.tested[stamp_ns] if one.reason in (None, RejectReason.IMPROBABLE)]
    return max(tested, key=lambda one: one.probability or 0, default=None)


def _at_threshold(about: JudgedRun, threshold: float) -> tuple[int, int]:
    """Return the numbers of closures published from this probability on, and of those between different places."""
    best = filter(None, (most_probable(about, stamp) for stamp in about.tested))
    published = [one for one in best if (one.probability or 0) >= threshold]
    return len(published), sum(about.is_same_place(*one.endpoints) is False for one in published)


def _gaps(about: JudgedRun, row: int, stamp: int) -> ClosureDiagnosis:
    rules = about.run.settings.loop
    what = (
        f"the gap rules allow no match: none of {row} earlier keyframes is {rules.min_time_gap_s:g} s older and "
        f"{rules.min_travel_m:g} m back; the first is {(stamp - int(about.run.stamps[0])) * 1e-9:.1f} s older"
    )
    parameter = "loop.min_time_gap_s and loop.min_travel_m: smaller ones match a place with recent keyframes"
    return ClosureDiagnosis(stamp, "gap rules", what, parameter)


def _retrieval(about: JudgedRun, row: int, allowed: np.ndarray, right: np.ndarray) -> ClosureDiagnosis:
    stamp, rules = int(about.run.stamps[row]), about.run.settings.loop
    what = f"the database returned {len(about.tested[stamp])} candidates"
    if not len(right):
        return ClosureDiagnosis(stamp, "retrieval", what)
    rank, similarity, match = _best_rank(about.run.descriptors, row, allowed, right)
    distance = float(about.distances(row)[match])
    what += f", none of them the place {distance:.1f} m away"
    what += f", which has rank {rank} of {len(allowed)} by its similarity of {similarity:.2f}"
    parameter = f"loop.top_k: {rank} (now {rules.top_k}); each candidate is reranked once more"
    if similarity < rules.min_similarity:
        parameter = f"loop.min_similarity: {similarity:.2f} (now {rules.min_similarity:g})"
    return ClosureDiagnosis(stamp, "retrieval", what, parameter, int(about.run.stamps[match]), distance)


def _best_rank(descriptors: np.ndarray, row: int, allowed: np.ndarray, right: np.ndarray) -> tuple[int, float, int]:
    """Return the rank, similarity and row of the most similar right place."""
    similarities = descriptors @ descriptors[row]
    best = int(right[similarities[right].argmax()])
    return int((similarities[allowed] > similarities[best]).sum()) + 1, float(similarities[best]), best


def _decision(about: JudgedRun, best: Hypothesis) -> tuple[Gate, str, str]:
    """Return the gate, sentence and parameter of a candidate that was tested."""
    match best.reason:
        case None:
            return "found", f"a loop closure was published, probability {best.probability or 0:.3f}", ""
        case RejectReason.NOT_SELECTED:
            others = about.tested[best.query_stamp_ns]
            tested = sum(one.reason is not RejectReason.NOT_SELECTED for one in others)
            similarity, now = best.candidate.similarity, about.run.settings.verification.refine_best
            what = f"it was returned (similarity {similarity:.2f}) but {tested} others were more promising"
            return "selection", what, f"verification.refine_best: more than {now}; time grows with it"
        case RejectReason.NO_DEPTH:
            return "depth", best.outcome, "topics.cloud or topics.right_image"
        case RejectReason.NO_POSE:
            return "pose", f"{best.outcome} ({best.measurements.get('inliers_image', 0):.0f} image inliers)", ""
        case RejectReason.IMPROBABLE:
            return "probability", *_probability(about, best)
    return "objection", best.outcome, _LIMITS.get(best.reason, "")


def _probability(about: JudgedRun, best: Hypothesis) -> tuple[str, str]:
    """Return the sentence and parameter of a candidate that was too improbable."""
    least, probability = about.run.settings.verification.min_probability, best.probability or 0.0
    short = float(np.diff(logit(np.clip([probability, least], 1e-9, 1 - 1e-9)))[0])
    lacking = [f"{name.replace('_', ' ')} {lost:.1f}" for name, lost in list(missing(about, best).items())[:3]]
    what = f"{best.outcome}, {short:.1f} short in log-odds" + (f"; lost by {', '.join(lacking)}" if lacking else "")
    now, (then, wrong) = _at_threshold(about, least)[0], _at_threshold(about, probability)
    cost = f", {wrong} of all {then} between different places" if about.covered[0] else ", unjudged"
    return what, f"verification.min_probability: {probability:.3f} adds {then - now} closures{cost}"
