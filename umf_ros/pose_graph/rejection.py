"""Outlier rejection: decide which closures the map is solved with.

A closure is accepted at once if it is consistent with the map and a wrong one is unlikely to be. Where the map is too
uncertain, closures of other places have to be consistent with it. Closures that contradict the map can overrule it,
and accepted closures of fewer places, if enough places agree: odometry may be biased. No decision is final: rejected
closures are compared again when the map moves.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError
from umf_ros.core.geometry import Array, evenly, invert, logmap
from umf_ros.pose_graph.closures import (
    ClosureReason,
    Closures,
    ClosureVerdict,
    Decision,
    PlacedClosure,
    State,
    as_closures,
)
from umf_ros.pose_graph.consistency import (
    ConsistencyGraph,
    NoiseScale,
    NoiseScaleEstimator,
    false_alarm_ratio,
    likelihood_ratio,
    squared_mahalanobis,
)
from umf_ros.pose_graph.odometry import Rows
from umf_ros.pose_graph.sessions import RelativeCovariances, Sessions

_LOOPS_PER_CLOSURE = 3
_MOST_ROUNDS = 4
# a rejected closure further than this from the moved map (m) is not compared again
_CLOSE_M = 2.0
# closures that are compared again, or accepted as unopposed, in one step: its cost does not grow with those that wait
_MOST_WAITING = 100
# largest odds against a closure without support: during the drive, and at the end; .1 during the drive accepts a group
# of aliases in 2 of 42 cells of `pose_graph.py` with seed 25501, .03 none, and both accept all right closures
_MOST_ODDS, _MOST_ODDS_AT_LAST = 0.03, 0.2
# prior: the front-end's probability, which counts as much as five closures; where it is unknown four of five are right
_COUNTED, _USUALLY_RIGHT = 5, 0.8
# wrong closures are seldom single: of those pending at the end of drives in worlds 10200-10473 of
# `pose_graph.py` (benchmarks) 1 of 67 wrong ones was single and 59 of 213 right ones
_WRONG_ALONE = 0.1
# by hand: closures that are up to this many times less likely by the map outweigh those of another place if they are as
# many; `pose_graph.py --short 20 --seed 10200`: without, four wrong ones of 337 right and as many wrong are accepted
_RIVAL_RATIO = 10.0
# nothing contradicts a wrong closure between sessions that are not joined: at the end two places have to agree by 2.5
# nats at least (*by hand*; `aliased_sessions.py`: without, one group of wrong closures joined 4 of 40 graphs)
_WRONG_BETWEEN = 10.0
_BY_HAND = {State.ACCEPTED: ClosureReason.ACCEPTED_BY_HAND, State.REJECTED: ClosureReason.BY_HAND}


class OutlierRejection:
    """Decisions about closures, and the map solved accordingly.

    Attributes:
        settings: of the pose graph.
        placed: all closures; a row is an index of this list.
        verdicts: their latest verdicts.
    """

    def __init__(self, settings: PoseGraphSettings, sessions: Sessions) -> None:
        self.settings = settings
        self.placed: list[PlacedClosure] = []
        self.verdicts: list[ClosureVerdict] = []
        self._sessions = sessions
        self._consistency = ConsistencyGraph(settings)
        self._estimator = NoiseScaleEstimator()
        self._map: RelativeCovariances | None = None
        self._is_rough = self._is_outdated = False  # outdated: without some accepted closures that agree with it
        self._ratios: list[float] = []  # likelihood of how closures fit the map if wrong over that if right
        self._joined: list[bool] = []  # whether the map joins both endpoints, by more than odometry across a silence
        self._again: set[int] = set()  # closures to compare again with the moved map

    @property
    def scale(self) -> NoiseScale:
        """Scale of the stated noise, as estimated so far."""
        return self._consistency.scale

    @property
    def closures(self) -> Closures:
        """(N,) all closures."""
        return self._consistency.closures

    @property
    def accepted(self) -> Closures:
        """(M,) accepted closures."""
        return self.closures[self._of(State.ACCEPTED)]

    @property
    def by_hand(self) -> list[int]:
        """Closures that a person decided about."""
        return [row for row, verdict in enumerate(self.verdicts) if verdict.reason in _BY_HAND.values()]

    @property
    def _revoked(self) -> NDArray[np.bool_]:
        return self._of(ClosureReason.BY_HAND)

    def retune(self, settings: PoseGraphSettings) -> None:
        """Use other gates from now on."""
        self.settings = self._consistency.settings = settings

    def consider(self, arrived: Sequence[PlacedClosure]) -> list[ClosureVerdict]:
        """Add closures; return the verdicts that are new or changed.

        The map is solved twice at most, roughly, and not at all if every closure agrees with it. Closures near the
        moved map are compared by the next calls, the newest first: the cost does not grow with their number.
        """
        before = list(self.verdicts)
        rows = [self._take(placed) for placed in arrived]
        unsolved = bool(self.placed) and self._map is None  # the solver failed when they came
        begun = set(self._sessions.begun) - set(self._sessions.vertices["session"].tolist())
        widened = self._map is not None and self._estimator.widest > self._map.widest
        if self._rescale() or unsolved or widened or (rows and begun):
            self.solve(rough=True)
            self._again = set(range(len(self.placed)))
        self._decide({*rows, *sorted(self._again)[-_MOST_WAITING:]})
        return self._changed_since(before)

    def refine(self) -> None:
        """Solve a map exactly that was solved roughly, or without the closures that agreed with it."""
        if self._is_rough:
            self.solve()

    def resume(self, decided: Sequence[tuple[PlacedClosure, Decision]]) -> None:
        """Add closures with their earlier verdicts, and solve the map once, to its optimum."""
        for placed, decision in decided:
            self.verdicts[self._take(placed)] = ClosureVerdict(placed.closure, *decision)
        self._rescale()
        self.solve()
        rows = np.flatnonzero(~self._of(State.ACCEPTED))
        for row, joined, ratio in zip(rows.tolist(), *self._compare(rows)[2:4], strict=True):
            is_pending = self.verdicts[row].state is State.PENDING
            self._joined[row], self._ratios[row] = joined, ratio if is_pending else 1.0

    def settle(self) -> list[ClosureVerdict]:
        """Decide about pending closures; return changed verdicts."""
        if self._map is None:
            return []
        before = list(self.verdicts)
        self._decide_all()
        for _ in self.placed:
            if not self._accept(dict.fromkeys(self._unopposed(at_last=True), ClosureReason.UNOPPOSED)):
                break
            self._decide_all()
        if self._revoke_outvoted():
            self._decide_all()
        self.solve()
        return self._changed_since(before)

    def renew(self) -> None:
        """Solve again after the odometry's past changed; verdicts stay."""
        for end in (self.closures["match"], self.closures["query"]):
            for session in np.unique(end["session"]):
                rows = end["session"] == session
                end[rows] = self._sessions.chains[session].at(end["stamp"][rows])
        if self._map is not None:
            self.solve()

    def decide_by_hand(self, row: int, state: State) -> list[ClosureVerdict]:
        """Accept or reject a closure whatever the evidence; pending leaves it to the evidence again.

        Raises:
            GraphError: the map cannot be solved so; then nothing has changed.
        """
        before = list(self.verdicts)
        reason = _BY_HAND.get(state, ClosureReason.UNSURE)
        self.verdicts[row] = ClosureVerdict(self.placed[row].closure, state, reason)
        if State.ACCEPTED in (before[row].state, state):
            try:
                self.solve()
            except GraphError:
                self.verdicts = before
                raise
        if state is State.PENDING and self._map is not None:
            self._decide([row])
        return self._changed_since(before)

    def _decide_all(self) -> None:
        rows: Iterable[int] = range(len(self.placed))
        for _ in range(_MOST_ROUNDS):
            if not self._decide(rows):
                return
            if self._is_outdated:
                self.solve(rough=True)
            rows = set(self._again)

    def _decide(self, rows: Iterable[int]) -> bool:
        """Decide about closures and solve the map with the accepted ones; return false without any.

        Closures that agree with the map leave it as it is: its bounds hold without them, only wider. It is solved with
        them once another closure does not agree with it, or contradicts one of them.
        """
        rows = sorted(rows)
        self._again.difference_update(rows)
        agreed, accepted = self._agreeing(rows), self._of(State.ACCEPTED)
        opposed = any(self._consistency.opponents(row, accepted) for row in agreed)
        if self._is_outdated and (opposed or len(agreed) < (~accepted & ~self._revoked)[rows].sum()):
            self.solve(rough=True)
            agreed = self._agreeing(rows)
        supported = [member for found in self._supported_sets(rows, self._of(State.PENDING)) for member in found]
        supported += self._overrule(rows)
        reasons = dict.fromkeys(supported, ClosureReason.SUPPORTED) | dict.fromkeys(agreed, ClosureReason.AGREES)
        # only without other accepted closures: the map moved by those may contradict these
        if not reasons:
            reasons = dict.fromkeys(self._unopposed(), ClosureReason.UNOPPOSED)
        return self._accept(reasons)

    def _agreeing(self, rows: Iterable[int]) -> list[int]:
        """Compare closures with the map; returns those whose consistency with it suffices, and that are unrivalled."""
        agreed = self._gate(rows)
        if not self.settings.reject_outliers:
            return agreed
        pending = self._of(State.PENDING) & np.array(self._joined, bool)
        places = ([row, *self._consistency.companions(row, pending)] for row in agreed)
        return [place[0] for place in places if not self._is_outnumbered(place[:1], place, pending)]

    def _take(self, placed: PlacedClosure) -> int:
        row = len(self.placed)
        loops = self._consistency.add(as_closures(placed, row, self._sessions.chains))
        spread = loops[evenly(len(loops), _LOOPS_PER_CLOSURE)]
        self._estimator.add(loops[-_LOOPS_PER_CLOSURE:], spread, self._consistency.place_of[row])
        self.placed.append(placed)
        self.verdicts.append(ClosureVerdict(placed.closure, State.PENDING, ClosureReason.UNSURE))
        self._ratios.append(1.0)
        self._joined.append(True)
        return row

    def _rescale(self) -> bool:
        """Update the scale of the covariances; return whether it changed."""
        scale = self._estimator.scale if self.settings.reject_outliers else self.scale
        if scale == self.scale:
            return False
        self._consistency.compare_all(scale)
        return True

    def _gate(self, rows: Iterable[int]) -> list[int]:
        """Compare closures with the map; returns those whose consistency with it suffices."""
        closed = self._of(State.ACCEPTED) | self._revoked
        at = np.array([row for row in rows if not closed[row]], np.int64)
        if not len(at):
            return []
        # without outlier rejection, all closures within the limits
        known = self.settings
        gate, most = (known.gate_chi2, known.max_chance) if known.reject_outliers else (np.inf, 1)
        agreed = []
        for row, distance, misfit_m, joined, ratio, chance, wide in zip(at.tolist(), *self._compare(at), strict=True):
            state, reason = State.PENDING, ClosureReason.UNSURE
            if wide > gate:
                state, reason = State.REJECTED, ClosureReason.CONTRADICTS
            elif misfit_m > (self.settings.max_correction_m or np.inf):
                state, reason = State.REJECTED, ClosureReason.TOO_FAR
            elif distance <= gate and chance <= most:
                agreed.append(row)
            closure, sigmas = self.placed[row].closure, float(np.sqrt(distance))
            self.verdicts[row] = ClosureVerdict(closure, state, reason, sigmas, float(misfit_m))
            self._joined[row], self._ratios[row] = joined, ratio if state is State.PENDING else 1.0
        return agreed

    def _compare(self, rows: NDArray[np.int64]) -> tuple[Array, Array, NDArray[np.bool_], Array, Array, Array]:
        """Compare N closures with the map; a closure between unconnected endpoints agrees with it.

        A closure that contradicts the estimated noise is compared with the widest plausible noise too. The more places
        agree with the estimated one, the less likely is the other.

        Returns:
            (N,) squared Mahalanobis distances, misfits in metres, whether the map joins the endpoints by more than
            odometry across a silence, likelihoods of this distance for a wrong closure over that for a right one,
            false-alarm probabilities, and squared Mahalanobis distances by the widest plausible noise.
        """
        assert self._map is not None
        chosen = self.closures[rows]
        bounds, joined = self._map.bounds(chosen["match"], chosen["query"])
        covariances = bounds[:, joined] + self.scale.closures**2 * chosen["covariance"][joined]
        misfits = self._misfits(rows)[joined]
        (distances, wide, metres), (false_alarms, ratios) = np.zeros((3, len(rows))), np.ones((2, len(rows)))
        twists = logmap(misfits)
        distances[joined], wide[joined] = squared_mahalanobis(np.stack([twists] * 2), covariances)
        metres[joined] = np.linalg.norm(misfits[:, :3, 3], axis=1)
        false_alarms[joined], too_wide = false_alarm_ratio(covariances, self.settings)
        false_alarms = np.minimum(false_alarms, 1.0)
        usual = np.minimum(likelihood_ratio(false_alarms[joined], distances[joined], self.settings), 1.0)
        agreed = {self._consistency.place_of[row] for row in np.flatnonzero(self._of(ClosureReason.AGREES))}
        unlikely = likelihood_ratio((2 + len(agreed)) * too_wide, wide[joined], self.settings)
        ratios[joined] = np.where(distances[joined] > self.settings.gate_chi2, unlikely, np.minimum(usual, unlikely))
        return distances, metres, joined & self._join_parts(rows), ratios, false_alarms, wide

    def _join_parts(self, rows: Rows) -> NDArray[np.bool_]:
        """Return (N,) whether accepted closures, or odometry without a silence, join the endpoints of closures."""
        accepted = np.flatnonzero(self._of(State.ACCEPTED))
        chosen = [self.closures[end][np.concatenate([accepted, rows])] for end in ("match", "query")]
        ends = np.concatenate([np.stack([end["session"], end["part"]], axis=1) for end in chosen])
        parts, of = np.unique(ends, axis=0, return_inverse=True)
        match, query = of.reshape(2, -1)
        links = match[: len(accepted)], query[: len(accepted)]
        joins = csr_matrix((np.ones(len(accepted)), links), shape=(len(parts), len(parts)))
        labels = connected_components(joins, directed=False)[1]
        return np.asarray(labels[match[len(accepted) :]] == labels[query[len(accepted) :]])

    def _misfits(self, rows: NDArray[np.int64]) -> Array:
        """Return (N, 4, 4) residual poses: queries of closures by the map, relative to their poses by the closures."""
        chosen = self.closures[rows]
        return invert(self._sessions.at(chosen["match"]) @ chosen["pose"]) @ self._sessions.at(chosen["query"])

    def _supported_sets(self, rows: Iterable[int], members: NDArray[np.bool_]) -> list[list[int]]:
        """Consistency sets among `members`, each with one of `rows`, that no chance explains."""
        members = members & ~self._revoked & ~self._of(ClosureReason.TOO_FAR)
        sets: list[list[int]] = []
        for row in rows:
            if members[row] and not any(row in found for found in sets):
                found, evidence = self._consistency.consistency_set(row, members)
                # their consistency with the map is further evidence against chance
                evidence -= float(np.log(min(max(self._ratios[member] for member in found), 1.0)))
                if evidence >= self.settings.min_support:
                    sets.append(found)
        return sets

    def _overrule(self, rows: Iterable[int]) -> list[int]:
        """Revoke accepted closures for a supported set of others, of more places than those; returns the set."""
        accepted, by_hand = self._of(State.ACCEPTED), self._of(ClosureReason.ACCEPTED_BY_HAND)
        for found in self._supported_sets(rows, ~accepted):
            losers = sorted({loser for row in found for loser in self._consistency.opponents(row, accepted)})
            if by_hand[losers].any():
                continue
            if self._consistency.count_places(losers) < self._consistency.count_places(found):
                for row in losers:
                    self._reject(row, ClosureReason.OUTVOTED)
                return found
        return []

    def _revoke_outvoted(self) -> bool:
        """Revoke closures accepted too early: more places contradict than support them, and so does the map.

        Where the support of a closure suffices, the odometry between is wrong, not the closure.
        """
        members, outvoted = self._of(State.ACCEPTED), dict[int, ClosureVerdict]()
        for row in np.flatnonzero(members & ~self._of(ClosureReason.ACCEPTED_BY_HAND)).tolist():
            opponents = self._consistency.count_places(self._consistency.opponents(row, members))
            found, evidence = self._consistency.consistency_set(row, members) if opponents else ([], np.inf)
            if evidence < self.settings.min_support and opponents > self._consistency.count_places(found):
                outvoted[row] = self.verdicts[row]
                self._reject(row, ClosureReason.OUTVOTED)
        if not outvoted:
            return False
        self.solve()
        distances = self._compare(np.array(list(outvoted)))[0]
        right = [row for row, near in zip(outvoted, distances <= self.settings.gate_chi2, strict=True) if near]
        for row in right:
            self.verdicts[row] = outvoted[row]
        if right:
            self.solve()
        return len(right) < len(outvoted)

    def _unopposed(self, at_last: bool = False) -> list[int]:
        """Return pending closures of the best fitting place among those that have waited long enough.

        Neither the map nor another closure contradicts them, nor another likely place with as many closures, of joined
        sessions. One place at a time: the map moved by the first one may contradict the next. The closures of a place
        are accepted together, by their median odds, so that one of a wrong set is not accepted by chance. The decision
        at the end does not wait, and counts how many closures were wrong and the evidence of other places.
        """
        waiting = self._of(State.PENDING)
        if not at_last and len(waiting):
            queries = self.closures["query"]
            waited_m = queries["travel"][-1] - queries["travel"]
            waiting &= (queries["session"] != queries["session"][-1]) | (waited_m >= self.settings.patience_m)
            waiting[np.flatnonzero(waiting)[:-_MOST_WAITING]] = False
        companions = ~self._of(State.ACCEPTED) & ~self._revoked
        places = [[row, *self._consistency.companions(row, companions)] for row in np.flatnonzero(waiting).tolist()]
        self._gate(sorted({member for place in places for member in place}))
        # closures that are likelier wrong than right by the map do not count against others
        ratios, pending = np.array(self._ratios), self._of(State.PENDING) & np.array(self._joined, bool)
        against = self._of(State.ACCEPTED) | (ratios < 0.5)
        best, most_odds = list[int](), _MOST_ODDS_AT_LAST if at_last else _MOST_ODDS
        for place in places:
            odds = self._odds_against(place, at_last)
            usual = [row for row, odd in zip(place, odds, strict=True) if waiting[row] and odd <= most_odds]
            usual = [row for row in usual if not self._consistency.opponents(row, against)]
            if usual and np.median(odds) <= most_odds and not self._is_outnumbered(usual, place, pending):
                best, most_odds = usual, float(np.median(odds))
        return best

    def _is_outnumbered(self, rows: list[int], place: list[int], pending: NDArray[np.bool_]) -> bool:
        """Return whether a likely place among pending closures, with as many of them as a place, opposes some of it."""
        most = _RIVAL_RATIO * np.median([self._ratios[row] for row in place])
        opponents = {other for row in rows for other in self._consistency.opponents(row, pending)}
        rivals = (other for other in opponents if self._ratios[other] < most)
        return any(len(self._consistency.companions(rival, pending)) + 1 >= len(place) for rival in rivals)

    def _odds_against(self, place: list[int], at_last: bool) -> Array:
        """Return (N,) odds that closures of one place are wrong, by the map and, at the end, by all other evidence."""
        odds = np.array([self._ratios[row] for row in place])
        if not at_last:
            return odds
        rejected, accepted = (int(self._of(state).sum()) for state in (State.REJECTED, State.ACCEPTED))
        stated = [self.placed[row].closure.probability for row in place]
        right = np.clip(np.nanmedian(stated), 0.01, 0.99) if np.isfinite(stated).any() else _USUALLY_RIGHT
        prior = (_COUNTED * (1 - right) + rejected) / (_COUNTED * right + accepted)
        odds = odds * np.exp(-self._consistency.consistency_set(place[0], self._of(State.PENDING))[1])
        if not self._joined[place[0]]:
            placed = self.placed[place[0]]
            least = 0.0 if placed.match == placed.query else 1 / _USUALLY_RIGHT - 1
            return odds * max(prior, least) * _WRONG_BETWEEN
        # of those that contradict the estimated noise most are wrong, and single ones too
        is_usual = self.verdicts[place[0]].residual ** 2 <= self.settings.gate_chi2
        return odds * prior * (_WRONG_ALONE if len(place) == 1 and is_usual else 1.0)

    def _of(self, decision: State | ClosureReason) -> NDArray[np.bool_]:
        """Return (N,) whether closures have verdicts of a state or a reason."""
        kind = "state" if isinstance(decision, State) else "reason"
        return np.array([getattr(verdict, kind) is decision for verdict in self.verdicts], bool)

    def _accept(self, reasons: dict[int, ClosureReason]) -> bool:
        """Accept closures, and solve the map unless they agree with it; return false without any."""
        if not reasons:
            return False
        for row, reason in reasons.items():
            self.verdicts[row] = replace(self.verdicts[row], state=State.ACCEPTED, reason=reason)
        if all(reason is ClosureReason.AGREES and self._joined[row] for row, reason in reasons.items()):
            self._is_rough = self._is_outdated = True
        else:
            self.solve(rough=True)
        return True

    def solve(self, rough: bool = False) -> None:
        """Solve the map with the accepted closures, or solve it roughly, which takes half the time.

        Closures not accepted that the moved map comes close to are compared again.
        """
        self._is_rough = True  # also after an error
        self._sessions.solve(self.accepted, self.scale, rough)
        self._is_rough, self._is_outdated = rough, False
        self._map = RelativeCovariances(self._sessions, self._estimator.widest)
        rows = np.flatnonzero(~self._of(State.ACCEPTED) & ~self._revoked)
        self._again.update(rows[np.linalg.norm(self._misfits(rows)[:, :3, 3], axis=1) < _CLOSE_M].tolist())

    def _reject(self, row: int, reason: ClosureReason) -> None:
        self.verdicts[row] = ClosureVerdict(self.placed[row].closure, State.REJECTED, reason)

    def _changed_since(self, before: list[ClosureVerdict]) -> list[ClosureVerdict]:
        """Return verdicts that are new or of another state than before."""
        known = zip(self.verdicts, before, strict=False)
        return [new for new, old in known if new.state is not old.state] + self.verdicts[len(before) :]
