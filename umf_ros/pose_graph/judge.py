"""Judge: which closures shape the map.

A closure that agrees with the map where disagreement would have shown is accepted at once. One
that the map cannot judge, or that contradicts it, needs others that say the same of other places.
Nothing is decided for good: when the map moves, what was rejected is looked at again, and what was
accepted can be revoked by a better supported contradiction.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from umf_ros.config import PoseGraph as PoseGraphSettings
from umf_ros.errors import GraphError
from umf_ros.frames import LoopClosure
from umf_ros.geometry import Array
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.agreement import Agreement, chance_to_agree, doubt
from umf_ros.pose_graph.certainty import Certainty
from umf_ros.pose_graph.closures import ClosureVerdict, State, TrackedClosure
from umf_ros.pose_graph.ends import ClosureEnds, Cycles, Scale, Side
from umf_ros.pose_graph.odometry import Stamps
from umf_ros.pose_graph.scale import ScaleEstimator
from umf_ros.pose_graph.sessions import Sessions

_LOOPS_PER_CLOSURE = 3
_MOST_ROUNDS = 4
# a closure this far from the map (m) is not looked at again before the map moves
_CLOSE_M = 2.0
# the odds against a closure that nobody supports are these at most: on the way, and when nothing more will come
_MOST_DOUBT, _MOST_DOUBT_AT_LAST = 0.1, 0.2
# before any verdict, one of five closures is taken for wrong
_WRONG_BEFORE, _RIGHT_BEFORE = 1, 4
# what looks alike does so for a while, so wrong closures seldom come alone: of those left undecided at the end of
# drives in worlds 10200-10473 of benchmarks/pose_graph.py 1 of 67 wrong ones was alone and 59 of 213 right ones
_WRONG_ALONE = 0.1
_EVEN = 0.5
_AGREES = "agrees with the map"
_SUPPORTED = "supported by other places"
_UNOPPOSED = "nothing speaks against it"
_UNSURE = "needs support from another place"
_CONTRADICTS = "contradicts the map"
_OUTVOTED = "revoked: more places contradict it"
_BY_HAND = "revoked by hand"


class Comparison(NamedTuple):
    """A closure and the map.

    Attributes:
        distance: squared Mahalanobis distance.
        misfit_m: metres.
        chance: that the map does not tell a wrong closure from a right one.
        doubt: how much likelier a wrong closure misses the map by this than a right one.
    """

    distance: float
    misfit_m: float
    chance: float
    doubt: float


class Judge:
    """Decides about closures and keeps the map solved accordingly."""

    def __init__(self, settings: PoseGraphSettings, sessions: Sessions) -> None:
        self._settings = settings
        self._sessions = sessions
        self._ends = ClosureEnds()
        self._agreement = Agreement(self._ends, settings)
        self._estimator = ScaleEstimator()
        self._certainty: Certainty | None = None
        self._changed: set[int] = set()
        self._vetoed: set[int] = set()
        self._too_far: set[int] = set()
        self._contests: dict[int, int] = {}
        self._doubts: dict[int, float] = {}
        self._brought_close: list[int] = []
        self.scale = Scale()
        self.closures: list[TrackedClosure] = []

    def consider(self, arrived: list[TrackedClosure]) -> list[ClosureVerdict]:
        """Take closures in; returns the verdicts that are new or changed.

        The map is solved once at most: what the moved map comes close to is looked at with the next call.
        """
        rows = [self._take(tracked) for tracked in arrived]
        self._changed = set(rows)
        unsolved = bool(self.closures) and self._certainty is None  # the solver failed when they came
        if self._rescale() or unsolved or (rows and self._sessions.outgrown):
            self._solve()
            rows = list(range(len(self.closures)))
        self._decide({*rows, *self._brought_close})
        return self._verdicts()

    def settle(self) -> list[ClosureVerdict]:
        """Decide what can wait no longer and bring the map to its exact optimum; returns changed verdicts."""
        self._changed = set()
        if self._certainty is None:
            return []
        self._decide_all()
        for _ in self.closures:
            if not self._accept(dict.fromkeys(self._unopposed(last_word=True), _UNOPPOSED)):
                break
            self._decide_all()
        self._ask_again()
        for _ in range(_MOST_ROUNDS):
            self._sessions.reshape()
            self._solve()
        return self._verdicts()

    def renew(self) -> list[ClosureVerdict]:
        """Solve again after the odometry's past changed; no verdict changes by that."""
        self._ends.renew(self._sessions.chains)
        if self._certainty is not None:
            self._solve()
        return []

    def veto(self, row: int) -> list[ClosureVerdict]:
        """Revoke a closure for good."""
        self._changed = set()
        self._vetoed.add(row)
        was_accepted = self.closures[row].accepted
        self._note(row, State.REJECTED, _BY_HAND)
        if was_accepted:
            self._solve()
        return self._verdicts()

    @property
    def vetoed(self) -> list[LoopClosure]:
        """Closures that were revoked for good."""
        return [self.closures[row].closure for row in sorted(self._vetoed)]

    def ends_of(self, session: int) -> Stamps:
        """Stamps of all closure ends in a session."""
        sides = (self._ends.match, self._ends.query)
        return np.concatenate([side.stamp.view[side.session.view == session] for side in sides])

    def positions(self) -> Array:
        """(N, 2, 3) map positions of the match and query ends of all closures."""
        rows = np.arange(len(self.closures))
        ends = [self._poses(side, rows)[:, :3, 3] for side in (self._ends.match, self._ends.query)]
        return np.stack(ends, axis=1)

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
        believed = self._believe(rows)
        reasons = dict.fromkeys(self._challengers(rows), _SUPPORTED)
        reasons |= dict.fromkeys(believed, _SUPPORTED) | dict.fromkeys(agreed, _AGREES)
        # only where nothing else is accepted: the map it moves may well speak against them
        if not reasons:
            reasons = dict.fromkeys(self._unopposed(), _UNOPPOSED)
        self._brought_close = self._worth_another_look() if self._accept(reasons) else []
        return bool(reasons)

    def _take(self, tracked: TrackedClosure) -> int:
        row = len(self.closures)
        self.closures.append(tracked)
        self._ends.append(self._sessions.chains, tracked)
        loops = self._agreement.add(row, self.scale)
        keep = slice(-_LOOPS_PER_CLOSURE, None)
        loops = Cycles(loops.residuals[keep], loops.odometry_noise[keep], loops.closure_noise[keep])
        self._estimator.add(loops, self._agreement.place_of[row])
        return row

    def _rescale(self) -> bool:
        """Adopt a new scale of the covariances; True when it changed."""
        scale = self._estimator.scale if self._settings.estimate_scale else Scale()
        if scale == self.scale:
            return False
        self.scale = scale
        self._agreement.renew(scale)
        return True

    def _gate(self, rows: Iterable[int]) -> set[int]:
        """Compare closures with the map; returns those whose agreement suffices."""
        agreed = set()
        for row in rows:
            if self.closures[row].accepted or row in self._vetoed:
                continue
            distance, misfit_m, chance, doubted = self._compare(row)
            self._too_far.discard(row)
            self._doubts[row] = 1.0
            if self._settings.use_gate and distance > self._settings.gate_chi2:
                self._note(row, State.REJECTED, _CONTRADICTS, distance, misfit_m)
            elif self._settings.max_correction_m and misfit_m > self._settings.max_correction_m:
                self._too_far.add(row)
                self._note(row, State.REJECTED, f"moves the pose by {misfit_m:.1f} m", distance, misfit_m)
            else:
                self._note(row, State.UNDECIDED, _UNSURE, distance, misfit_m)
                self._doubts[row] = doubted
                if chance <= self._settings.max_chance or not self._settings.use_support:
                    agreed.add(row)
        return agreed

    def _compare(self, row: int) -> Comparison:
        """Hold a closure against the map."""
        tracked = self.closures[row]
        assert self._certainty is not None
        predicted = self._certainty.predict(
            tracked.match, tracked.closure.match_stamp_ns, tracked.query, tracked.closure.query_stamp_ns
        )
        misfit = lie.invert(tracked.closure.match_T_query) @ predicted.pose
        if predicted.covariance is None:
            return Comparison(0.0, 0.0, 1.0, 1.0)
        covariance = predicted.covariance + self.scale.closures**2 * tracked.covariance
        distance = lie.mahalanobis(lie.log(misfit[None]), covariance[None])
        chance = chance_to_agree(covariance[None], self._settings)
        doubted = doubt(chance, distance, self._settings)
        return Comparison(distance.item(), float(np.linalg.norm(misfit[:3, 3])), chance.item(), doubted.item())

    def _believe(self, rows: Iterable[int]) -> set[int]:
        """Groups around `rows` that no chance explains and that the map does not contradict."""
        return {member for group in self._groups(rows, State.UNDECIDED) for member in group}

    def _groups(self, rows: Iterable[int], state: State) -> list[list[int]]:
        """Well supported groups among the closures of one state, each with a closure of `rows`."""
        members = np.array([c.verdict.state is state for c in self.closures])
        members[list(self._vetoed | self._too_far)] = False
        groups: list[list[int]] = []
        for row in rows:
            if members[row] and not any(row in group for group in groups):
                group, evidence = self._agreement.group(row, members)
                # that all agree with the map as well is one more thing that chance has to explain
                evidence -= float(np.log(max(self._doubts[member] for member in group)))
                if evidence >= self._settings.min_support:
                    groups.append(group)
        return groups

    def _unopposed(self, last_word: bool = False) -> list[int]:
        """Undecided closures of the place that fits best of those that have waited long enough.

        Nothing speaks against them, the map included. One place at a time: the map that the first one
        moves may speak against the next. A place's closures stand or fall together, so that one of a
        wrong group does not pass for the luck of its noise. The last word waits for nothing, and takes
        into account how many closures were wrong and what other places say, though it did not suffice.
        """
        patience_m = 0.0 if last_word else self._settings.patience_m
        most_doubt = _MOST_DOUBT_AT_LAST if last_word else _MOST_DOUBT
        open_to = np.array([not c.accepted for c in self.closures])
        open_to[list(self._vetoed)] = False
        waiting = [row for row, c in enumerate(self.closures) if c.verdict.state is State.UNDECIDED]
        waiting = [row for row in waiting if self._waited(row) >= patience_m]
        places = [[row, *self._agreement.companions(row, open_to)] for row in waiting]
        self._gate(sorted({member for place in places for member in place}))
        undecided = np.array([c.verdict.state is State.UNDECIDED for c in self.closures])
        # what the map itself finds wrong rather than right speaks against nothing
        against = np.array([c.accepted or self._doubts.get(row, 1.0) < _EVEN for row, c in enumerate(self.closures)])
        best: list[int] = []
        for place in places:
            doubts = np.array([self._doubts[row] for row in place])
            if last_word:
                doubts *= self._odds() * np.exp(-self._agreement.group(place[0], undecided)[1])
                doubts *= _WRONG_ALONE if len(place) == 1 else 1.0
            usual = [row for row, odds in zip(place, doubts, strict=True) if row in waiting and odds <= most_doubt]
            usual = [row for row in usual if not self._agreement.contested(row, against)]
            if usual and np.median(doubts) <= most_doubt:
                best, most_doubt = usual, float(np.median(doubts))
        return best

    def _odds(self) -> float:
        """Wrong closures for every right one, as far as is known."""
        rejected = sum(c.verdict.state is State.REJECTED for c in self.closures)
        accepted = sum(c.accepted for c in self.closures)
        return (_WRONG_BEFORE + rejected) / (_RIGHT_BEFORE + accepted)

    def _waited(self, row: int) -> float:
        travel = self._ends.query.travel.view
        if self.closures[row].query != self.closures[-1].query:
            return float("inf")
        return float(travel[-1] - travel[row])

    def _challengers(self, rows: Iterable[int]) -> set[int]:
        """A group that the map contradicts and that wins against what it contradicts in turn."""
        if not self._settings.use_gnc:
            return set()
        for group in self._groups(rows, State.REJECTED):
            places = self._agreement.places(group)
            if places <= max(self._contests.get(row, 0) for row in group):
                continue
            self._contests |= dict.fromkeys(group, places)
            losers = self._contradicted_by(group)
            if losers is not None and self._agreement.places(losers) < places:
                for row in losers:
                    self._note(row, State.REJECTED, _OUTVOTED)
                return set(group)
        return set()

    def _contradicted_by(self, group: list[int]) -> list[int] | None:
        """Accepted closures that cannot be right when the group is; None if that cannot be told."""
        accepted = [row for row, c in enumerate(self.closures) if c.accepted]
        try:
            doubtful = self._sessions.doubtful(self._pick(group), self._pick(accepted), self.scale)
        except GraphError:
            return None
        return self._unsupported([accepted[k] for k in doubtful], group)

    def _unsupported(self, doubtful: list[int], trusted: list[int]) -> list[int]:
        """The doubtful that not even the trusted speak for: else the odometry between is wrong, not the closure."""
        members = np.zeros(len(self.closures), bool)
        members[trusted] = True
        enough = self._settings.min_support
        return [row for row in doubtful if self._agreement.group(row, members)[1] < enough]

    def _ask_again(self) -> None:
        """Let graduated non-convexity look at all accepted closures; without those it doubts all are judged anew."""
        accepted = [row for row, c in enumerate(self.closures) if c.accepted]
        if not self._settings.use_gnc or not accepted:
            return
        try:
            doubtful = [accepted[k] for k in self._sessions.doubtful([], self._pick(accepted), self.scale)]
        except GraphError:
            return
        doubtful = self._unsupported(doubtful, [row for row in accepted if row not in doubtful])
        if doubtful and self._agreement.places(doubtful) < self._agreement.places(accepted) / 2:
            for row in doubtful:
                self._note(row, State.REJECTED, _OUTVOTED)
            self._solve()
            self._decide_all()

    def _accept(self, reasons: dict[int, str]) -> bool:
        for row, reason in reasons.items():
            verdict = self.closures[row].verdict
            self._note(row, State.ACCEPTED, reason, verdict.residual**2, verdict.residual_m)
        if reasons:
            self._solve()
        return bool(reasons)

    def _solve(self) -> None:
        self._sessions.solve([c for c in self.closures if c.accepted], self.scale)
        self._certainty = Certainty(self._sessions, self.scale)

    def _worth_another_look(self) -> list[int]:
        """Closures not accepted that the moved map now comes close to."""
        rows = np.array([row for row, c in enumerate(self.closures) if not c.accepted], np.int64)
        if not len(rows):
            return []
        ways = lie.invert(self._poses(self._ends.match, rows)) @ self._poses(self._ends.query, rows)
        misfits = lie.invert(self._ends.pose.view[rows]) @ ways
        return rows[np.linalg.norm(misfits[:, :3, 3], axis=1) < _CLOSE_M].tolist()

    def _poses(self, side: Side, rows: NDArray[np.int64]) -> Array:
        poses = np.zeros((len(rows), 4, 4))
        for session in np.unique(side.session.view[rows]):
            mine = side.session.view[rows] == session
            poses[mine] = self._sessions.at(int(session), side.stamp.view[rows][mine])
        return poses

    def _pick(self, rows: list[int]) -> list[TrackedClosure]:
        return [self.closures[row] for row in rows]

    def _note(
        self, row: int, state: State, reason: str, squared: float = float("nan"), metres: float = float("nan")
    ) -> None:
        before = self.closures[row].verdict
        self.closures[row].decide(state, reason, float(np.sqrt(squared)), metres)
        if before.state is not state:
            self._changed.add(row)

    def _verdicts(self) -> list[ClosureVerdict]:
        return [self.closures[row].verdict for row in sorted(self._changed)]
