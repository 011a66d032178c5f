"""Outlier rejection: decide which closures shape the map.

A closure is accepted at once if it is consistent with the map and a wrong one would hardly be. Where the map is too
uncertain, closures of other places have to be consistent with it. Closures that contradict the map can overrule it,
and accepted closures of fewer places, if enough places agree: odometry may be biased. No decision is final: rejected
closures are compared again when the map moves.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, invert, logmap
from umf_ros.pose_graph.closures import (
    ClosureArrays,
    ClosureReason,
    ClosureVerdict,
    Decision,
    Endpoints,
    PlacedClosure,
    State,
)
from umf_ros.pose_graph.consistency import (
    ConsistencyGraph,
    false_alarm_probability,
    likelihood_ratio,
    squared_mahalanobis,
)
from umf_ros.pose_graph.noise_scale import NoiseScale, NoiseScaleEstimator
from umf_ros.pose_graph.odometry import Stamps, Table
from umf_ros.pose_graph.sessions import ChosenClosures, RelativePoses, Sessions

_LOOPS_PER_CLOSURE = 3
_MOST_ROUNDS = 4
# a rejected closure further than this from the moved map (m) is not compared again
_CLOSE_M = 2.0
# largest odds against a closure without support: during the drive, and at the end
_MOST_ODDS, _MOST_ODDS_AT_LAST = 0.1, 0.2
# before any verdict, one of five closures counts as wrong
_WRONG_BEFORE, _RIGHT_BEFORE = 1, 4
# wrong closures seldom come alone: of those pending at the end of drives in worlds 10200-10473 of
# `pose_graph.py` (benchmarks) 1 of 67 wrong ones was alone and 59 of 213 right ones
_WRONG_ALONE = 0.1
# nothing contradicts a wrong closure between sessions that are not joined: at the end two places have to agree, by 2.5
# nats at least (*by hand*; `aliased_sessions.py`: without, one group of wrong closures joined 4 of 40 graphs)
_WRONG_BETWEEN = 10.0
_EVEN = 0.5


class MapComparison(NamedTuple):
    """N closures compared with the map.

    Attributes:
        distances: (N,) squared Mahalanobis distances; 0 where nothing joins the endpoints.
        misfits_m: (N,) metres.
        false_alarms: (N,) probabilities that a wrong closure passes for a right one here.
        ratios: (N,) likelihood of this distance for a wrong closure over that for a right one.
        joined: (N,) whether the map joins the endpoints at all.
    """

    distances: Array
    misfits_m: Array
    false_alarms: Array
    ratios: Array
    joined: NDArray[np.bool_]


class OutlierRejection:
    """Decide about closures and keep the map solved accordingly.

    Attributes:
        placed: all closures; a row is an index of this list.
        verdicts: their latest verdicts.
        scale: of the stated noise, as estimated so far.
    """

    def __init__(self, settings: PoseGraphSettings, sessions: Sessions) -> None:
        self._settings = settings
        self._sessions = sessions
        self._arrays = ClosureArrays()
        self._consistency = ConsistencyGraph(self._arrays, settings)
        self._estimator = NoiseScaleEstimator()
        self._map: RelativePoses | None = None
        self._table = Table(state=np.empty(0, "U16"))
        self._changed: set[int] = set()
        self._revoked: set[int] = set()
        self._too_far: set[int] = set()
        self._unjoined: set[int] = set()
        self._ratios: dict[int, float] = {}
        self._brought_close: list[int] = []
        self._compared: set[int] = set()  # rows, with the map as it was last solved
        self.scale = NoiseScale()
        self.placed: list[PlacedClosure] = []
        self.verdicts: list[ClosureVerdict] = []

    def retune(self, settings: PoseGraphSettings) -> None:
        """Judge by other gates from now on."""
        self._settings = settings
        self._consistency.retune(settings)
        self._compared = set()

    def consider(self, arrived: Sequence[PlacedClosure]) -> list[ClosureVerdict]:
        """Take closures in; returns the verdicts that are new or changed.

        The map is solved once at most; closures that the moved map comes close to are compared by the next call.
        """
        rows = [self._take(placed) for placed in arrived]
        self._changed = set(rows)
        unsolved = bool(self.placed) and self._map is None  # the solver failed when they came
        if self._rescale() or unsolved or (rows and self._sessions.outgrown):
            self._solve()
            rows = list(range(len(self.placed)))
        self._decide({*rows, *self._brought_close})
        return self._verdicts()

    def resume(self, decided: Sequence[tuple[PlacedClosure, Decision]]) -> None:
        """Take closures in with the verdicts that they had, and solve the map once."""
        for placed, decision in decided:
            row = self._take(placed)
            self._table["state"][row] = decision[0]
            self.verdicts[row] = ClosureVerdict(placed.closure, *decision)
            if decision[1] is ClosureReason.BY_HAND:
                self._revoked.add(row)
            if decision[1] is ClosureReason.TOO_FAR:
                self._too_far.add(row)
        self._rescale()
        self._solve()
        open_rows = np.flatnonzero(~self._in_state(State.ACCEPTED)).tolist()
        found = self._compare(open_rows)
        for row, joined, ratio in zip(open_rows, found.joined, found.ratios, strict=True):
            self._ratios[row] = float(ratio) if self._table["state"][row] == State.PENDING else 1.0
            if not joined:
                self._unjoined.add(row)

    def settle(self) -> list[ClosureVerdict]:
        """Decide about pending closures and bring the map to its exact optimum; returns changed verdicts."""
        self._changed = set()
        if self._map is None:
            return []
        self._decide_all()
        for _ in self.placed:
            if not self._accept(dict.fromkeys(self._unopposed(at_last=True), ClosureReason.UNOPPOSED)):
                break
            self._decide_all()
        if self._revoke_outvoted():
            self._decide_all()
        self._solve()
        self._sessions.refine(self.accepted, self.scale)
        return self._verdicts()

    def renew(self) -> None:
        """Solve again after the odometry's past changed; no verdict changes by that."""
        self._arrays.renew(self._sessions.chains)
        if self._map is not None:
            self._solve()

    def revoke(self, row: int) -> list[ClosureVerdict]:
        """Take a closure out for good."""
        self._changed = set()
        self._revoked.add(row)
        was_accepted = self._table["state"][row] == State.ACCEPTED
        self._note(row, State.REJECTED, ClosureReason.BY_HAND)
        if was_accepted:
            self._solve()
        return self._verdicts()

    @property
    def revoked(self) -> list[LoopClosure]:
        """Closures that were taken out for good."""
        return [self.placed[row].closure for row in sorted(self._revoked)]

    @property
    def accepted(self) -> ChosenClosures:
        """Closures that shape the map."""
        return ChosenClosures.of(self._arrays, np.flatnonzero(self._table["state"] == State.ACCEPTED).tolist())

    def endpoints_in(self, session: int) -> Stamps:
        """Stamps of all endpoints of closures in a session."""
        both = (self._arrays.match, self._arrays.query)
        return np.concatenate([endpoints["stamp"][endpoints["session"] == session] for endpoints in both])

    def endpoint_positions(self) -> Array:
        """(N, 2, 3) map positions of the match and query endpoints of all closures."""
        both = (self._arrays.match, self._arrays.query)
        rows = np.arange(len(self.placed))
        return np.stack([self._poses(endpoints, rows)[:, :3, 3] for endpoints in both], axis=1)

    def _decide_all(self) -> None:
        rows: Iterable[int] = range(len(self.placed))
        for _ in range(_MOST_ROUNDS):
            if not self._decide(rows):
                return
            rows = self._brought_close

    def _decide(self, rows: Iterable[int]) -> bool:
        """Decide about closures and solve the map with those that are accepted; False without any."""
        rows = sorted(rows)
        agreed = self._gate(rows)
        supported = [member for found in self._supported_sets(rows, State.PENDING) for member in found]
        supported += self._overrule(rows)
        reasons = dict.fromkeys(supported, ClosureReason.SUPPORTED) | dict.fromkeys(agreed, ClosureReason.AGREES)
        # only where no other closure is accepted: the map that those move may contradict these
        if not reasons:
            reasons = dict.fromkeys(self._unopposed(), ClosureReason.UNOPPOSED)
        self._brought_close = self._worth_another_look() if self._accept(reasons) else []
        return bool(reasons)

    def _take(self, placed: PlacedClosure) -> int:
        row = len(self.placed)
        self.placed.append(placed)
        self.verdicts.append(ClosureVerdict(placed.closure, State.PENDING, ClosureReason.UNSURE))
        self._table.extend(state=[State.PENDING])
        self._arrays.append(self._sessions.chains, placed)
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
        return True

    def _gate(self, rows: Iterable[int]) -> list[int]:
        """Compare closures with the map; returns those whose consistency with it suffices."""
        accepted = self._table["state"] == State.ACCEPTED
        open_rows = [row for row in rows if not accepted[row] and row not in self._revoked]
        if not open_rows:
            return []
        found = self._compare(open_rows)
        self._compared.update(open_rows)
        self._unjoined -= set(open_rows)
        self._unjoined |= {row for row, joined in zip(open_rows, found.joined, strict=True) if not joined}
        numbers = zip(open_rows, *(column.tolist() for column in found[:4]), strict=True)
        return [row for row, *rest in numbers if self._agrees(row, *rest)]

    def _compare(self, rows: Sequence[int]) -> MapComparison:
        """Compare closures with the map; a closure between endpoints that nothing joins agrees with it."""
        assert self._map is not None
        at = np.array(rows, np.int64)
        bounds = self._map.bounds(self._arrays.match.samples(at), self._arrays.query.samples(at))
        covariances = bounds.covariances + self.scale.closures**2 * self._arrays["covariance"][at]
        misfits, joined = self._misfits(at), np.isfinite(bounds.lengths)
        distances, metres = np.zeros((2, len(at)))
        false_alarms, ratios = np.ones((2, len(at)))
        if joined.any():
            distances[joined] = squared_mahalanobis(logmap(misfits[joined]), covariances[joined])
            metres[joined] = np.linalg.norm(misfits[joined, :3, 3], axis=1)
            false_alarms[joined] = false_alarm_probability(covariances[joined], self._settings)
            ratios[joined] = likelihood_ratio(false_alarms[joined], distances[joined], self._settings)
        return MapComparison(distances, metres, false_alarms, ratios, joined)

    def _misfits(self, rows: NDArray[np.int64]) -> Array:
        """(N, 4, 4) poses of the queries of closures by the map, in the frames where the closures put them."""
        relative = invert(self._poses(self._arrays.match, rows)) @ self._poses(self._arrays.query, rows)
        return invert(self._arrays["pose"][rows]) @ relative

    def _poses(self, endpoints: Endpoints, rows: NDArray[np.int64]) -> Array:
        """(N, 4, 4) `map_T_body` at one endpoint of closures."""
        sessions, stamps, points = endpoints.samples(rows)
        poses = np.zeros((len(sessions), 4, 4))
        for session in np.unique(sessions):
            of_session = sessions == session
            poses[of_session] = self._sessions.at(int(session), stamps[of_session], points.of(of_session))
        return poses

    def _agrees(self, row: int, distance: float, misfit_m: float, false_alarm: float, ratio: float) -> bool:
        """Note how a closure compares with the map; returns whether its consistency with it suffices."""
        self._too_far.discard(row)
        self._ratios[row] = 1.0
        if self._settings.reject_outliers and distance > self._settings.gate_chi2:
            self._note(row, State.REJECTED, ClosureReason.CONTRADICTS, distance, misfit_m)
            return False
        if self._settings.max_correction_m and misfit_m > self._settings.max_correction_m:
            self._too_far.add(row)
            self._note(row, State.REJECTED, ClosureReason.TOO_FAR, distance, misfit_m)
            return False
        self._note(row, State.PENDING, ClosureReason.UNSURE, distance, misfit_m)
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
                    self._note(row, State.REJECTED, ClosureReason.OUTVOTED)
                return found
        return []

    def _revoke_outvoted(self) -> bool:
        """Revoke what was accepted too early: more places contradict it, and so does the map without it."""
        accepted = self._in_state(State.ACCEPTED)
        outvoted = [row for row in np.flatnonzero(accepted).tolist() if self._is_outvoted(row, accepted)]
        if not outvoted:
            return False
        self._solve(without=outvoted)
        distances = self._compare(outvoted).distances
        wrong = [row for row, far in zip(outvoted, distances > self._settings.gate_chi2, strict=True) if far]
        for row in wrong:
            self._note(row, State.REJECTED, ClosureReason.OUTVOTED)
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

    def _unopposed(self, at_last: bool = False) -> list[int]:
        """Pending closures of the best fitting place among those that have waited long enough.

        Neither the map nor another closure contradicts them. One place at a time: the map that the first one moves may
        contradict the next. The closures of a place are accepted together, by their median odds, so that one of a wrong
        set is not accepted by chance. The decision at the end does not wait, and counts how many closures were wrong
        and the evidence of other places.
        """
        patience_m = 0.0 if at_last else self._settings.patience_m
        waiting = np.flatnonzero(self._in_state(State.PENDING) & (self._waited() >= patience_m)).tolist()
        companions = ~self._in_state(State.ACCEPTED)
        companions[list(self._revoked)] = False
        others = self._consistency.companions(waiting, companions)
        places = [[row, *known] for row, known in zip(waiting, others, strict=True)]
        self._gate(sorted({member for place in places for member in place} - self._compared))
        against = self._credible()
        best: list[int] = []
        most_odds, waited = _MOST_ODDS_AT_LAST if at_last else _MOST_ODDS, set(waiting)
        for place in places:
            odds = self._odds_against(place, at_last)
            if odds.min() > most_odds:
                continue
            usual = [row for row, odd in zip(place, odds, strict=True) if row in waited and odd <= most_odds]
            usual = [row for row in usual if not self._consistency.opponents(row, against)]
            if usual and np.median(odds) <= most_odds:
                best, most_odds = usual, float(np.median(odds))
        return best

    def _odds_against(self, place: list[int], at_last: bool) -> Array:
        """(N,) odds that closures of one place are wrong, as far as the map and, at last, all else tell."""
        odds = np.array([self._ratios[row] for row in place])
        if not at_last:
            return odds
        rejected, accepted = (int((self._table["state"] == state).sum()) for state in (State.REJECTED, State.ACCEPTED))
        prior = (_WRONG_BEFORE + rejected) / (_RIGHT_BEFORE + accepted)
        _, evidence = self._consistency.consistency_set(place[0], self._in_state(State.PENDING))
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

    def _accept(self, reasons: dict[int, ClosureReason]) -> bool:
        for row, reason in reasons.items():
            verdict = self.verdicts[row]
            self._note(row, State.ACCEPTED, reason, verdict.residual**2, verdict.residual_m)
        if reasons:
            self._solve()
        return bool(reasons)

    def _solve(self, without: Sequence[int] = ()) -> None:
        rows = [row for row in np.flatnonzero(self._table["state"] == State.ACCEPTED).tolist() if row not in without]
        self._sessions.solve(ChosenClosures.of(self._arrays, rows), self.scale)
        self._map, self._compared = RelativePoses(self._sessions, self.scale), set()

    def _worth_another_look(self) -> list[int]:
        """Closures not accepted that the moved map comes close to."""
        rows = np.flatnonzero(~self._in_state(State.ACCEPTED))
        near: list[int] = rows[np.linalg.norm(self._misfits(rows)[:, :3, 3], axis=1) < _CLOSE_M].tolist()
        return near

    def _note(
        self,
        row: int,
        state: State,
        reason: ClosureReason,
        squared: float = float("nan"),
        metres: float = float("nan"),
    ) -> None:
        if self._table["state"][row] != state:
            self._changed.add(row)
        self._table["state"][row] = state
        self.verdicts[row] = ClosureVerdict(self.placed[row].closure, state, reason, float(np.sqrt(squared)), metres)

    def _verdicts(self) -> list[ClosureVerdict]:
        return [self.verdicts[row] for row in sorted(self._changed)]
