"""Verify candidates geometrically: from retrieved places to metric loop closures."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType

import numpy as np

from umf_ros.core.config import Verification
from umf_ros.core.frames import Keyframe, LoopClosure
from umf_ros.core.geometry import Array, faces_back, heading, relative
from umf_ros.verification import constants as const
from umf_ros.verification.acceptance import WITHOUT_RIVALS, load_acceptance, refuted
from umf_ros.verification.hypothesis import Hypothesis, RejectReason, known_only, measurements_of, same_pose
from umf_ros.verification.measurement import closure_covariance, measure
from umf_ros.verification.passages import Position, compare_elsewhere, locate_along
from umf_ros.verification.pose_search import (
    RotatedMaps,
    TemporalMemory,
    consistent_pixels,
    find_hypotheses,
    predicted_hypotheses,
)
from umf_ros.verification.prepared_scan import ScanCache
from umf_ros.verification.rerank import Offered, rerank, select
from umf_ros.verification.scan_alignment import align_scans, inspect
from umf_ros.verification.scan_consistency import beyond_walls, excess_differences, repetition

NO_GUESSES: Mapping[int, Array] = MappingProxyType({})


class Verifier:
    """Decides which candidates of a query are the same place, and where the rover stood.

    Candidates are reranked by their local features; the best get hypotheses from their maps, or from their images where
    scans tell nothing; the best hypotheses are aligned and judged by one calibrated probability. Every step is seeded
    and runs on one thread, so the verdicts do not depend on the machine. The only memory is of what the last few
    keyframes found (`reset` forgets it); keyframes must come in order.

    Args:
        settings: the verification group of the settings.

    Attributes:
        scans: the prepared scans, kept while they are used.
        latency_ms: of the last call, by step.

    Raises:
        ConfigError: the acceptance model cannot be read.
    """

    def __init__(self, settings: Verification) -> None:
        self._settings = settings
        self._acceptance = load_acceptance(settings.calibration)
        self._memory = TemporalMemory()
        self._predicted = 0  # keyframes since the last search
        self.scans = ScanCache()
        self.latency_ms: dict[str, float] = {}

    def retune(self, settings: Verification) -> None:
        """Verify by other settings from now on; the acceptance model stays."""
        self._settings = settings

    def reset(self) -> None:
        """Forget earlier keyframes, as after a jump of the clock."""
        self._memory.reset()
        self._predicted = 0
        self.scans.clear()

    def prefetch(self, keyframe: Keyframe) -> None:
        """Prepare the scan of a keyframe that is verified next; it need not be embedded yet."""
        self.scans[keyframe].make_ready()

    def verify(
        self, query: Keyframe, candidates: Sequence[Offered], guesses: Mapping[int, Array] = NO_GUESSES
    ) -> list[Hypothesis]:
        """Return one hypothesis per candidate with its reason, accepted ones first, then in the order of the reranking.

        Args:
            query: the newest keyframe.
            candidates: of the database, with their keyframes.
            guesses: poses `match_T_query` from odometry, by the stamp of the match.
        """
        self.latency_ms = {"rerank": 0.0, "refine": 0.0}
        turned = self._turned(query) if candidates else None
        # the candidate that odometry predicts from an accepted closure comes first, at that pose: that is mostly all
        expected = self._memory.expected(query, candidates)
        ranked = chosen = self._rank(query, [expected[0]] if expected else [])
        judged = self._refine_predicted(query, chosen[0], expected[1]) if expected else []
        if not self._suffice(judged):
            self._predicted = 0
            judged = self._refine(query, chosen, turned, guesses)
        if not self._suffice(judged):
            known = {candidate.index for candidate, _ in chosen}
            ranked = self._rank(query, candidates)
            others = [one for one in select(ranked, self._settings.refine_best) if one[0].index not in known]
            judged += self._refine(query, others, turned, guesses)
            chosen = chosen + others
        self._memory.remember(query, [(one.keyframes[1], one.pose, self._objection(one) is None) for one in judged])
        found = self._best(query, ranked, judged, {candidate.index for candidate, _ in chosen})
        compared = {candidate.index for candidate, _ in ranked}
        missing = [one for one in candidates if one[0].index not in compared]
        return found + [Hypothesis.of(query, *one, reason=RejectReason.NOT_COMPARED) for one in missing]

    def examine(self, query: Keyframe, candidates: Sequence[Offered], poses: Sequence[Array] = ()) -> list[Hypothesis]:
        """Return all judged hypotheses about all candidates, without a decision: the examples of the fit.

        Args:
            query: the newest keyframe.
            candidates: with their keyframes.
            poses: (4, 4) `match_T_query` of the first candidate by its scan, each judged as if the search had found it
                as well.
        """
        ranked = rerank(query, candidates, self._settings)
        found = self._judge(self._hypotheses(query, ranked, self._turned(query)), 0.0)
        offered = (Hypothesis.of(query, *ranked[0], pose=pose) for pose in poses)
        examined = found + [judged for one in offered for judged in self._judge([one], 0.0, found)]
        first = {one.match_stamp_ns: one for one in reversed(examined)}
        self._memory.remember(query, [(one.keyframes[1], one.pose, False) for one in first.values()])
        return examined

    def _rank(self, query: Keyframe, candidates: Sequence[Offered]) -> list[Offered]:
        with self._timed("rerank"):
            return rerank(query, candidates, self._settings)

    def _suffice(self, judged: list[Hypothesis]) -> bool:
        """Whether as many candidates as may become closures do."""
        decisive = _most_probable(judged).values()
        return sum(self._objection(one) is None for one in decisive) >= self._settings.max_closures

    def _refine_predicted(self, query: Keyframe, offered: Offered, pose: Array) -> list[Hypothesis]:
        """The hypothesis at the pose that odometry carries over from a closure, judged; none when a search is due.

        A wrong closure must not carry itself on: every few keyframes the pose is searched as if it were unknown.
        """
        self._predicted += 1
        if self._predicted == const.SEARCHED_EVERY:
            return []
        with self._timed("refine"):
            scans = self.scans[offered[1]], self.scans[query]
            return self._judge(predicted_hypotheses(query, offered, scans, pose), self._settings.min_probability)

    def _refine(
        self, query: Keyframe, ranked: list[Offered], turned: RotatedMaps | None, guesses: Mapping[int, Array]
    ) -> list[Hypothesis]:
        """The best hypotheses about some candidates, judged."""
        with self._timed("refine"):
            return self._judge(self._hypotheses(query, ranked, turned, guesses), self._settings.min_probability)

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.latency_ms[name] += 1e3 * (time.perf_counter() - start)

    def _turned(self, query: Keyframe) -> RotatedMaps | None:
        return RotatedMaps(self.scans[query]) if self.scans[query].usable else None

    def _hypotheses(
        self,
        query: Keyframe,
        ranked: list[Offered],
        turned: RotatedMaps | None,
        guesses: Mapping[int, Array] = NO_GUESSES,
    ) -> list[Hypothesis]:
        """Hypotheses about the given candidates, the most promising first."""
        found: list[Hypothesis] = []
        for candidate, keyframe in ranked:
            scan, guess = self.scans[keyframe], guesses.get(keyframe.stamp_ns)
            found += find_hypotheses(query, candidate, keyframe, turned, scan, self._settings, guess)
        return sorted(found, key=lambda one: -one.score)

    def _judge(self, hypotheses: list[Hypothesis], least: float, known: Sequence[Hypothesis] = ()) -> list[Hypothesis]:
        """Align and measure the first hypotheses, and judge each beside the others about its candidate.

        The others are only aligned where one of these is promising: the right pose may be among them. The slow tests
        are left out where they cannot change the decision; of the hypotheses along one passage, the first stands for
        all.

        Args:
            hypotheses: the most promising first.
            least: probability that a closure needs; with 0, no test is left out.
            known: judged earlier, whose poses are rivals of these.
        """
        aligned = self._aligned(hypotheses[: const.MAX_REFINED], [])
        promising = [one.candidate for one in aligned if self._promises(one, least)]
        others = [one for one in hypotheses[const.MAX_REFINED :] if any(one.candidate is it for it in promising)]
        aligned += self._aligned(others, aligned)
        judged: list[Hypothesis] = []
        passages: list[tuple[Hypothesis, Position]] = []
        for one in aligned:
            if any(other.candidate is one.candidate and found.compared(one.pose) for other, found in passages):
                continue
            judged.append(one)
            if self._promises(one, least):
                rivals = [other.pose for other in (*known, *aligned) if other.candidate is one.candidate]
                found = self._look_elsewhere(one, [pose for pose in rivals if not same_pose(pose, one.pose)])
                passages += [(one, found)] if found else []
                one.measurements |= excess_differences(one.scans[0], one.scans[1], one.pose)
            one.probability = self._probability(one)
            if one.scans and (not least or self._objection(one) is None):
                one.measurements |= self._commonplace(one)
                one.probability = self._probability(one)
        for one, found in passages:  # those at another heading are rivals
            rivals = [other.pose for other, _ in passages if other is not one and other.candidate is one.candidate]
            if rivals:
                query, match = one.keyframes
                one.measurements["lead"] = found.lead_over(rivals, match.pose_of(query) is not None)
        return judged

    def _promises(self, one: Hypothesis, least: float) -> bool:
        """Whether a hypothesis of scans can be so probable: it is, if no other pose fits the scans."""
        return bool(one.scans) and self._acceptance.probability(one.measurements | WITHOUT_RIVALS) >= least

    def _measure(self, hypothesis: Hypothesis) -> None:
        """Measure the pose; nothing stays of a pose that was measured before."""
        query, match = hypothesis.keyframes
        of_pose = measure(hypothesis) | {"support": self._memory.support(query, match, hypothesis.pose)}
        hypothesis.measurements = measurements_of(hypothesis.candidate) | of_pose

    def _look_elsewhere(self, one: Hypothesis, rivals: list[Array]) -> Position | None:
        """Compare with other poses; of scans in a passage, move to the best position along it, and return that."""
        theirs, ours = one.scans
        assert one.alignment is not None
        found = locate_along(theirs, ours, one.pose, _is_turned(one.pose, *one.keyframes))
        if found is None:
            one.measurements |= compare_elsewhere(theirs, ours, one.pose, one.alignment.information, rivals)
            return None
        if found.pose is not one.pose:
            one.pose, one.alignment = found.pose, inspect(theirs, ours, found.pose)
            self._measure(one)
        one.measurements["lead"] = found.lead_over([])
        return found

    @staticmethod
    def _commonplace(hypothesis: Hypothesis) -> dict[str, float]:
        """Measurements of how much the scans show that other places do not."""
        (theirs, ours), pose = hypothesis.scans, hypothesis.pose
        # in a passage all positions were compared
        repeated = repetition(theirs, ours, pose) if "rival_far" in hypothesis.measurements else np.nan
        return known_only({"beyond_walls": beyond_walls(theirs, ours, pose), "repetition": repeated})

    def _probability(self, hypothesis: Hypothesis) -> float:
        """That a hypothesis is right; where scans show bare ground alone, nothing would refute a texture seen twice."""
        found = self._acceptance.probability(hypothesis.measurements)
        scans = [self.scans[keyframe] for keyframe in hypothesis.keyframes]
        if hypothesis.scans or not all(scan.usable and scan.terrain.even for scan in scans):
            return found
        if hypothesis.measurements["spread"] < const.BARE_SPREAD:
            return 0.0
        return found / (found + const.BARE_ODDS * (1.0 - found))

    def _aligned(self, hypotheses: list[Hypothesis], before: list[Hypothesis]) -> list[Hypothesis]:
        """Each aligned and measured; of those that begin or end where another of its candidate ended, only the first.

        Args:
            hypotheses: the most promising first.
            before: those that are aligned already.
        """
        kept: list[Hypothesis] = []
        for one in hypotheses:
            ends = [other.pose for other in before + kept if other.candidate is one.candidate]
            if not any(same_pose(one.pose, end) for end in ends):
                self._align(one)
                if not any(same_pose(one.pose, end) for end in ends):
                    self._measure(one)
                    kept.append(one)
        return kept

    def _align(self, hypothesis: Hypothesis) -> None:
        query, match = hypothesis.keyframes
        scans = self.scans[match], self.scans[query]
        if hypothesis.views is not None:
            hypothesis.alignment = hypothesis.views.align(hypothesis.pose)
        else:
            hypothesis.scans, hypothesis.alignment = scans, align_scans(*scans, hypothesis.pose)
        hypothesis.pose = hypothesis.alignment.pose

    def _best(
        self, query: Keyframe, ranked: list[Offered], judged: list[Hypothesis], tested: set[int]
    ) -> list[Hypothesis]:
        """The most probable hypothesis of each candidate, decided; accepted ones first."""
        best, found = _most_probable(judged), []
        for candidate, keyframe in ranked:
            if candidate.index in best:
                found.append(best[candidate.index])
                self._decide(found[-1])
            else:
                metric = query.has_depth or keyframe.has_depth
                reason = RejectReason.NO_POSE if metric else RejectReason.NO_DEPTH
                reason = reason if candidate.index in tested else RejectReason.NOT_SELECTED
                found.append(Hypothesis.of(query, candidate, keyframe, reason=reason))
        accepted = sorted((one for one in found if one.accepted), key=lambda one: -(one.probability or 0.0))
        for one in accepted[self._settings.max_closures :]:  # closures of one keyframe are correlated
            one.reject(RejectReason.LESS_PROBABLE)
        return sorted(found, key=lambda one: not one.accepted)

    def _decide(self, hypothesis: Hypothesis) -> None:
        """Set the closure, or the reason why there is none."""
        if (objection := self._objection(hypothesis)) is not None:
            hypothesis.reject(*objection)
            return
        hypothesis.inlier_pixels = consistent_pixels(hypothesis, self._settings)
        covariance = closure_covariance(hypothesis, self._acceptance.covariances[hypothesis.kind])
        probability = hypothesis.probability or 0.0
        hypothesis.closure = LoopClosure(*hypothesis.endpoints, hypothesis.pose, covariance, probability)

    def _objection(self, hypothesis: Hypothesis) -> tuple[RejectReason, str] | None:
        """Why a hypothesis is no closure, with figures; None when it is one."""
        probability, least = hypothesis.probability or 0.0, self._settings.min_probability
        if probability < least:
            return RejectReason.IMPROBABLE, f"{probability:.2f} < {least:g}"
        if (reason := refuted(hypothesis.measurements)) is not None:
            return reason
        if strange := self._acceptance.out_of_range(hypothesis.measurements):
            return RejectReason.OUT_OF_RANGE, strange
        turn_deg = abs(np.degrees(heading(hypothesis.pose)))
        shift_m = float(np.linalg.norm(hypothesis.pose[:3, 3]))
        if 0 < self._settings.max_turn_deg < turn_deg:
            return RejectReason.TURNED, f"{turn_deg:.0f} deg > {self._settings.max_turn_deg:g}"
        if 0 < self._settings.max_shift_m < shift_m:
            return RejectReason.TOO_FAR, f"{shift_m:.1f} m > {self._settings.max_shift_m:g}"
        return None


def _most_probable(judged: list[Hypothesis]) -> dict[int, Hypothesis]:
    """Of hypotheses about each candidate, by its index, the one that decides."""
    return {one.candidate.index: one for one in sorted(judged, key=lambda one: one.probability or 0.0)}


def _is_turned(pose: Array, query: Keyframe, match: Keyframe) -> bool:
    """Whether a pose `match_T_query` is turned round to what odometry has, or where there is none, to the match."""
    expected = match.pose_of(query)
    return bool(faces_back(pose if expected is None else relative(expected, pose)))
