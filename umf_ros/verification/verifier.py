"""From candidates to verified loop closures."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Frame, Keyframe, LoopClosure, Points
from umf_ros.core.geometry import Array, heading
from umf_ros.verification import constants as const
from umf_ros.verification.acceptance import load_acceptance, refuted
from umf_ros.verification.hypotheses import Hypothesis, TemporalMemory, find_hypotheses, near
from umf_ros.verification.measurement import (
    AlignedHypothesis,
    Measurement,
    against_passage,
    against_rivals,
    beside,
    image_agreement,
    measure,
    measure_candidate,
    uncompared,
)
from umf_ros.verification.prepared_scan import ScanCache, levelled, views_tell
from umf_ros.verification.rerank import RankedCandidate, rerank, select
from umf_ros.verification.scan_alignment import align_scans
from umf_ros.verification.yaw_search import RotatedElevationMap

UNTESTED, NO_POSE = "less promising than others", "no pose fits, or others fit better"
FOUND_BEFORE = "not compared: one was found"
LESS_SURE = "a more probable closure of this keyframe is published"
NO_DEPTH = "no depth: neither a scan nor a stereo pair"
"""Why there is nothing to judge about a candidate."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What verification found for one candidate.

    Attributes:
        candidate: the candidate that was tested.
        reason: one word or a short phrase; "accepted" when there is a closure.
        measurement: what was measured about its most probable hypothesis, or only about the candidate.
        closure: the loop closure, or None when rejected.
        inlier_pixels: (K, 4) float32: u, v in the query image and u, v in the match image.
        probability: that the hypothesis is right; None without one.
    """

    candidate: Candidate
    reason: str
    measurement: Measurement
    closure: LoopClosure | None = None
    inlier_pixels: Points = field(default_factory=lambda: np.empty((0, 4), np.float32))
    probability: float | None = None

    @property
    def numbers(self) -> dict[str, float]:
        """What was measured, and the probability made of it, by name."""
        return self.measurement.numbers | ({} if self.probability is None else {"probability": self.probability})


@dataclass(frozen=True, slots=True)
class JudgedHypothesis:
    """An aligned hypothesis, what was measured about it, and the probability that it is right."""

    aligned: AlignedHypothesis
    measurement: Measurement
    probability: float

    @property
    def match_stamp_ns(self) -> int:
        """Key of the matched keyframe."""
        return self.aligned.match.stamp_ns

    def told_by_images(self) -> JudgedHypothesis:
        """The same, knowing whether the images agree: for people, and too slow for every hypothesis."""
        agreement = image_agreement(self.aligned.query, self.aligned.match, self.aligned.pose)
        return replace(self, measurement=replace(self.measurement, agreement_image=agreement))


class Verifier:
    """Decides which candidates of a query are the same place, and where the rover stood.

    Candidates are reranked by their local features; the best get hypotheses from elevation maps and
    features; the best hypotheses are aligned scan to scan and judged by one calibrated probability.
    Every step is seeded and runs on one thread, so the verdicts do not depend on the machine. The
    only memory is what the last few keyframes found (`reset` forgets it); keyframes must come in order.

    Args:
        settings: the verification group of the settings.

    Raises:
        ConfigError: the acceptance model cannot be read.
    """

    def __init__(self, settings: Verification) -> None:
        self._settings = settings
        self._acceptance = load_acceptance(settings.calibration)
        self._threshold = settings.min_probability
        self._memory = TemporalMemory()
        self._scans = ScanCache()
        self._guesses: Mapping[int, Array] = {}
        self.latency_ms: dict[str, float] = {}

    def retune(self, settings: Verification) -> None:
        """Verify by other settings from now on; the acceptance model stays."""
        self._settings, self._threshold = settings, settings.min_probability

    def reset(self) -> None:
        """Forget earlier keyframes, as after a jump of the clock."""
        self._memory.reset()
        self._scans.clear()

    def prefetch(self, frame: Frame) -> None:
        """Make ready what is asked of a scan whose keyframe is verified next."""
        self._scans.prefetch(frame)

    def verify(
        self,
        query: Keyframe,
        candidates: Sequence[tuple[Candidate, Keyframe]],
        guesses: Mapping[int, Array] = MappingProxyType({}),
    ) -> list[Verdict]:
        """One verdict per candidate, accepted ones first, then in the order of the reranking.

        Args:
            query: the newest keyframe.
            candidates: what the database returned, with their keyframes.
            guesses: poses `match_T_query` worth a look, by the stamp of the match.
        """
        self._guesses = guesses
        self.latency_ms = {"rerank": 0.0, "refine": 0.0}
        with self._timed("refine"):
            turned = self._turned(query) if candidates else None
        # where odometry carries an accepted closure to is looked at first: most often that is all there is to do
        expected = self._memory.expected(query, candidates)
        ranked = self._rank(query, expected)
        judged = self._refine(query, ranked, turned)
        tested = {item.candidate.stamp_ns for item in ranked}
        if self._wanting(judged):
            ranked = self._rank(query, candidates)
            chosen = select(ranked, self._settings.refine_best)
            judged += self._refine(query, [one for one in chosen if one.candidate.stamp_ns not in tested], turned)
            tested |= {item.candidate.stamp_ns for item in chosen}
        found = [(one.aligned.match, one.aligned.pose, one.probability >= self._threshold) for one in judged]
        self._memory.remember(query, found)
        verdicts = self._surest(self._decide(query, ranked, judged, tested))
        known = {verdict.candidate.index for verdict in verdicts}
        rest = [candidate for candidate, _ in candidates if candidate.index not in known]
        return verdicts + [Verdict(one, FOUND_BEFORE, uncompared(one)) for one in rest]

    def _surest(self, verdicts: list[Verdict]) -> list[Verdict]:
        """Keep the `max_closures` most probable closures: those of one keyframe are correlated."""
        accepted = sorted(
            (one for one in verdicts if one.closure is not None), key=lambda one: -(one.probability or 0.0)
        )
        surplus = {id(one) for one in accepted[self._settings.max_closures :]}
        kept = [replace(one, closure=None, reason=LESS_SURE) if id(one) in surplus else one for one in verdicts]
        return sorted(kept, key=lambda one: one.closure is None)

    def examine(self, query: Keyframe, candidates: Sequence[tuple[Candidate, Keyframe]]) -> list[JudgedHypothesis]:
        """Every hypothesis about every candidate, without a decision: what the decision is fitted on."""
        hypotheses = self._hypotheses(query, rerank(query, candidates, self._settings), self._turned(query))
        examined = self._judge(query, hypotheses, 0.0)
        first = {one.match_stamp_ns: one.aligned for one in reversed(examined)}
        self._memory.remember(query, [(one.match, one.pose, False) for one in first.values()])
        return examined

    def _rank(self, query: Keyframe, candidates: Sequence[tuple[Candidate, Keyframe]]) -> list[RankedCandidate]:
        with self._timed("rerank"):
            return rerank(query, candidates, self._settings)

    def _refine(
        self, query: Keyframe, ranked: list[RankedCandidate], turned: RotatedElevationMap | None
    ) -> list[JudgedHypothesis]:
        """The best hypotheses about some candidates, judged."""
        with self._timed("refine"):
            hypotheses = self._hypotheses(query, ranked, turned)[: const.MAX_REFINED]
            return self._judge(query, hypotheses, min(const.HOPELESS, self._threshold))

    def _wanting(self, judged: list[JudgedHypothesis]) -> bool:
        """Whether more closures are asked for than were found."""
        accepted = {one.match_stamp_ns for one in judged if not self._objection(one)}
        return len(accepted) < self._settings.max_closures

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.latency_ms[name] += 1e3 * (time.perf_counter() - start)

    def _turned(self, query: Keyframe) -> RotatedElevationMap | None:
        return RotatedElevationMap(self._scans[query]) if self._scans[query].usable else None

    def _hypotheses(
        self, query: Keyframe, ranked: list[RankedCandidate], turned: RotatedElevationMap | None
    ) -> list[Hypothesis]:
        """Hypotheses about the given candidates, the most promising first."""
        found: list[Hypothesis] = []
        for item in ranked:
            guess = self._guesses.get(item.keyframe.stamp_ns)
            found += find_hypotheses(query, item, turned, self._scans[item.keyframe], self._settings, guess)
        return sorted(found, key=lambda one: -one.score)

    def _judge(self, query: Keyframe, hypotheses: list[Hypothesis], hopeless: float) -> list[JudgedHypothesis]:
        """Align and measure hypotheses, and judge each knowing the others about its candidate.

        What stays below the probability `hopeless` even without rivals is not held against any.
        """
        measured = [(one, self._measure(one)) for one in self._aligned(query, hypotheses)]
        judged = []
        for one, measurement in measured:
            others = [(other.pose, found) for other, found in measured if other.match is one.match]
            known = beside(measurement, one.pose, others)
            if self._acceptance.at_best(known) >= hopeless:
                known = against_rivals(known, one)
            probability = self._probability(one, known)
            if probability >= self._threshold:
                known = against_passage(known, one)
            judged.append(JudgedHypothesis(one, known, probability))
        return judged

    def _probability(self, aligned: AlignedHypothesis, measurement: Measurement) -> float:
        """That a hypothesis is right; where scans show bare ground alone, nothing would refute a texture seen twice."""
        found = self._acceptance.probability(measurement)
        scans = self._scans[aligned.match], self._scans[aligned.query]
        if aligned.scans is not None or not all(scan.usable and scan.bare for scan in scans):
            return found
        if measurement.spread < const.BARE_SPREAD:
            return 0.0
        return found / (found + const.BARE_ODDS * (1.0 - found))

    def _aligned(self, query: Keyframe, hypotheses: list[Hypothesis]) -> list[AlignedHypothesis]:
        """Each aligned; of those that begin or end where another of the same candidate ended, only the first."""
        kept: list[AlignedHypothesis] = []
        for hypothesis in hypotheses:
            ends = [one.pose for one in kept if one.match is hypothesis.ranked.keyframe]
            if any(near(hypothesis.pose, end, const.DISTINCT_M, const.DISTINCT_RAD) for end in ends):
                continue
            aligned = self._align(query, hypothesis)
            if not any(near(aligned.pose, end, const.SAME_M, const.SAME_RAD) for end in ends):
                kept.append(aligned)
        return kept

    def _align(self, query: Keyframe, hypothesis: Hypothesis) -> AlignedHypothesis:
        scans = self._scans[hypothesis.ranked.keyframe], self._scans[query]
        if hypothesis.views is not None and views_tell(*scans):
            return AlignedHypothesis(query, hypothesis, hypothesis.views.align(hypothesis.pose), None)
        return AlignedHypothesis(query, hypothesis, align_scans(*scans, hypothesis.pose), scans)

    def _measure(self, aligned: AlignedHypothesis) -> Measurement:
        return measure(aligned, self._memory, self._settings.odometry_drift)

    def _decide(
        self, query: Keyframe, ranked: list[RankedCandidate], judged: list[JudgedHypothesis], tested: set[int]
    ) -> list[Verdict]:
        best: dict[int, JudgedHypothesis] = {}
        for one in judged:
            known = best.get(one.match_stamp_ns)
            if known is None or one.probability > known.probability:
                best[one.match_stamp_ns] = one
        verdicts = []
        for item in ranked:
            stamp = item.candidate.stamp_ns
            if stamp in best:
                verdicts.append(self._verdict(item, best[stamp].told_by_images()))
            else:
                metric = query.has_depth or item.keyframe.has_depth
                reason = (NO_POSE if metric else NO_DEPTH) if stamp in tested else UNTESTED
                verdicts.append(Verdict(item.candidate, reason, measure_candidate(item)))
        return sorted(verdicts, key=lambda verdict: verdict.closure is None)

    def _verdict(self, ranked: RankedCandidate, judged: JudgedHypothesis) -> Verdict:
        aligned, measurement, probability = judged.aligned, judged.measurement, judged.probability
        pixels = aligned.consistent_pixels
        objection = self._objection(judged)
        if objection:
            return Verdict(ranked.candidate, objection, measurement, None, pixels, probability)
        covariance = aligned.covariance(self._acceptance.covariances[measurement.kind])
        closure = LoopClosure(aligned.query.stamp_ns, ranked.candidate.stamp_ns, aligned.pose, covariance, probability)
        return Verdict(ranked.candidate, "accepted", measurement, closure, pixels, probability)

    def _objection(self, judged: JudgedHypothesis) -> str:
        """Why a hypothesis is no closure; empty when it is one."""
        if judged.probability < self._threshold:
            below = f"probability {judged.probability:.2f} is below {self._threshold:g}"
            return ": ".join(filter(None, (below, judged.measurement.discord)))
        if reason := refuted(judged.measurement):
            return reason
        if strange := self._acceptance.unlike(judged.measurement):
            return f"unlike anything the decision was fitted on: {strange}"
        pose = judged.aligned.pose
        turn_deg, shift_m = abs(np.degrees(heading(pose))), float(np.linalg.norm(pose[:3, 3]))
        # a place is a position and a view [UMF 5.1.2]: whoever looks elsewhere is somewhere else
        if 0 < self._settings.max_turn_deg < turn_deg:
            return f"turned by {turn_deg:.0f} deg, more than {self._settings.max_turn_deg:g}"
        if (shared := _shared_view(judged.aligned)) < const.MIN_SHARED_VIEW:
            return f"turned by {turn_deg:.0f} deg: the views share only {max(shared, 0):.0%}"
        if shift_m > self._settings.max_shift_m:
            return f"{shift_m:.1f} m apart, more than {self._settings.max_shift_m:g}"
        return ""


def _shared_view(aligned: AlignedHypothesis) -> float:
    """Share of the narrower view that both sensors see at the pose that was found."""
    if aligned.scans is None:
        return 1.0 - abs(heading(aligned.pose)) / min(one.camera.width_rad for one in (aligned.query, aligned.match))
    match, query = aligned.scans
    turn = heading(levelled(match, query, aligned.pose))
    return float(match.view.overlap(query.view, np.array([turn]))[0])
