"""From candidates to verified loop closures."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from umf_ros.config import Verification
from umf_ros.frames import Candidate, Keyframe, LoopClosure, Verdict
from umf_ros.geometry import Array, heading
from umf_ros.verification import terrain
from umf_ros.verification.acceptance import load_calibration
from umf_ros.verification.evidence import Evidence, context, from_features, from_scans
from umf_ros.verification.features import consistent_pixels
from umf_ros.verification.history import History
from umf_ros.verification.proposals import Proposal, propose
from umf_ros.verification.reranking import Ranked, rerank
from umf_ros.verification.scans import ScanCache
from umf_ros.verification.selection import expected, select

MAX_REFINED = 3  # proposals per query that are aligned: bounds the time
MIN_TERRAIN_SCORE = 5.0  # below, two maps fit no better than noise

Judged = list[tuple[Evidence, float]]


class Verifier:
    """Decides which candidates of a query are the same place, and where the rover stood.

    Candidates are reranked by their local features; the best get poses proposed by terrain and
    features; the best proposals are aligned scan to scan and judged by one calibrated probability.
    Every step is seeded and runs on one thread, so the verdicts do not depend on the machine. The
    only memory is what the last few keyframes found (`reset` forgets it); keyframes must come in order.

    Args:
        settings: the verification group of the settings.

    Raises:
        ConfigError: the acceptance model cannot be read.
    """

    def __init__(self, settings: Verification) -> None:
        self._settings = settings
        self._calibration = load_calibration(settings.calibration)
        self._threshold = settings.min_probability
        self._history = History()
        self._scans = ScanCache()
        self.latency_ms: dict[str, float] = {}

    def reset(self) -> None:
        """Forget earlier keyframes, as after a jump of the clock."""
        self._history.reset()
        self._scans.clear()

    def verify(self, query: Keyframe, candidates: Sequence[tuple[Candidate, Keyframe]]) -> list[Verdict]:
        """One verdict per candidate, accepted ones first, then in the order of the reranking.

        Args:
            query: the newest keyframe.
            candidates: what the database returned, with their keyframes.
        """
        start = time.perf_counter()
        ranked = rerank(query, candidates, self._settings)
        reranked = time.perf_counter()
        judged, tested = self._test(query, ranked)
        self._history.remember(
            query, [(item.place, item.pose, probability >= self._threshold) for item, probability in judged]
        )
        verdicts = self._decide(query, ranked, judged, tested)
        self.latency_ms = {"rerank": 1e3 * (reranked - start), "refine": 1e3 * (time.perf_counter() - reranked)}
        return verdicts

    def examine(self, query: Keyframe, candidates: Sequence[tuple[Candidate, Keyframe]]) -> list[Evidence]:
        """Evidence for every proposal of every candidate, without a decision: what the decision is fitted on."""
        proposals = self._propose(query, rerank(query, candidates, self._settings), self._fan(query))
        examined = [self._measure(query, proposal) for proposal in proposals]
        first = {item.place.stamp_ns: item for item in reversed(examined)}
        self._history.remember(query, [(item.place, item.pose, False) for item in first.values()])
        return examined

    def _test(self, query: Keyframe, ranked: list[Ranked]) -> tuple[Judged, set[int]]:
        """Judge the candidates worth it, the expected place first, until there are closures enough.

        Also returns the stamps of the candidates that were tried.
        """
        judged: Judged = []
        tested: set[int] = set()
        fan = self._fan(query) if ranked else None
        for group in (expected(query, ranked, self._history), select(ranked, self._settings.refine_best)):
            fresh = [item for item in group if item.candidate.stamp_ns not in tested]
            tested |= {item.candidate.stamp_ns for item in fresh}
            for proposal in self._propose(query, fresh, fan)[:MAX_REFINED]:
                evidence = self._measure(query, proposal)
                judged.append((evidence, self._calibration.probability(evidence.numbers, evidence.kind)))
                accepted = {item.place.stamp_ns for item, p in judged if not self._objection(item.pose, p)}
                if len(accepted) >= self._settings.max_closures:
                    return judged, tested
        return judged, tested

    def _fan(self, query: Keyframe) -> terrain.Fan | None:
        return terrain.Fan(self._scans[query].terrain) if self._scans[query].surface.usable else None

    def _measure(self, query: Keyframe, proposal: Proposal) -> Evidence:
        scans = self._scans[query], self._scans[proposal.ranked.keyframe]
        if all(scan.surface.usable for scan in scans):
            evidence = from_scans(proposal, *scans, self._calibration)
        else:
            evidence = from_features(query, proposal, self._calibration)
        evidence.numbers.update(context(query, evidence, self._history, self._settings.odometry_drift))
        return evidence

    def _propose(self, query: Keyframe, ranked: list[Ranked], fan: terrain.Fan | None) -> list[Proposal]:
        """Poses for the given candidates, the most promising first."""
        proposals: list[Proposal] = []
        for item in ranked:
            scan = self._scans[item.keyframe]
            both = fan is not None and scan.surface.usable
            found = propose(query, item, fan if both else None, scan if both else None, self._settings)
            proposals += [one for one in found if not both or one.score >= MIN_TERRAIN_SCORE]
        return sorted(proposals, key=lambda one: -one.score)

    def _decide(self, query: Keyframe, ranked: list[Ranked], judged: Judged, tested: set[int]) -> list[Verdict]:
        best: dict[int, tuple[Evidence, float]] = {}
        for evidence, probability in judged:
            stamp = evidence.place.stamp_ns
            if stamp not in best or probability > best[stamp][1]:
                best[stamp] = evidence, probability
        verdicts = []
        for item in ranked:
            stamp = item.candidate.stamp_ns
            if stamp in best:
                verdicts.append(self._verdict(query, item, *best[stamp]))
            else:
                reason = "no pose fits, or others fit better" if stamp in tested else "less promising than others"
                verdicts.append(Verdict(item.candidate, reason, item.numbers))
        return sorted(verdicts, key=lambda verdict: verdict.closure is None)

    def _verdict(self, query: Keyframe, ranked: Ranked, evidence: Evidence, probability: float) -> Verdict:
        numbers = evidence.numbers | {"probability": probability}
        pixels = consistent_pixels(query, ranked, evidence.pose)
        objection = self._objection(evidence.pose, probability)
        if objection:
            return Verdict(ranked.candidate, objection, numbers, None, pixels)
        closure = LoopClosure(
            query.stamp_ns, ranked.candidate.stamp_ns, evidence.pose, evidence.covariance, probability
        )
        return Verdict(ranked.candidate, "accepted", numbers, closure, pixels)

    def _objection(self, match_T_query: Array, probability: float) -> str:
        """Why a pose is no closure; empty when it is one."""
        if probability < self._threshold:
            return f"probability {probability:.2f} is below {self._threshold:g}"
        turn_deg, shift_m = abs(np.degrees(heading(match_T_query))), float(np.linalg.norm(match_T_query[:3, 3]))
        # a place is a position and a view (thesis 5.1.2): whoever looks elsewhere is somewhere else
        if turn_deg > self._settings.max_turn_deg:
            return f"turned by {turn_deg:.0f} deg, more than {self._settings.max_turn_deg:g}"
        if shift_m > self._settings.max_shift_m:
            return f"{shift_m:.1f} m apart, more than {self._settings.max_shift_m:g}"
        return ""
