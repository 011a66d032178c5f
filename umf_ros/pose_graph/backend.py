"""Pose-graph back-end: optimise the trajectory from odometry and loop closures."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
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
        self._waiting: list[tuple[LoopClosure, tuple[int, int] | None]] = []  # with session and stamp since when
        self._held: list[PlacedClosure] = []
        self._settled = False
        self._placed: set[tuple[int, int, int, int, bytes]] = set()
        self._refused: list[ClosureVerdict] = []
        self.counts: Counter[str] = Counter()

    def retune(self, settings: PoseGraphSettings) -> None:
        """Use other gates from now on; the odometry noise model stays."""
        self._settings, self._ordered, self._settled = settings, None, False
        self._rejection.retune(settings)

    def begin_session(self) -> None:
        """Start a new odometry chain with its own gauge; later odometry belongs to it."""
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

    def add_absolute(self, measurement: AbsoluteMeasurement) -> None:
        """Add an absolute measurement, in any order; `update` decides about it."""
        self._settled = False
        self.reference.add(measurement)

    def add_closure(self, closure: LoopClosure) -> list[ClosureVerdict]:
        """Add a closure; return every verdict that it caused or changed."""
        return self.add_closures([closure])

    def add_closures(self, closures: list[LoopClosure]) -> list[ClosureVerdict]:
        """Add several closures with a single, rough optimisation; see `add_closure`."""
        self._refresh()
        refused = [verdict for closure in closures if (verdict := self._receive(closure))]
        decided, known = self._decide(), {id(closure) for closure in closures}
        return refused + [verdict for verdict in self._pending() if id(verdict.closure) in known] + decided

    def hold(self, closure: LoopClosure) -> None:
        """Add a closure with an earlier verdict, which `resume` restores."""
        self._refresh()
        self._receive(closure)
        self._held += self._take_waiting()[1]

    def resume(self, verdicts: Mapping[tuple[int, int], Decision]) -> None:
        """Restore the earlier verdicts of the held closures, by the stamps of match and query.

        Closures without a verdict, and closures that share both stamps, are decided again.
        """
        self._refresh()
        held, self._held = self._held + self._take_waiting()[1], []
        times, decided, new = Counter(placed.closure.pair for placed in held), [], []
        for placed in held:
            pair = placed.closure.pair
            decision = verdicts.get(pair) if times[pair] == 1 else None
            if decision is None or decision[0] is State.REFUSED or decision[1] is ClosureReason.NO_ODOMETRY_YET:
                new.append(placed)
            else:
                decided.append((placed, decision))
        if decided:
            self._attempt(lambda: self._rejection.resume(decided))
        for placed in new:
            self._attempt(lambda: self._rejection.consider([placed]))  # noqa: B023 (called at once)
        self._attempt(lambda: self.reference.decide(self._sessions, self._rejection.solve))

    def update(self, exactly: bool = True) -> list[ClosureVerdict]:
        """Decide about measurements whose odometry has arrived, and solve the map exactly; return new verdicts."""
        verdicts = self._decide()
        self._attempt(lambda: self.reference.decide(self._sessions, self._rejection.solve))
        if exactly:
            self._attempt(self._rejection.refine)
        return verdicts

    def _decide(self) -> list[ClosureVerdict]:
        """Decide about closures whose odometry has arrived."""
        self._refresh()
        refused, arrived = self._take_waiting()
        return refused + self._attempt(lambda: self._rejection.consider(arrived))

    def prepare(self, within_s: float) -> None:
        """Do part of the work of `settle` within a time limit; after a long mission it takes minutes."""
        self._refresh()
        last_ns = [chain.stamps[-1:] for chain in self._sessions.chains]

        def has_odometry_beyond(one: PlacedClosure) -> bool:
            ends = (one.match, one.closure.match_stamp_ns), (one.query, one.closure.query_stamp_ns)
            return all((last_ns[session] > stamp_ns).all() for session, stamp_ns in ends)

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
        verdicts = self.update()
        if self._settled:  # no input since
            return verdicts
        before = self._rejection
        if not self._reprocess(within_s) or self._ordered is None:
            return None
        (_, self._sessions, self._rejection), self._ordered = self._ordered, None
        rows = {id(placed): row for row, placed in enumerate(self._rejection.placed)}
        for row in before.by_hand:
            again, state = rows[id(before.placed[row])], before.verdicts[row].state
            self._attempt(lambda: self._rejection.decide_by_hand(again, state))  # noqa: B023 (called at once)
        states = {id(placed): verdict.state for placed, verdict in zip(before.placed, before.verdicts, strict=True)}
        after = zip(self._rejection.placed, self._rejection.verdicts, strict=True)
        verdicts += [verdict for placed, verdict in after if verdict.state is not states[id(placed)]]
        verdicts += self._attempt(self._rejection.settle)
        for _ in range(3):  # the map moved by measurements may contradict others
            self._attempt(lambda: self.reference.decide(self._sessions, self._rejection.solve, at_last=True))
        if self._sessions.solution is not None:
            self._attempt(lambda: self._sessions.refine(self._rejection.accepted))
        self._settled = True
        return verdicts

    def _reprocess(self, within_s: float, is_ready: Callable[[PlacedClosure], bool] = lambda _: True) -> bool:
        """Decide again, from the odometry alone, by the stamps of query and match; return false if out of time."""
        until_s = time.monotonic() + within_s
        order = sorted(self._rejection.placed, key=lambda placed: placed.closure.pair[::-1])
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

        Raises:
            GraphError: there is no such closure, or the graph cannot be solved so; then nothing has changed.
        """
        pairs = [placed.closure.pair for placed in self._rejection.placed]
        rows = [row for row, pair in enumerate(pairs) if pair == (match_stamp_ns, query_stamp_ns)]
        self._settled = False
        if not rows:
            raise GraphError(f"no closure between keyframes {match_stamp_ns} and {query_stamp_ns}")
        return [verdict for row in rows for verdict in self._rejection.decide_by_hand(row, state)]

    def _receive(self, closure: LoopClosure) -> ClosureVerdict | None:
        """Queue a closure; return the verdict of an unusable one."""
        try:
            check_closure(closure, self._settings.max_closure_m)
        except GraphError as error:
            return self._refuse(closure, error.args[0])
        self._waiting.append((closure, self._now))
        return None

    @property
    def _now(self) -> tuple[int, int] | None:
        """Newest session with odometry, and its last stamp: other sessions may be of another clock."""
        return next(((one, int(self._sessions.chains[one].stamps[-1])) for one in self._sessions.begun[::-1]), None)

    def _refuse(self, closure: LoopClosure, reason: ClosureReason) -> ClosureVerdict:
        self.counts[f"closure refused: {reason}"] += 1
        self._refused.append(ClosureVerdict(closure, State.REFUSED, reason))
        return self._refused[-1]

    def _take_waiting(self) -> tuple[list[ClosureVerdict], list[PlacedClosure]]:
        """Return refusals of closures that were pending too long, and closures whose odometry has arrived."""
        refused, arrived, waiting = [], [], []
        oldest_ns, now = min((span[0] for span in self.session_spans() if span), default=None), self._now
        for closure, known in self._waiting:
            since = known if known and now and known[0] == now[0] else now
            waited_s = 0.0 if now is None or since is None else (now[1] - since[1]) / 1e9
            query = self._sessions.find(closure.query_stamp_ns)
            match = self._sessions.find(closure.match_stamp_ns, before=query)
            if query is not None and match is not None:
                # two measurements of one pair are two closures; an equal one is a repeated latched message
                key = match, query, *closure.pair, closure.match_T_query.tobytes()
                if key in self._placed:
                    self.counts["closure twice"] += 1
                    continue
                self._placed.add(key)
                self._settled = False
                arrived.append(PlacedClosure(match, query, closure))
            elif waited_s > self._settings.max_gap_s and oldest_ns is not None and min(closure.pair) < oldest_ns:
                refused.append(self._refuse(closure, ClosureReason.BEFORE_ODOMETRY))
            elif waited_s > self._settings.max_pending_s:
                refused.append(self._refuse(closure, ClosureReason.NO_ODOMETRY))
            else:
                waiting.append((closure, since))
        self._waiting = waiting
        return refused, arrived

    def closures(self) -> list[ClosureVerdict]:
        """Return the latest verdict of every closure, in order of arrival."""
        return self._rejection.verdicts + self._pending() + self._refused

    def _pending(self) -> list[ClosureVerdict]:
        """Return verdicts of closures whose odometry has not arrived."""
        return [ClosureVerdict(one, State.PENDING, ClosureReason.NO_ODOMETRY_YET) for one, _ in self._waiting]

    @property
    def scale(self) -> NoiseScale:
        """Estimated factors of the true standard deviations over the stated ones."""
        return self._rejection.scale

    def verdict_counts(self) -> Counter[State]:
        """Return the number of closures by state."""
        return Counter(verdict.state for verdict in self.closures())

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
            covered = ~known & np.fromiter((chain.covers(stamp) for stamp in stamps.tolist()), bool, len(stamps))
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
