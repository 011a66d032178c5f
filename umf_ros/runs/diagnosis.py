"""Explain why a keyframe closed no loop."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from math import log
from typing import Literal

import numpy as np

from umf_ros.runs.reader import FinishedRun
from umf_ros.runs.truth import TruePlaces
from umf_ros.verification.acceptance import load_acceptance
from umf_ros.verification.hypothesis import Hypothesis, RejectReason

Gate = Literal["found", "gap rules", "retrieval", "selection", "depth", "pose", "probability", "objection"]
_LIMITS = {
    RejectReason.TURNED: "verification.max_turn_deg: a wider limit",
    RejectReason.TOO_FAR: "verification.max_shift_m: a wider limit",
}


@dataclass(frozen=True, slots=True)
class ClosureDiagnosis:
    """Outcome of one keyframe's search.

    Attributes:
        stamp_ns: the keyframe.
        match_stamp_ns: the place it is about: the right one, where the truth knows it and it was returned, else the
            most promising; None where nothing was returned.
        distance_m: of the two in truth, infinite where it is unknown.
        gate: what stopped it.
        what: that in a sentence, with by how much.
        parameter: what would let it through, and what that costs; empty where no parameter would.
        contributions: log-odds that each criterion adds, where a pose was judged; "bias" is what has to be overcome.
    """

    stamp_ns: int
    match_stamp_ns: int | None
    distance_m: float
    gate: Gate
    what: str
    parameter: str
    contributions: dict[str, float]


class GateDiagnosis:
    """Says of each keyframe of a run why it did not close a loop."""

    def __init__(self, run: FinishedRun, places: TruePlaces) -> None:
        self._run = run
        self._places = places
        self._acceptance = load_acceptance(run.settings.verification.calibration)
        self._tested: dict[int, list[Hypothesis]] = defaultdict(list)
        for candidate in run.candidates:
            self._tested[candidate.query_stamp_ns].append(candidate)

    def tested(self, stamp_ns: int) -> list[Hypothesis]:
        """The candidates of a keyframe, in the order of the reranking."""
        return self._tested[stamp_ns]

    def explain(self, row: int) -> ClosureDiagnosis:
        """Why the keyframe at this place among all found nothing, or that it did."""
        stamp = int(self._places.stamps[row])
        allowed = np.flatnonzero(self._places.admissible(row))
        if not len(allowed) and not self._tested[stamp]:
            return self._gaps(row, stamp)
        right = self._places.same_places(row)
        tested = self._tested[stamp]
        rightly = [one for one in tested if self._places.is_same_place(stamp, one.match_stamp_ns)] if len(right) else []
        if (len(right) and not rightly) or not tested:
            return self._retrieval(row, stamp, allowed, right)
        best = max(rightly or tested, key=lambda one: (one.accepted, one.probability or 0, one.candidate.similarity))
        return self._decision(stamp, best)

    def contributions(self, candidate: Hypothesis) -> dict[str, float]:
        """Log-odds of each criterion, where a pose was judged by the fitted decision."""
        if not candidate.kind:
            return {}
        return {name: value for name, value in self._acceptance.contributions(candidate.measurements).items() if value}

    def missing(self, candidate: Hypothesis) -> dict[str, float]:
        """Log-odds that each criterion could have added and did not, the most first."""
        if not candidate.kind:
            return {}
        return dict(sorted(self._acceptance.lost(candidate.measurements).items(), key=lambda one: -one[1]))

    def at_threshold(self, threshold: float) -> tuple[int, int]:
        """Closures that would be published from this probability on, and how many of them join no same place."""
        count, wrong = 0, 0
        for stamp in self._tested:
            best = self.most_probable(stamp)
            if best is not None and (best.probability or 0) >= threshold:
                count += 1
                wrong += self._places.is_same_place(best.query_stamp_ns, best.match_stamp_ns) is False
        return count, wrong

    def most_probable(self, stamp_ns: int) -> Hypothesis | None:
        """The candidate of a keyframe that nothing but its probability keeps from being a closure, if it does."""
        tested = [one for one in self._tested[stamp_ns] if one.reason in (None, RejectReason.IMPROBABLE)]
        return max(tested, key=lambda one: one.probability or 0, default=None)

    def _gaps(self, row: int, stamp: int) -> ClosureDiagnosis:
        rules = self._run.settings.loop
        age_s = (stamp - int(self._places.stamps[0])) * 1e-9
        what = (
            f"the gap rules allow no match: none of {row} earlier keyframes is {rules.min_time_gap_s:g} s older and "
            f"{rules.min_travel_m:g} m back; the first is {age_s:.1f} s older"
        )
        parameter = "loop.min_time_gap_s and loop.min_travel_m: smaller ones match a place with what was just seen"
        return ClosureDiagnosis(stamp, None, float("inf"), "gap rules", what, parameter, {})

    def _retrieval(self, row: int, stamp: int, allowed: np.ndarray, right: np.ndarray) -> ClosureDiagnosis:
        count = len(self._tested[stamp])
        if not len(right):
            return ClosureDiagnosis(
                stamp, None, float("inf"), "retrieval", f"the database returned {count} candidates", "", {}
            )
        rank, similarity, match = self._best_rank(row, allowed, right)
        distance = float(self._places.distances(row)[match])
        what = f"the database returned {count} candidates, none of them the place {distance:.1f} m away"
        parameter = ""
        if rank:
            what += f", which is number {rank} of {len(allowed)} by its similarity of {similarity:.2f}"
            parameter = (
                f"loop.top_k: {rank} (now {self._run.settings.loop.top_k}); each candidate is reranked once more"
            )
        if similarity < self._run.settings.loop.min_similarity:
            parameter = f"loop.min_similarity: {similarity:.2f} (now {self._run.settings.loop.min_similarity:g})"
        return ClosureDiagnosis(stamp, int(self._places.stamps[match]), distance, "retrieval", what, parameter, {})

    def _best_rank(self, row: int, allowed: np.ndarray, right: np.ndarray) -> tuple[int, float, int]:
        """Rank, similarity and row of the most similar right place; rank 0 without descriptors."""
        descriptors = self._run.descriptors
        if descriptors is None:
            return 0, float("nan"), int(right[0])
        similarities = descriptors[allowed] @ descriptors[row]
        own = descriptors[right] @ descriptors[row]
        best = int(own.argmax())
        return int((similarities > own[best]).sum()) + 1, float(own[best]), int(right[best])

    def _decision(self, stamp: int, best: Hypothesis) -> ClosureDiagnosis:
        gate, what, parameter = self._gate(best)
        row, match = self._places.row(stamp), self._places.row(best.match_stamp_ns)
        distance = float("inf") if row is None or match is None else float(self._places.distances(row)[match])
        return ClosureDiagnosis(stamp, best.match_stamp_ns, distance, gate, what, parameter, self.contributions(best))

    def _gate(self, best: Hypothesis) -> tuple[Gate, str, str]:
        match best.reason:
            case None:
                return "found", f"a loop closure was published, probability {best.probability or 0:.3f}", ""
            case RejectReason.NOT_SELECTED:
                return self._selection(best)
            case RejectReason.NO_DEPTH:
                return "depth", best.outcome, "topics.cloud or topics.right_image"
            case RejectReason.NO_POSE:
                return "pose", f"{best.outcome} ({best.measurements.get('inliers_image', 0):.0f} image inliers)", ""
            case RejectReason.IMPROBABLE:
                return self._probability(best)
        return "objection", best.outcome, _LIMITS.get(best.reason, "")

    def _selection(self, best: Hypothesis) -> tuple[Gate, str, str]:
        tested = sum(one.reason is not RejectReason.NOT_SELECTED for one in self._tested[best.query_stamp_ns])
        similarity, now = best.candidate.similarity, self._run.settings.verification.refine_best
        what = f"it was returned (similarity {similarity:.2f}) but {tested} others were more promising"
        return "selection", what, f"verification.refine_best: more than {now}; time grows with it"

    def _probability(self, best: Hypothesis) -> tuple[Gate, str, str]:
        chosen, probability = self._run.settings.verification, best.probability or 0.0
        short = _odds(chosen.min_probability) - _odds(probability)
        lacking = [f"{name.replace('_', ' ')} {lost:.1f}" for name, lost in list(self.missing(best).items())[:3]]
        what = f"{best.outcome}, {short:.1f} short in log-odds" + (f"; lost by {', '.join(lacking)}" if lacking else "")
        now, (then, wrong) = self.at_threshold(chosen.min_probability)[0], self.at_threshold(probability)
        cost = f", {wrong} of all {then} between different places" if self._places.known.any() else ", unjudged"
        return "probability", what, f"verification.min_probability: {probability:.3f} adds {then - now} closures{cost}"


def _odds(probability: float) -> float:
    clipped = min(max(probability, 1e-9), 1 - 1e-9)
    return log(clipped / (1 - clipped))
