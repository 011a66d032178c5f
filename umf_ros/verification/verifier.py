"""Verify candidates geometrically: from retrieved places to metric loop closures."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from umf_ros.core.config import Verification
from umf_ros.core.frames import Keyframe, LoopClosure
from umf_ros.core.geometry import Array, heading
from umf_ros.verification import constants as const
from umf_ros.verification.acceptance import load_acceptance, refuted
from umf_ros.verification.hypothesis import Hypothesis, RejectReason
from umf_ros.verification.measurement import (
    closure_covariance,
    compare_poses,
    image_agreement,
    measure,
    measure_ambiguity,
    measure_passage,
)
from umf_ros.verification.pose_search import TemporalMemory, find_hypotheses, near
from umf_ros.verification.prepared_scan import ScanCache, levelled, views_decide
from umf_ros.verification.rerank import Offered, rerank, select
from umf_ros.verification.scan_alignment import align_scans
from umf_ros.verification.yaw_search import RotatedElevationMap

NO_GUESSES: Mapping[int, Array] = MappingProxyType({})


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
        self.latency_ms: dict[str, float] = {}

    def retune(self, settings: Verification) -> None:
        """Verify by other settings from now on; the acceptance model stays."""
        self._settings, self._threshold = settings, settings.min_probability

    def reset(self) -> None:
        """Forget earlier keyframes, as after a jump of the clock."""
        self._memory.reset()
        self._scans.clear()

    def prefetch(self, keyframe: Keyframe) -> None:
        """Prepare the scan of a keyframe that is verified next; it need not be embedded yet."""
        self._scans[keyframe].make_ready()

    def verify(
        self,
        query: Keyframe,
        candidates: Sequence[Offered],
        guesses: Mapping[int, Array] = NO_GUESSES,
    ) -> list[Hypothesis]:
        """Return one hypothesis per candidate with its reason, accepted ones first, then in the order of the reranking.

        Args:
            query: the newest keyframe.
            candidates: of the database, with their keyframes.
            guesses: poses `match_T_query` from odometry, by the stamp of the match.
        """
        self.latency_ms = {"rerank": 0.0, "refine": 0.0}
        with self._timed("refine"):
            turned = self._turned(query) if candidates else None
        # the candidate that odometry predicts from an accepted closure comes first: most often it suffices
        ranked = chosen = self._rank(query, self._memory.expected(query, candidates))
        judged = self._refine(query, chosen, turned, guesses)
        if self._wanting(judged):
            expected = {candidate.stamp_ns for candidate, _ in chosen}
            ranked = self._rank(query, candidates)
            selected = select(ranked, self._settings.refine_best)
            others = [one for one in selected if one[0].stamp_ns not in expected]
            judged += self._refine(query, others, turned, guesses)
            chosen = chosen + selected
        self._memory.remember(
            query, [(one.keyframes[1], one.pose, (one.probability or 0.0) >= self._threshold) for one in judged]
        )
        found = self._best(query, ranked, judged, {candidate.stamp_ns for candidate, _ in chosen})
        compared = {candidate.index for candidate, _ in ranked}
        for candidate, keyframe in candidates:
            if candidate.index not in compared:
                found.append(Hypothesis.of(query, candidate, keyframe, reason=RejectReason.NOT_COMPARED))
        return found

    def examine(self, query: Keyframe, candidates: Sequence[Offered]) -> list[Hypothesis]:
        """Return all judged hypotheses about all candidates, without a decision: the examples of the fit."""
        hypotheses = self._hypotheses(query, rerank(query, candidates, self._settings), self._turned(query))
        examined = self._judge(hypotheses, 0.0)
        first = {one.match_stamp_ns: one for one in reversed(examined)}
        self._memory.remember(query, [(one.keyframes[1], one.pose, False) for one in first.values()])
        return examined

    def _rank(self, query: Keyframe, candidates: Sequence[Offered]) -> list[Offered]:
        with self._timed("rerank"):
            return rerank(query, candidates, self._settings)

    def _refine(
        self,
        query: Keyframe,
        ranked: list[Offered],
        turned: RotatedElevationMap | None,
        guesses: Mapping[int, Array],
    ) -> list[Hypothesis]:
        """The best hypotheses about some candidates, judged."""
        with self._timed("refine"):
            hypotheses = self._hypotheses(query, ranked, turned, guesses)[: const.MAX_REFINED]
            return self._judge(hypotheses, min(const.HOPELESS, self._threshold))

    def _wanting(self, judged: list[Hypothesis]) -> bool:
        """Whether more closures are asked for than were found."""
        accepted = {one.match_stamp_ns for one in judged if self._objection(one) is None}
        return len(accepted) < self._settings.max_closures

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.latency_ms[name] += 1e3 * (time.perf_counter() - start)

    def _turned(self, query: Keyframe) -> RotatedElevationMap | None:
        return RotatedElevationMap(self._scans[query]) if self._scans[query].usable else None

    def _hypotheses(
        self,
        query: Keyframe,
        ranked: list[Offered],
        turned: RotatedElevationMap | None,
        guesses: Mapping[int, Array] = NO_GUESSES,
    ) -> list[Hypothesis]:
        """Hypotheses about the given candidates, the most promising first."""
        found: list[Hypothesis] = []
        for candidate, keyframe in ranked:
            scan, guess = self._scans[keyframe], guesses.get(keyframe.stamp_ns)
            found += find_hypotheses(query, candidate, keyframe, turned, scan, self._settings, guess)
        return sorted(found, key=lambda one: -one.score)

    def _judge(self, hypotheses: list[Hypothesis], hopeless: float) -> list[Hypothesis]:
        """Align and measure hypotheses, and judge each beside the others about its candidate.

        The slow tests are left out below the probability `hopeless` that a hypothesis would have if it passed them.
        """
        aligned = self._aligned(hypotheses)
        for one in aligned:
            one.measurement = measure(one, self._memory, self._settings.odometry_drift)
        compared = []
        for one in aligned:
            others = [(other.pose, other.measurement) for other in aligned if other.candidate is one.candidate]
            compared.append(compare_poses(one.measurement, one.pose, others))
        for one, one.measurement in zip(aligned, compared, strict=True):
            if self._acceptance.at_best(one.measurement) >= hopeless:
                one.measurement = measure_ambiguity(one)
            one.probability = self._probability(one)
            if one.probability >= self._threshold:
                one.measurement = measure_passage(one)
        return aligned

    def _probability(self, hypothesis: Hypothesis) -> float:
        """That a hypothesis is right; where scans show bare ground alone, nothing would refute a texture seen twice."""
        found = self._acceptance.probability(hypothesis.measurement)
        scans = [self._scans[keyframe] for keyframe in hypothesis.keyframes]
        if hypothesis.scans or not all(scan.usable and scan.bare for scan in scans):
            return found
        if hypothesis.measurement.spread < const.BARE_SPREAD:
            return 0.0
        return found / (found + const.BARE_ODDS * (1.0 - found))

    def _aligned(self, hypotheses: list[Hypothesis]) -> list[Hypothesis]:
        """Each aligned; of those that begin or end where another of the same candidate ended, only the first."""
        kept: list[Hypothesis] = []
        for one in hypotheses:
            ends = [other.pose for other in kept if other.candidate is one.candidate]
            if any(near(one.pose, end, const.DISTINCT_M, const.DISTINCT_RAD) for end in ends):
                continue
            self._align(one)
            if not any(near(one.pose, end, const.SAME_M, const.SAME_RAD) for end in ends):
                kept.append(one)
        return kept

    def _align(self, hypothesis: Hypothesis) -> None:
        query, match = hypothesis.keyframes
        scans = self._scans[match], self._scans[query]
        if hypothesis.views is not None and views_decide(*scans):
            hypothesis.alignment = hypothesis.views.align(hypothesis.pose)
        else:
            hypothesis.scans, hypothesis.alignment = scans, align_scans(*scans, hypothesis.pose)
        hypothesis.pose = hypothesis.alignment.pose

    def _best(
        self, query: Keyframe, ranked: list[Offered], judged: list[Hypothesis], tested: set[int]
    ) -> list[Hypothesis]:
        """The most probable hypothesis of each candidate, decided; accepted ones first."""
        best: dict[int, Hypothesis] = {}
        for one in judged:
            known = best.setdefault(one.match_stamp_ns, one)
            if (one.probability or 0.0) > (known.probability or 0.0):
                best[one.match_stamp_ns] = one
        found = []
        for candidate, keyframe in ranked:
            if candidate.stamp_ns in best:
                found.append(best[candidate.stamp_ns])
                self._decide(found[-1])
            else:
                metric = query.has_depth or keyframe.has_depth
                reason = RejectReason.NO_POSE if metric else RejectReason.NO_DEPTH
                reason = reason if candidate.stamp_ns in tested else RejectReason.NOT_SELECTED
                found.append(Hypothesis.of(query, candidate, keyframe, reason=reason))
        accepted = sorted((one for one in found if one.accepted), key=lambda one: -(one.probability or 0.0))
        for one in accepted[self._settings.max_closures :]:  # closures of one keyframe are correlated
            one.reject(RejectReason.LESS_PROBABLE)
        return sorted(found, key=lambda one: not one.accepted)

    def _decide(self, hypothesis: Hypothesis) -> None:
        """Fill in what people and the closure need, and the reason against it, if there is one."""
        query, match = hypothesis.keyframes
        if hypothesis.views is not None:
            hypothesis.inlier_pixels = hypothesis.views.consistent_pixels(hypothesis.pose)
        agreement = image_agreement(query, match, hypothesis.pose)
        hypothesis.measurement = replace(hypothesis.measurement, agreement_image=agreement)
        if (objection := self._objection(hypothesis)) is not None:
            hypothesis.reject(*objection)
            return
        covariance = closure_covariance(hypothesis, self._acceptance.covariances[hypothesis.measurement.kind])
        probability = hypothesis.probability or 0.0
        hypothesis.closure = LoopClosure(*hypothesis.endpoints, hypothesis.pose, covariance, probability)

    def _objection(self, hypothesis: Hypothesis) -> tuple[RejectReason, str] | None:
        """Why a hypothesis is no closure, with figures; None when it is one."""
        probability, measurement, pose = hypothesis.probability or 0.0, hypothesis.measurement, hypothesis.pose
        if probability < self._threshold:
            below = f"{probability:.2f} < {self._threshold:g}"
            return RejectReason.IMPROBABLE, ", ".join(filter(None, (below, measurement.modality_conflict)))
        if (reason := refuted(measurement)) is not None:
            return reason
        if strange := self._acceptance.out_of_range(measurement):
            return RejectReason.OUT_OF_RANGE, strange
        turn_deg, shift_m = abs(np.degrees(heading(pose))), float(np.linalg.norm(pose[:3, 3]))
        # a place is a position and a view [UMF 5.1.2]
        if 0 < self._settings.max_turn_deg < turn_deg:
            return RejectReason.TURNED, f"{turn_deg:.0f} deg > {self._settings.max_turn_deg:g}"
        if (shared := _shared_view(hypothesis)) < const.MIN_SHARED_VIEW:
            return RejectReason.LITTLE_SHARED_VIEW, f"{max(shared, 0):.0%}, turned by {turn_deg:.0f} deg"
        if shift_m > self._settings.max_shift_m:
            return RejectReason.TOO_FAR, f"{shift_m:.1f} m > {self._settings.max_shift_m:g}"
        return None


def _shared_view(hypothesis: Hypothesis) -> float:
    """Share of the narrower view that both sensors see at the pose that was found."""
    if not hypothesis.scans:
        return 1.0 - abs(heading(hypothesis.pose)) / min(one.camera.width_rad for one in hypothesis.keyframes)
    match, query = hypothesis.scans
    turn = heading(levelled(match, query, hypothesis.pose))
    return float(match.view.overlap(query.view, np.array([turn]))[0])
