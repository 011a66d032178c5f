"""Pose-graph back-end: optimise the trajectory from odometry and loop closures."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import takewhile, zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from umf_ros.absolute.measurement import AbsoluteMeasurement, AbsoluteVerdict, write_verdicts
from umf_ros.absolute.reference import AbsoluteReference
from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError, writing
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, gtsam_to_ros_covariance, invert
from umf_ros.core.io import write_table
from umf_ros.core.trajectory import Trajectory, write_g2o, write_geojson, write_tum
from umf_ros.pose_graph.closures import (
    VERDICT_COLUMNS,
    ClosureReason,
    ClosureVerdict,
    Decision,
    PlacedClosure,
    State,
    check_closure,
    check_covariance,
    check_pose,
    verdict_rows,
)
from umf_ros.pose_graph.consistency import NoiseScale
from umf_ros.pose_graph.odometry import POINT, PathPoints, Stamps
from umf_ros.pose_graph.rejection import OutlierRejection
from umf_ros.pose_graph.sessions import Sessions
from umf_ros.pose_graph.solver import Graph

logger = logging.getLogger(__name__)

MAX_WAITING = 10_000
"""Most closures that wait for their odometry, and most refused ones that are kept: twice the history of the topic."""
_AT_ONCE = 20
_UNDECIDED = (ClosureReason.NO_ODOMETRY_YET, ClosureReason.DECIDED_BEFORE_ODOMETRY, ClosureReason.NOT_DECIDED_YET)
Key = tuple[int, int, bytes]
"""Stamps of match and query, and pose: an equal closure is a repeated message, another pose another measurement."""


class PoseGraph:
    """Pose graph of odometry and loop closures that arrive in any order.

    Unusable messages are refused with a reason and counted; `reference` decides about absolute measurements.
    """

    def __init__(self, settings: PoseGraphSettings | None = None) -> None:
        self._settings = settings or PoseGraphSettings()
        self.reference = AbsoluteReference(self._settings)
        self._sessions = Sessions(self._settings, self.reference)
        self._rejection = OutlierRejection(self._settings, self._sessions)
        # decisions in order of stamps so far, and the sessions with odometry that they are based on
        self._ordered: tuple[list[int], Sessions, OutlierRejection] | None = None
        # without odometry, with session and stamp since when; with odometry, but without a decision; unusable
        self._waiting: dict[Key, tuple[LoopClosure, tuple[int, int] | None]] = {}
        self._arrived: list[PlacedClosure] = []
        self._refused: dict[Key, ClosureVerdict] = {}
        self._number_refused = 0
        self._by_hand: dict[tuple[int, int], State] = {}  # decisions about closures that wait
        self._settled = False
        self._placed: set[tuple[int, int, Key]] = set()
        self.counts: Counter[str] = Counter()

    def retune(self, settings: PoseGraphSettings) -> None:
        """Use other gates from now on; the odometry noise model stays."""
        self._settings, self._ordered, self._settled = settings, None, False
        self._rejection.retune(settings)

    def begin_session(self) -> None:
        """Start a new odometry chain with its own gauge; later odometry belongs to it."""
        self._place_waiting()  # a later session may have the same stamps
        self._sessions.begin()

    def add_odometry(self, stamp_ns: int, odom_T_body: Array, covariance: Array | None = None) -> bool:
        """Add an odometry message, in any order; drop a second one of a stamp. Return false if it is refused.

        A covariance (6, 6), in ROS order, is that of the motion since the previous message, axes of the previous body;
        without one, the settings' odometry model applies.
        """
        try:
            check_pose(odom_T_body)
            if covariance is not None:
                check_covariance(covariance)
        except GraphError as error:
            self.counts[f"odometry refused: {error}"] += 1
            return False
        self.counts["odometry"] += 1
        self._settled = False
        self._sessions.chains[-1].add(int(stamp_ns), np.asarray(odom_T_body, float), covariance)
        return True

    def load_odometry(self, stamps: Stamps, poses: Array) -> None:
        """Add N messages that were accepted before, (N,) and (N, 4, 4)."""
        self.counts["odometry"] += len(stamps)
        self._sessions.chains[-1].extend(stamps, poses)

    def add_absolute(self, measurement: AbsoluteMeasurement) -> None:
        """Add an absolute measurement, in any order; `update` decides about it."""
        self._settled = False
        self.reference.add(measurement)

    def add_closure(self, closure: LoopClosure) -> list[ClosureVerdict]:
        """Add a closure; return every verdict that it caused or changed."""
        return self.add_closures([closure])

    def add_closures(self, closures: list[LoopClosure]) -> list[ClosureVerdict]:
        """Add several closures; see `add_closure`."""
        received, decided = self.receive(closures), self.decide()
        known = {id(verdict.closure) for verdict in decided}
        return [verdict for verdict in received if id(verdict.closure) not in known] + decided

    def receive(self, closures: Sequence[LoopClosure]) -> list[ClosureVerdict]:
        """Take closures for `decide`, at a constant cost each; return the first verdicts; repeats are counted only."""
        if not closures:  # as of most frames
            return []
        self._refresh()
        stamps = np.array([closure.pair for closure in closures], np.int64).reshape(-1, 2)
        both = zip(closures, *self._sessions.find_pairs(stamps), strict=True)
        return [verdict for one in both if (verdict := self._receive(*one)) is not None]

    def resume(self, verdicts: Mapping[tuple[int, int], Decision], within_s: float = float("inf")) -> None:
        """Restore the earlier verdicts of received closures, by the stamps of match and query.

        Closures without a verdict, and closures that share both stamps, are decided again; what is left when the time
        is up, by the next calls of `decide`.
        """
        for key in [key for key in self._waiting if verdicts.get(key[:2], (None,))[0] is State.REFUSED]:
            self._refuse(self._waiting.pop(key)[0], verdicts[key[:2]][1])
        self._refuse_waiting()
        times, decided, new = Counter(placed.closure.pair for placed in self._arrived), [], []
        for placed in self._arrived:
            pair = placed.closure.pair
            decision = verdicts.get(pair) if times[pair] == 1 else None
            if decision is None or decision[0] is State.REFUSED or decision[1] in _UNDECIDED:
                new.append(placed)
            else:
                decided.append((placed, decision))
        self._arrived = new
        if decided:
            self._attempt(lambda: self._rejection.resume(decided))
        self.decide(within_s)
        self._attempt(lambda: self.reference.decide(self._sessions, self._rejection.solve))

    def update(self, exactly: bool = True, within_s: float = float("inf")) -> list[ClosureVerdict]:
        """Decide about measurements whose odometry has arrived, and solve the map exactly; return new verdicts.

        When the time is up, closures are left, and the map is not solved exactly.
        """
        verdicts = self._refuse_waiting() + self.decide(within_s)
        self._attempt(lambda: self.reference.decide(self._sessions, self._rejection.solve))
        if exactly and not self._arrived:
            self._attempt(self._rejection.refine)
        return verdicts

    def decide(self, within_s: float = float("inf")) -> list[ClosureVerdict]:
        """Decide about received closures until the time is up, the oldest and the newest first; return new verdicts.

        So a closure of now need not wait until a backlog is decided about.
        """
        self._refresh()
        verdicts, until_s, half = [], time.monotonic() + within_s, _AT_ONCE // 2
        while True:
            chosen = self._arrived[:half] + self._arrived[half:][-half:]
            self._arrived = self._arrived[half:-half]
            verdicts += self._attempt(lambda: self._rejection.consider(chosen))  # noqa: B023 (called at once)
            for pair in {one.closure.pair for one in chosen} & self._by_hand.keys():
                state = self._by_hand.pop(pair)
                verdicts += self._attempt(lambda: self.decide_by_hand(*pair, state))  # noqa: B023 (called at once)
            if not self._arrived or time.monotonic() > until_s:
                return verdicts

    @property
    def undecided(self) -> int:
        """Number of closures that `decide` had no time for."""
        return len(self._arrived)

    def prepare(self, within_s: float) -> None:
        """Do part of the work of `settle` within a time limit; after a long mission it takes minutes."""
        self._refresh()
        last_ns = [chain.stamps[-1:] for chain in self._sessions.chains]

        def has_odometry_beyond(one: PlacedClosure) -> bool:
            return all((last_ns[session] > ns).all() for session, ns in zip(one[:2], one.closure.pair, strict=True))

        worlds = dict(self.reference.worlds)
        self._reprocess(within_s, has_odometry_beyond)
        self.reference.worlds = worlds  # of this map, not of the one that is prepared

    def settle(self, within_s: float = float("inf")) -> list[ClosureVerdict] | None:
        """Decide finally and solve for the exact optimum, as at the end of a mission.

        All closures are decided again in the order of their stamps, so that the order of arrival has no influence: a
        live run and a replay end with the same verdicts. Pending closures are accepted if nothing contradicts them.

        Returns:
            The changed verdicts; None when the time was up first, and nothing has changed.
        """
        until_s = time.monotonic() + within_s
        once = self._decides_once and within_s == float("inf")
        verdicts = self._refuse_waiting() if once else self.update(within_s=within_s)
        if self._settled:  # no input since
            return verdicts
        before, undecided = self._rejection, self._arrived and not once
        if undecided or not self._reprocess(until_s - time.monotonic()) or self._ordered is None:
            return None
        (_, self._sessions, self._rejection), self._ordered, self._arrived = self._ordered, None, []
        rows = {id(placed): row for row, placed in enumerate(self._rejection.placed)}
        for row in before.by_hand:
            again, state = rows[id(before.placed[row])], before.verdicts[row].state
            self._attempt(lambda: self._rejection.decide_by_hand(again, state))  # noqa: B023 (called at once)
        states = {id(placed): verdict.state for placed, verdict in zip(before.placed, before.verdicts, strict=True)}
        after = zip(self._rejection.placed, self._rejection.verdicts, strict=True)
        verdicts += [verdict for placed, verdict in after if verdict.state is not states.get(id(placed))]
        verdicts += self._attempt(self._rejection.settle)
        for _ in range(3):  # the map moved by measurements may contradict others
            self._attempt(lambda: self.reference.decide(self._sessions, self._rejection.solve, at_last=True))
        if self._sessions.solution is not None:
            self._attempt(lambda: self._sessions.refine(self._rejection.accepted))
        self._settled = True
        return verdicts

    @property
    def _decides_once(self) -> bool:
        """Whether no decision depends on the order of arrival so far: closures were received only, as in a replay."""
        return not (self._rejection.placed or self._by_hand or self.reference.is_used)

    def _reprocess(self, within_s: float, is_ready: Callable[[PlacedClosure], bool] = lambda _: True) -> bool:
        """Decide again, from the odometry alone, by the stamps of query and match; return false if out of time."""
        until_s = time.monotonic() + within_s
        order = sorted(self._rejection.placed + self._arrived, key=lambda placed: placed.closure.pair[::-1])
        begun, sessions, rejection = self._ordered or (None, self._sessions, self._rejection)
        late = any(a is not b for a, b in zip_longest(rejection.placed, order[: len(rejection.placed)]))
        if late or begun != self._sessions.begun:
            # the same odometry, before any closure moved it
            sessions = Sessions(self._settings, self.reference, self._sessions.chains)
            rejection = OutlierRejection(self._settings, sessions)
            self._ordered = self._sessions.begun, sessions, rejection
        for placed in takewhile(is_ready, order[len(rejection.placed) :]):
            if time.monotonic() > until_s:
                return False
            self._attempt(lambda: rejection.consider([placed]))  # noqa: B023 (called at once)
        return True

    def _refresh(self) -> None:
        """Process the new odometry."""
        if self._sessions.update():
            self.counts["odometry out of order"] += 1
            self._ordered = None
            self._attempt(self._rejection.renew)

    def _attempt(self, step: Callable[[], list[ClosureVerdict] | None]) -> list[ClosureVerdict]:
        """Run a step that solves; count a failure of the optimiser and keep the last trajectory."""
        try:
            return step() or []
        except GraphError as error:
            self.counts[f"optimiser: {error}"] += 1
            logger.warning("%s; the last trajectory stays", error)
            return []

    def decide_by_hand(self, match_stamp_ns: int, query_stamp_ns: int, state: State) -> list[ClosureVerdict]:
        """Accept or reject every closure between two keyframes whatever the evidence; pending takes that back.

        It holds for closures that wait for their odometry, too.

        Raises:
            GraphError: there is no such closure, or the graph cannot be solved so; then nothing has changed.
        """
        pair = match_stamp_ns, query_stamp_ns
        if chosen := [placed for placed in self._arrived if placed.closure.pair == pair]:
            self._arrived = [placed for placed in self._arrived if placed.closure.pair != pair]
            self._attempt(lambda: self._rejection.consider(chosen))
        rows = [row for row, placed in enumerate(self._rejection.placed) if placed.closure.pair == pair]
        waiting = [verdict.closure for verdict in self._pending() if verdict.closure.pair == pair]
        self._settled = False
        if not rows and not waiting:
            raise GraphError(f"no closure between keyframes {match_stamp_ns} and {query_stamp_ns}")
        if waiting:
            self._by_hand[pair] = state
        told = [ClosureVerdict(one, State.PENDING, self._reason_to_wait(pair)) for one in waiting]
        return told + [verdict for row in rows for verdict in self._rejection.decide_by_hand(row, state)]

    def add_by_hand(self, closure: LoopClosure) -> list[ClosureVerdict]:
        """Add a closure and accept it whatever the evidence, at once or when its odometry arrives.

        Raises:
            GraphError: it is unusable, or the graph cannot be solved with it; it is not kept as evidence.
        """
        check_closure(closure, self._settings.max_closure_m)
        verdicts = self.add_closure(closure)
        try:
            return verdicts + self.decide_by_hand(*closure.pair, State.ACCEPTED)
        except GraphError:
            self.decide_by_hand(*closure.pair, State.REJECTED)
            raise

    def _receive(self, closure: LoopClosure, match: int, query: int) -> ClosureVerdict | None:
        """Queue a closure of two sessions; return its first verdict, None if it is known."""
        key = *closure.pair, closure.match_T_query.tobytes()
        before = self._refused.get(key)
        try:
            check_closure(closure, self._settings.max_closure_m)
        except GraphError as error:
            if before is None or before.reason is not error.args[0]:
                return self._refuse(closure, error.args[0])
        else:
            is_placed = min(match, query) >= 0
            if is_placed and self._place(key, PlacedClosure(match, query, closure)):
                return ClosureVerdict(closure, State.PENDING, ClosureReason.NOT_DECIDED_YET)
            if not is_placed and key not in self._waiting and before is None:
                self._waiting[key] = closure, self._now
                return ClosureVerdict(closure, State.PENDING, ClosureReason.NO_ODOMETRY_YET)
        self.counts["closure twice"] += 1
        return None

    def _place(self, key: Key, placed: PlacedClosure) -> bool:
        """Queue a closure for its decision; return false if it is known in its sessions."""
        if (placed.match, placed.query, key) in self._placed:
            return False
        self._placed.add((placed.match, placed.query, key))
        self._arrived.append(placed)
        self._number_refused -= self._refused.pop(key, None) is not None  # when it came before its odometry
        self._settled = False
        return True

    @property
    def _now(self) -> tuple[int, int] | None:
        """Newest session with odometry, and its last stamp: other sessions may be of another clock."""
        return next(((one, int(self._sessions.chains[one].stamps[-1])) for one in self._sessions.begun[::-1]), None)

    def _refuse(self, closure: LoopClosure, reason: ClosureReason) -> ClosureVerdict:
        self.counts[f"closure refused: {reason}"] += 1
        self._number_refused += 1
        self._by_hand.pop(closure.pair, None)
        verdict = ClosureVerdict(closure, State.REFUSED, reason)
        self._refused[*closure.pair, closure.match_T_query.tobytes()] = verdict
        if len(self._refused) > MAX_WAITING:
            del self._refused[next(iter(self._refused))]
        return verdict

    def _place_waiting(self) -> None:
        """Queue closures whose odometry has arrived for their decision."""
        self._refresh()
        sessions = self._sessions.find_pairs(np.array([key[:2] for key in self._waiting], np.int64).reshape(-1, 2))
        for key, match, query in zip(list(self._waiting), *(found.tolist() for found in sessions), strict=True):
            if min(match, query) >= 0:
                placed = PlacedClosure(match, query, self._waiting.pop(key)[0])
                self.counts["closure twice"] += not self._place(key, placed)

    def _refuse_waiting(self) -> list[ClosureVerdict]:
        """Queue closures whose odometry has arrived; refuse those that wait too long, the oldest when too many wait."""
        self._place_waiting()
        oldest_ns, now = min((span[0] for span in self.session_spans() if span), default=None), self._now
        waiting, self._waiting = self._waiting, {}
        refused, too_many = list[ClosureVerdict](), len(waiting) - MAX_WAITING
        for number, (key, (closure, known)) in enumerate(waiting.items()):
            since = known if known and now and known[0] == now[0] else now
            waited_s = 0.0 if now is None or since is None else (now[1] - since[1]) / 1e9
            if waited_s > self._settings.max_gap_s and oldest_ns is not None and min(closure.pair) < oldest_ns:
                refused.append(self._refuse(closure, ClosureReason.BEFORE_ODOMETRY))
            elif waited_s > self._settings.max_pending_s:
                refused.append(self._refuse(closure, ClosureReason.NO_ODOMETRY))
            elif number < too_many:
                refused.append(self._refuse(closure, ClosureReason.TOO_MANY_WAIT))
            else:
                self._waiting[key] = closure, since
        return refused

    def closures(self) -> list[ClosureVerdict]:
        """Return the latest verdict of every closure, in order of arrival; of refused ones the newest."""
        return self._rejection.verdicts + self._pending() + list(self._refused.values())

    def _pending(self) -> list[ClosureVerdict]:
        """Return verdicts of closures without a decision."""
        undecided = [ClosureVerdict(one.closure, State.PENDING, ClosureReason.NOT_DECIDED_YET) for one in self._arrived]
        waiting = (closure for closure, _ in self._waiting.values())
        return undecided + [ClosureVerdict(one, State.PENDING, self._reason_to_wait(one.pair)) for one in waiting]

    def _reason_to_wait(self, pair: tuple[int, int]) -> ClosureReason:
        by_hand = self._by_hand.get(pair, State.PENDING) is not State.PENDING
        return ClosureReason.DECIDED_BEFORE_ODOMETRY if by_hand else ClosureReason.NO_ODOMETRY_YET

    @property
    def scale(self) -> NoiseScale:
        """Estimated factors of the true standard deviations over the stated ones."""
        return self._rejection.scale

    def verdict_counts(self) -> Counter[State]:
        """Return the number of closures by state."""
        ordered = self._ordered[2].verdicts if self._ordered and self._decides_once else self._rejection.verdicts
        arrived = len(self._rejection.placed) + len(self._arrived) - len(ordered)
        known = {State.PENDING: arrived + len(self._waiting), State.REFUSED: self._number_refused}
        return Counter(verdict.state for verdict in ordered) + Counter(known)

    def trajectory(self, optimized: bool = True) -> tuple[Stamps, Array]:
        """Return stamps (N,) in ns and `map_T_body` or `odom_T_body` (N, 4, 4) of every keyframe joined to the map."""
        self._refresh()
        chains = [self._sessions.chains[session] for session in self._sessions.members(0)]
        poses = [self._sessions.at(chain.at(chain.stamps)) if optimized else chain.poses for chain in chains]
        stamps = [np.empty(0, np.int64), *(chain.stamps for chain in chains)]
        return np.concatenate(stamps), np.concatenate([np.empty((0, 4, 4)), *poses])

    def poses_at(self, stamps: Stamps) -> tuple[Array, NDArray[np.bool_]]:
        """Return (N, 4, 4) `map_T_body` at stamps, in the frame of the map's largest part, and (N,) whether known.

        The sessions of that part share its frame: that of the earliest of them.
        """
        self._refresh()
        poses, known = np.tile(np.eye(4), (len(stamps), 1, 1)), np.zeros(len(stamps), bool)
        for chain in (self._sessions.chains[session] for session in self.sessions_of_map()):
            covered = ~known & chain.covers(stamps)
            if covered.any():
                poses[covered] = self._sessions.at(chain.at(stamps[covered]))
                known |= covered
        return poses, known

    def world(self) -> tuple[Array, Array] | None:
        """Return `world_T_map` of the largest part of the map and the origin on WGS 84; None without a reference."""
        return self.reference.world_of(self._sessions.largest, self._sessions)

    def sessions_of_map(self) -> list[int]:
        """Return numbers of the sessions in the largest part of the map, by the order in which they began."""
        return self._sessions.members(self._sessions.largest)

    def session_spans(self) -> list[tuple[int, int] | None]:
        """Return the first and last stamp of the odometry of every session; None without any."""
        self._refresh()
        return [chain.span for chain in self._sessions.chains]

    def map_T_odom(self) -> Array | None:
        """Return (4, 4) pose of the newest session's odometry frame in the map, by its newest pose."""
        last, chain = self._newest(), self._sessions.chains[-1]
        return self._sessions.at(last)[0] @ invert(chain.poses_at(last["stamp"])[0]) if len(last) else np.eye(4)

    def covariance(self) -> Array:
        """Return the (6, 6) marginal covariance of the newest pose, ROS order, map's axes; zero without odometry."""
        last = self._newest()
        if not len(last):
            return np.zeros((6, 6))
        return gtsam_to_ros_covariance(self._sessions.covariance(last), self._sessions.at(last)[0])

    def _newest(self) -> PathPoints:
        """Return the newest odometry (1,) of the newest session; (0,) without any."""
        self._refresh()
        chain = self._sessions.chains[-1]
        return np.empty(0, POINT) if chain.span is None else chain.at(np.array(chain.span[1:]))

    def write_tum(self, path: str | Path, optimized: bool = True) -> None:
        """Write the trajectory, or the odometry, of all joined sessions in order of their stamps as a TUM file.

        Raises:
            OutputError: the file cannot be written.
        """
        stamps, poses = self.trajectory(optimized)
        order = np.argsort(stamps, kind="stable")
        write_tum(path, Trajectory(stamps[order], poses[order]))

    def closure_lines(self) -> tuple[list[ClosureVerdict], Array]:
        """Return verdicts of the N closures with known endpoints, and (N, 2, 3) map positions of match and query."""
        self._refresh()
        positions = [self._sessions.at(self._rejection.closures[end])[:, :3, 3] for end in ("match", "query")]
        return list(self._rejection.verdicts), np.stack(positions, axis=1)

    def absolute_places(self) -> tuple[list[AbsoluteVerdict], Array]:
        """Return verdicts of the N absolute measurements with a place in the map, and (N, 3) that of the rover then."""
        found = self.reference.verdicts()
        poses, known = self.poses_at(np.array([one.stamp_ns for one in found], np.int64))
        return [found[row] for row in np.flatnonzero(known)], poses[known, :3, 3]

    def graph(self) -> Graph:
        """Return keyframes by session and stamp, odometry and accepted closures, with the solution's covariances."""
        self._refresh()
        return self._sessions.expand(self._rejection.accepted, self._rejection.closures)

    def write_g2o(self, path: Path) -> None:
        """Write `graph`; `<name>.csv` beside the file has vertex, session and stamp.

        Raises:
            OutputError: a file cannot be written.
        """
        full = self.graph()
        write_g2o(path, full.poses, full.edges)
        rows = ((row, *vertex) for row, vertex in enumerate(full.vertices))
        write_table(path.with_suffix(".csv"), ("id", "session", "stamp_ns"), rows)

    def write_results(self, folder: Path, within_s: float = float("inf")) -> bool:
        """Settle, and write trajectories (TUM), the graph (g2o and id-stamp table) and all verdicts (CSV).

        If the time is up before that, the current state is written and false is returned.

        Raises:
            OutputError: the folder cannot be written.
        """
        settled = self.settle(within_s) is not None
        with writing(f"to {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
        write_table(folder / "graph_verdicts.csv", VERDICT_COLUMNS, verdict_rows(self.closures()))
        if absolute := self.reference.verdicts():
            write_verdicts(folder / "absolute_verdicts.csv", absolute)
        if (world := self.world()) is not None:
            chains = {session: self._sessions.chains[session] for session in self.sessions_of_map()}
            paths = {f"session {number}": self._sessions.at(one.at(one.stamps)) for number, one in chains.items()}
            write_geojson(folder / "trajectories.geojson", paths, *world)
        self.write_tum(folder / "trajectory_odometry.tum", optimized=False)
        self.write_tum(folder / "trajectory_optimized.tum")
        self.write_g2o(folder / "graph.g2o")
        return settled
