"""Outlier rejection: which closures shape the map.

A closure that is consistent with the map where a wrong one would have shown is accepted at once. One
that the map cannot judge needs others of other places that are consistent with it. So does one that
contradicts the map: enough places overrule the map, whose odometry may be wrong in one direction, and
accepted closures of fewer places that are inconsistent with them. Nothing is decided for good: when
the map moves, what was rejected is looked at again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.pose_graph.closures import ClosureArrays, ClosureVerdict, State, TrackedClosure
from umf_ros.pose_graph.consistency import ConsistencyGraph
from umf_ros.pose_graph.map_comparer import MapComparer
from umf_ros.pose_graph.noise_scale import NoiseScale, NoiseScaleEstimator
from umf_ros.pose_graph.odometry import Stamps, Table
from umf_ros.pose_graph.sessions import Sessions

_LOOPS_PER_CLOSURE = 3
_MOST_ROUNDS = 4
# a closure this far from the map (m) is not looked at again before the map moves
_CLOSE_M = 2.0
# the odds against a closure that nobody supports are these at most: on the way, and when nothing more will come
_MOST_ODDS, _MOST_ODDS_AT_LAST = 0.1, 0.2
# before any verdict, one of five closures is taken for wrong
_WRONG_BEFORE, _RIGHT_BEFORE = 1, 4
# what looks alike does so for a while, so wrong closures seldom come alone: of those left undecided at the end of
# drives in worlds 10200-10473 of `pose_graph.py` (benchmarks) 1 of 67 wrong ones was alone and 59 of 213 right ones
_WRONG_ALONE = 0.1
# a wrong closure between sessions that nothing joins is contradicted by nothing: at last two places have to agree, 2.5
# nats at least (*by hand*; `aliased_sessions.py`: without, one group of wrong closures joined 4 of 40 graphs)
_WRONG_BETWEEN = 10.0
_EVEN = 0.5
_AGREES = "agrees with the map"
_SUPPORTED = "supported by other places"
_UNOPPOSED = "nothing speaks against it"
_UNSURE = "needs support from another place"
_CONTRADICTS = "contradicts the map"
_OUTVOTED = "revoked: more places contradict it"
_BY_HAND = "revoked by hand"


class OutlierRejection:
    """Decides about closures and keeps the map solved accordingly.

    Attributes:
        closures: all closures with their latest verdicts; a row is a number in this list.
        scale: of the stated noise, as estimated so far.
    """

    def __init__(self, settings: PoseGraphSettings, sessions: Sessions) -> None:
        self._settings = settings
        self._sessions = sessions
        self._arrays = ClosureArrays()
        self._consistency = ConsistencyGraph(self._arrays, settings)
        self._estimator = NoiseScaleEstimator()
        self._comparer = MapComparer(self._arrays, sessions, settings)
        self._solved: set[int] = set()
        self._table = Table(state=np.empty(0, "U16"))
        self._changed: set[int] = set()
        self._revoked: set[int] = set()
        self._too_far: set[int] = set()
        self._unjoined: set[int] = set()
        self._ratios: dict[int, float] = {}
        self._brought_close: list[int] = []
        self.scale = NoiseScale()
        self.closures: list[TrackedClosure] = []

    def retune(self, settings: PoseGraphSettings) -> None:
        """Judge by other gates from now on."""
        self._settings = settings
        self._consistency.retune(settings)
        self._comparer.retune(settings)

    def consider(self, arrived: list[TrackedClosure]) -> list[ClosureVerdict]:
        """Take closures in; returns the verdicts that are new or changed.

        The map is solved once at most: what the moved map comes close to is looked at with the next call.
        """
        rows = [self._take(tracked) for tracked in arrived]
        self._changed = set(rows)
        unsolved = bool(self.closures) and not self._comparer.has_map  # the solver failed when they came
        if self._rescale() or unsolved or (rows and self._sessions.outgrown):
            self._solve()
            rows = list(range(len(self.closures)))
        self._decide({*rows, *self._brought_close})
        return self._verdicts()

    def resume(self, decided: list[TrackedClosure]) -> list[ClosureVerdict]:
        """Take closures in with the verdicts that they have, and solve the map once; nothing is decided anew."""
        for tracked in decided:
            row = self._take(tracked)
            if tracked.verdict.reason == _BY_HAND:
                self._revoked.add(row)
        self._rescale()
        self._solve()
        open_rows = [row for row, tracked in enumerate(self.closures) if not tracked.accepted]
        if open_rows:
            self._look_again(open_rows)
        return []

    def settle(self) -> list[ClosureVerdict]:
        """Decide what can wait no longer and bring the map to its exact optimum; returns changed verdicts."""
        self._changed = set()
        if not self._comparer.has_map:
            return []
        self._comparer.forget()  # the last word is about the map as it is
        self._decide_all()
        for _ in self.closures:
            if not self._accept(dict.fromkeys(self._unopposed(last_word=True), _UNOPPOSED)):
                break
            self._decide_all()
        if self._revoke_outvoted():
            self._decide_all()
        self._solve()
        self._sessions.refine(self.accepted, self.scale)
        return self._verdicts()

    def renew(self) -> list[ClosureVerdict]:
        """Solve again after the odometry's past changed; no verdict changes by that."""
        self._arrays.renew(self._sessions.chains)
        self._comparer.forget()
        if self._comparer.has_map:
            self._solve()
        return []

    def revoke(self, row: int) -> list[ClosureVerdict]:
        """Take a closure out for good."""
        self._changed = set()
        self._revoked.add(row)
        was_accepted = self.closures[row].accepted
        self._note(row, State.REJECTED, _BY_HAND)
        if was_accepted:
            self._solve()
        return self._verdicts()

    @property
    def revoked(self) -> list[LoopClosure]:
        """Closures that were taken out for good."""
        return [self.closures[row].closure for row in sorted(self._revoked)]

    @property
    def accepted(self) -> list[TrackedClosure]:
        """Closures that shape the map."""
        return [closure for closure in self.closures if closure.accepted]

    def endpoints_in(self, session: int) -> Stamps:
        """Stamps of all endpoints of closures in a session."""
        both = (self._arrays.match, self._arrays.query)
        return np.concatenate([endpoints["stamp"][endpoints["session"] == session] for endpoints in both])

    def endpoint_positions(self) -> Array:
        """(N, 2, 3) map positions of the match and query endpoints of all closures."""
        both = (self._arrays.match, self._arrays.query)
        return np.stack([self._comparer.poses(endpoints, slice(None))[:, :3, 3] for endpoints in both], axis=1)

    def _decide_all(self) -> None:
        rows: Iterable[int] = range(len(self.closures))
        for _ in range(_MOST_ROUNDS):
            if not self._decide(rows):
                return
            rows = self._brought_close

    def _decide(self, rows: Iterable[int]) -> bool:
        """Look at closures and solve the map for those that are accepted; False without any."""
        rows = sorted(rows)
        agreed = self._gate(rows)
        supported = [member for found in self._supported_sets(rows, State.UNDECIDED) for member in found]
        supported += self._overrule(rows)
        reasons = dict.fromkeys(supported, _SUPPORTED) | dict.fromkeys(agreed, _AGREES)
        # only where nothing else is accepted: the map it moves may well speak against them
        if not reasons:
            reasons = dict.fromkeys(self._unopposed(), _UNOPPOSED)
        self._brought_close = self._worth_another_look() if self._accept(reasons) else []
        return bool(reasons)

    def _take(self, tracked: TrackedClosure) -> int:
        row = len(self.closures)
        self.closures.append(tracked)
        self._table.extend(state=[tracked.verdict.state])
        self._arrays.append(self._sessions.chains, tracked)
        self._comparer.append()
        loops = self._consistency.add(row, self.scale)
        self._estimator.add(loops[-_LOOPS_PER_CLOSURE:], self._consistency.place_of[row])
        return row

    def _rescale(self) -> bool:
        """Adopt a new scale of the covariances; True when it changed."""
        scale = self._estimator.scale if self._settings.reject_outliers else self.scale
        if scale == self.scale:
            return False
        self.scale = scale
        self._consistency.renew(scale)
        self._comparer.forget()
        return True

    def _gate(self, rows: Iterable[int]) -> list[int]:
        """Compare closures with the map; returns those whose consistency with it suffices."""
        open_rows = [row for row in rows if not self.closures[row].accepted and row not in self._revoked]
        if not open_rows:
            return []
        found = self._comparer.compare(open_rows)
        numbers = zip(open_rows, *(column.tolist() for column in found[:4]), strict=True)
        self._unjoined -= set(open_rows)
        self._unjoined |= {row for row, joined in zip(open_rows, found.joined, strict=True) if not joined}
        agreed = [row for row, *rest in numbers if self._agrees(row, *rest)]
        self._comparer.note(open_rows, found)
        return agreed

    def _look_again(self, rows: list[int]) -> None:
        """What the map says about closures whose verdicts stay."""
        found = self._comparer.compare(rows)
        self._comparer.note(rows, found)
        for row, joined, ratio, misfit_m in zip(rows, found.joined, found.ratios, found.misfits_m, strict=True):
            is_rejected = self.closures[row].verdict.state is State.REJECTED
            self._ratios[row] = 1.0 if is_rejected else float(ratio)
            if not joined:
                self._unjoined.add(row)
            if is_rejected and 0 < self._settings.max_correction_m < misfit_m:
                self._too_far.add(row)

    def _agrees(self, row: int, distance: float, misfit_m: float, false_alarm: float, ratio: float) -> bool:
        """Note what the map says about a closure; returns whether its consistency with it suffices."""
        self._too_far.discard(row)
        self._ratios[row] = 1.0
        if self._settings.reject_outliers and distance > self._settings.gate_chi2:
            self._note(row, State.REJECTED, _CONTRADICTS, distance, misfit_m)
            return False
        if self._settings.max_correction_m and misfit_m > self._settings.max_correction_m:
            self._too_far.add(row)
            self._note(row, State.REJECTED, f"moves the pose by {misfit_m:.1f} m", distance, misfit_m)
            return False
        self._note(row, State.UNDECIDED, _UNSURE, distance, misfit_m)
        self._ratios[row] = ratio
        return false_alarm <= self._settings.max_chance or not self._settings.reject_outliers

    def _supported_sets(self, rows: Iterable[int], state: State) -> list[list[int]]:
        """Consistency sets among the closures of one state, each with one of `rows`, that no chance explains."""
        members = self._in_state(state)
        members[list(self._too_far)] = False
        sets: list[list[int]] = []
        for row in rows:
            if members[row] and not any(row in found for found in sets):
                found, evidence = self._consistency.consistency_set(row, members)
                # that all are consistent with the map as well is one more thing that chance has to explain
                evidence -= float(np.log(max(self._ratios[member] for member in found)))
                if evidence >= self._settings.min_support:
                    sets.append(found)
        return sets

    def _overrule(self, rows: Iterable[int]) -> list[int]:
        """A set that the map contradicts, of more places than what it is inconsistent with, which is revoked."""
        accepted = self._in_state(State.ACCEPTED)
        for found in self._supported_sets(rows, State.REJECTED):
            losers = sorted({loser for row in found for loser in self._consistency.opponents(row, accepted)})
            if self._consistency.count_places(losers) < self._consistency.count_places(found):
                for row in losers:
                    self._note(row, State.REJECTED, _OUTVOTED)
                return found
        return []

    def _revoke_outvoted(self) -> bool:
        """Revoke what was accepted too early: more places contradict it, and so does the map without it."""
        accepted = self._in_state(State.ACCEPTED)
        outvoted = [row for row in np.flatnonzero(accepted).tolist() if self._is_outvoted(row, accepted)]
        if not outvoted:
            return False
        self._solve(without=outvoted)
        distances = self._comparer.compare(outvoted).distances
        wrong = [row for row, far in zip(outvoted, distances > self._settings.gate_chi2, strict=True) if far]
        for row in wrong:
            self._note(row, State.REJECTED, _OUTVOTED)
        self._solve()
        return bool(wrong)

    def _is_outvoted(self, row: int, members: NDArray[np.bool_]) -> bool:
        """Whether members of more places contradict a closure than support it, and not enough support it."""
        opponents = self._consistency.opponents(row, members)
        if not opponents:
            return False
        found, evidence = self._consistency.consistency_set(row, members)
        more = self._consistency.count_places(opponents) > self._consistency.count_places(found)
        # where enough supports it, the odometry between is wrong, not the closure
        return more and evidence < self._settings.min_support

    def _unopposed(self, last_word: bool = False) -> list[int]:
        """Undecided closures of the place that fits best of those that have waited long enough.

        Nothing speaks against them, the map included. One place at a time: the map that the first one
        moves may speak against the next. A place's closures stand or fall together, so that one of a
        wrong set does not pass for the luck of its noise. The last word waits for nothing, and takes
        into account how many closures were wrong and what other places say, though it did not suffice.
        """
        patience_m = 0.0 if last_word else self._settings.patience_m
        waiting = np.flatnonzero(self._in_state(State.UNDECIDED) & (self._waited() >= patience_m)).tolist()
        companions = ~self._in_state(State.ACCEPTED)
        companions[list(self._revoked)] = False
        others = self._consistency.companions(waiting, companions)
        places = [[row, *known] for row, known in zip(waiting, others, strict=True)]
        self._gate(
            self._comparer.outdated(np.array(sorted({member for place in places for member in place}), np.int64))
        )
        against = self._credible()
        best: list[int] = []
        most_odds, waited = _MOST_ODDS_AT_LAST if last_word else _MOST_ODDS, set(waiting)
        for place in places:
            odds = self._odds_against(place, last_word)
            if odds.min() > most_odds:
                continue
            usual = [row for row, odd in zip(place, odds, strict=True) if row in waited and odd <= most_odds]
            usual = [row for row in usual if not self._consistency.opponents(row, against)]
            if usual and np.median(odds) <= most_odds:
                best, most_odds = usual, float(np.median(odds))
        return best

    def _odds_against(self, place: list[int], last_word: bool) -> Array:
        """(N,) odds that closures of one place are wrong, as far as the map and, at last, all else tell."""
        odds = np.array([self._ratios[row] for row in place])
        if not last_word:
            return odds
        rejected, accepted = (int((self._table["state"] == state).sum()) for state in (State.REJECTED, State.ACCEPTED))
        prior = (_WRONG_BEFORE + rejected) / (_RIGHT_BEFORE + accepted)
        _, evidence = self._consistency.consistency_set(place[0], self._in_state(State.UNDECIDED))
        if place[0] in self._unjoined:
            return odds * max(prior, _WRONG_BEFORE / _RIGHT_BEFORE) * np.exp(-evidence) * _WRONG_BETWEEN
        return odds * prior * np.exp(-evidence) * (_WRONG_ALONE if len(place) == 1 else 1.0)

    def _credible(self) -> NDArray[np.bool_]:
        """Closures that may speak against others: those the map itself finds wrong rather than right may not."""
        credible = self._in_state(State.ACCEPTED)
        credible[[row for row, ratio in self._ratios.items() if ratio < _EVEN]] = True
        return credible

    def _in_state(self, state: State) -> NDArray[np.bool_]:
        """Which closures have a verdict, except those revoked for good."""
        members = self._table["state"] == state
        members[list(self._revoked)] = False
        return members

    def _waited(self) -> Array:
        """(N,) metres driven since each closure's query; infinite where that was in another session than the newest."""
        travel, session = self._arrays.query["travel"], self._arrays.query["session"]
        if not len(travel):
            return np.empty(0)
        return np.where(session == session[-1], travel[-1] - travel, np.inf)

    def _accept(self, reasons: dict[int, str]) -> bool:
        for row, reason in reasons.items():
            verdict = self.closures[row].verdict
            self._note(row, State.ACCEPTED, reason, verdict.residual**2, verdict.residual_m)
        if reasons:
            self._solve()
        return bool(reasons)

    def _solve(self, without: Sequence[int] = ()) -> None:
        rows = {row for row, closure in enumerate(self.closures) if closure.accepted} - set(without)
        self._sessions.solve([self.closures[row] for row in sorted(rows)], self.scale)
        grown = np.array(sorted(rows - self._solved), np.int64) if rows >= self._solved else None
        self._comparer.take_map(self.scale, grown, np.flatnonzero(~self._in_state(State.ACCEPTED)))
        self._solved = rows

    def _worth_another_look(self) -> list[int]:
        """Closures not accepted that the moved map now comes close to."""
        return self._comparer.outdated(np.flatnonzero(~self._in_state(State.ACCEPTED)), _CLOSE_M)

    def _note(
        self, row: int, state: State, reason: str, squared: float = float("nan"), metres: float = float("nan")
    ) -> None:
        before = self.closures[row].verdict.state
        self._table["state"][row] = state
        self._comparer.forget([row])
        self.closures[row].decide(state, reason, float(np.sqrt(squared)), metres)
        if before is not state:
            self._changed.add(row)

    def _verdicts(self) -> list[ClosureVerdict]:
        return [self.closures[row].verdict for row in sorted(self._changed)]
