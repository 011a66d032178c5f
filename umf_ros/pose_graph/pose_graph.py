"""PoseGraph: odometry and loop closures in, one trustworthy trajectory out."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError, writing
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, gtsam_to_ros_covariance, invert
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.pose_graph.closures import (
    ClosureVerdict,
    Decision,
    State,
    TrackedClosure,
    WaitingClosure,
    check_closure,
    check_covariance,
    check_pose,
)
from umf_ros.pose_graph.g2o import verdict_table, write_g2o, write_vertex_table
from umf_ros.pose_graph.noise_scale import NoiseScale
from umf_ros.pose_graph.odometry import OdometryChain, Stamps
from umf_ros.pose_graph.rejection import OutlierRejection
from umf_ros.pose_graph.reprocess import Reprocessing, in_order
from umf_ros.pose_graph.sessions import Sessions

logger = logging.getLogger(__name__)
_NO_ODOMETRY_YET = "its odometry has not arrived"
_BEFORE_ODOMETRY = "no odometry at its keyframes: it began later"


class PoseGraph:
    """Takes odometry and loop closures in any order and keeps the best trajectory they allow.

    Nothing that arrives can break it: what is unusable is refused with a reason and counted.
    """

    def __init__(self, settings: PoseGraphSettings | None = None) -> None:
        self._settings = settings or PoseGraphSettings()
        self._sessions = Sessions(self._settings)
        self._rejection = OutlierRejection(self._settings, self._sessions)
        self._retrial: Reprocessing | None = None
        self._waiting: list[WaitingClosure] = []
        self._held: list[TrackedClosure] = []
        self._settled = False
        self._seen: set[tuple[int, int, bytes]] = set()
        self._placed: set[tuple[int, int, int, int, bytes]] = set()
        self._refused: list[ClosureVerdict] = []
        self.counts: Counter[str] = Counter()

    def retune(self, settings: PoseGraphSettings) -> None:
        """Judge by other gates from now on; the model of the odometry's noise stays."""
        self._settings, self._retrial, self._settled = settings, None, False
        self._rejection.retune(settings)

    def begin_session(self) -> None:
        """Start a new odometry chain with its own gauge; later odometry belongs to it."""
        self._sessions.begin()
        self._seen.clear()  # a looped recording closes the same loops again, between the same stamps

    def add_odometry(self, stamp_ns: int, odom_T_body: Array, covariance: Array | None = None) -> bool:
        """Take one odometry message; any order, a second message of one stamp is dropped.

        Args:
            stamp_ns: its stamp.
            odom_T_body: (4, 4) pose.
            covariance: (6, 6) in ROS order of the motion since the previous message, axes of the
                previous body; None: the settings' odometry model.

        Returns:
            False when the message was refused and counted.
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

    def add_closure(self, closure: LoopClosure) -> list[ClosureVerdict]:
        """Take one closure; returns every verdict that it brought about or changed."""
        return self.add_closures([closure])

    def add_closures(self, closures: list[LoopClosure]) -> list[ClosureVerdict]:
        """Take several closures with a single optimisation; see `add_closure`."""
        self._refresh()
        verdicts = [verdict for closure in closures if (verdict := self._receive(closure))]
        return verdicts + self.update()

    def hold(self, closure: LoopClosure) -> None:
        """Take one closure that was decided about before; `resume` puts it where it was."""
        self._refresh()
        self._receive(closure)
        self._held += self._take_waiting()[1]

    def resume(self, verdicts: Mapping[tuple[int, int], Decision]) -> bool:
        """Give the closures that are held the verdicts that they had, and decide about those that had none.

        Args:
            verdicts: by the stamps of match and query.

        Returns:
            False when two closures go by the same stamps, so that the verdicts do not tell: nothing is done.
        """
        self._refresh()
        held, self._held = self._held + self._take_waiting()[1], []
        stamps = [(tracked.closure.match_stamp_ns, tracked.closure.query_stamp_ns) for tracked in held]
        if len(set(stamps)) < len(stamps):
            return False
        decided, new = [], []
        for pair, tracked in zip(stamps, held, strict=True):
            decision = verdicts.get(pair)
            if decision is None or decision[0] not in (State.ACCEPTED, State.REJECTED, State.UNDECIDED):
                new.append(tracked)
            else:
                tracked.decide(*decision)
                decided.append(tracked)
        self._attempt(lambda: self._rejection.resume(decided))
        if new:
            self._attempt(lambda: self._rejection.consider(new))
        return True

    def update(self) -> list[ClosureVerdict]:
        """Take in odometry that has arrived and decide about closures that waited for it; returns new verdicts."""
        self._refresh()
        verdicts, arrived = self._take_waiting()
        return verdicts + self._attempt(lambda: self._rejection.consider(arrived))

    def prepare(self, within_s: float) -> None:
        """Do a part of what `settle` will have to do, for so long at most."""
        self._refresh()
        order = in_order(self._rejection.closures)
        trial = self._trial(order)
        trial.go_on(trial.ripe(order), self._attempt, within_s)

    def settle(self, within_s: float = float("inf")) -> list[ClosureVerdict] | None:
        """Come to the final decision and the exact optimum, as at the end of a mission.

        All closures are decided anew in order of their stamps, so that the time of arrival leaves no trace: a
        live run and a replay end with the same verdicts. Closures that could not be judged are accepted if
        nothing speaks against them.

        Returns:
            The verdicts that changed; None when the time was up first, and all is as it was.
        """
        verdicts = self.update()
        if self._settled:  # nothing has come since
            return verdicts
        order = in_order(self._rejection.closures)
        trial, revoked = self._trial(order), self._rejection.revoked
        if not trial.go_on(order, self._attempt, within_s):
            return None
        self._sessions, self._rejection, self._retrial = trial.sessions, trial.rejection, None
        for closure in revoked:
            self.revoke(closure.match_stamp_ns, closure.query_stamp_ns)
        verdicts += trial.changed() + self._attempt(self._rejection.settle)
        self._settled = True
        return verdicts

    def _trial(self, order: list[TrackedClosure]) -> Reprocessing:
        """The trial anew of closures, as far as it has come."""
        if self._retrial is None or not self._retrial.holds(order, self._sessions):
            self._retrial = Reprocessing(self._settings, self._sessions)
        return self._retrial

    def _refresh(self) -> None:
        if self._sessions.update():
            self.counts["odometry out of order"] += 1
            self._retrial = None
            self._attempt(self._rejection.renew)

    def _attempt(self, step: Callable[[], list[ClosureVerdict]]) -> list[ClosureVerdict]:
        """Run a step that solves; a failure of the optimiser is counted and the last trajectory stays."""
        try:
            return step()
        except GraphError as error:
            self.counts[f"optimiser: {error}"] += 1
            logger.warning("%s; the last trajectory stays", error)
            return []

    def revoke(self, match_stamp_ns: int, query_stamp_ns: int) -> list[ClosureVerdict]:
        """Take every closure between two keyframes out for good.

        Raises:
            GraphError: there is no such closure, or the graph cannot be solved without it.
        """
        endpoints = (match_stamp_ns, query_stamp_ns)
        closures = enumerate(tracked.closure for tracked in self._rejection.closures)
        rows = [row for row, closure in closures if (closure.match_stamp_ns, closure.query_stamp_ns) == endpoints]
        self._settled = False
        if not rows:
            raise GraphError(f"no closure between keyframes {match_stamp_ns} and {query_stamp_ns}")
        return [verdict for row in rows for verdict in self._rejection.revoke(row)]

    def _receive(self, closure: LoopClosure) -> ClosureVerdict | None:
        try:
            covariance = check_closure(closure, self._settings.max_closure_m)
        except GraphError as error:
            return self._refuse(closure, str(error))
        # two measurements of one pair are two closures; the same one again is a message sent twice
        message = (closure.match_stamp_ns, closure.query_stamp_ns, closure.match_T_query.tobytes())
        if message in self._seen:
            self.counts["closure twice"] += 1
            return None
        self._seen.add(message)
        self._settled = False
        self._waiting.append(WaitingClosure(closure, covariance, self._sessions.newest_ns))
        return None

    def _refuse(self, closure: LoopClosure, reason: str) -> ClosureVerdict:
        self.counts[f"closure refused: {reason}"] += 1
        self._refused.append(ClosureVerdict(closure, State.REFUSED, reason))
        return self._refused[-1]

    def _take_waiting(self) -> tuple[list[ClosureVerdict], list[TrackedClosure]]:
        """Closures whose odometry is there, and verdicts about the others."""
        verdicts, arrived, waiting = [], [], []
        newest_ns = self._sessions.newest_ns
        for entry in self._waiting:
            tracked = self._locate(entry)
            waited_ns = entry.waited_ns(newest_ns)
            if tracked is not None:
                if self._is_new(tracked):
                    arrived.append(tracked)
            elif waited_ns > self._settings.max_gap_s * 1e9 and self._precedes_all(entry.closure):
                verdicts.append(self._refuse(entry.closure, _BEFORE_ODOMETRY))
            elif waited_ns > self._settings.max_pending_s * 1e9:
                verdicts.append(self._refuse(entry.closure, "no odometry at its keyframes"))
            else:
                if not entry.announced:
                    entry.announced = True
                    verdicts.append(ClosureVerdict(entry.closure, State.WAITING, _NO_ODOMETRY_YET))
                waiting.append(entry)
        self._waiting = waiting
        return verdicts, arrived

    def _is_new(self, tracked: TrackedClosure) -> bool:
        """Whether no closure like this joins the same sessions: a latched topic tells its history again."""
        closure = tracked.closure
        stamps = closure.match_stamp_ns, closure.query_stamp_ns
        key = tracked.match, tracked.query, *stamps, closure.match_T_query.tobytes()
        if key in self._placed:
            self.counts["closure twice"] += 1
            return False
        self._placed.add(key)
        return True

    def _precedes_all(self, closure: LoopClosure) -> bool:
        """Whether a keyframe is older than all odometry: this graph began later, and hears of that no more."""
        oldest_ns = self._sessions.oldest_ns
        return oldest_ns is not None and min(closure.match_stamp_ns, closure.query_stamp_ns) < oldest_ns

    def _locate(self, entry: WaitingClosure) -> TrackedClosure | None:
        query = self._sessions.find(entry.closure.query_stamp_ns)
        match = self._sessions.find(entry.closure.match_stamp_ns, before=query)
        if query is None or match is None:
            return None
        return TrackedClosure(match, query, ClosureVerdict(entry.closure, State.UNDECIDED, "new"), entry.covariance)

    def closures(self) -> list[ClosureVerdict]:
        """The latest verdict of every closure, in order of arrival."""
        waiting = [ClosureVerdict(w.closure, State.WAITING, _NO_ODOMETRY_YET) for w in self._waiting]
        return [tracked.verdict for tracked in self._rejection.closures] + waiting + self._refused

    @property
    def scale(self) -> NoiseScale:
        """By how much the true standard deviations are estimated to exceed the stated ones."""
        return self._rejection.scale

    def verdict_counts(self) -> Counter[State]:
        """How many closures have which verdict."""
        return Counter(verdict.state for verdict in self.closures())

    def trajectory(self) -> tuple[Stamps, Array]:
        """Stamps (N,) in ns and `map_T_body` (N, 4, 4) of every keyframe that is joined to the map."""
        return self._keyframes(lambda session, chain: self._sessions.at(session, chain.stamps))

    def poses_at(self, stamps: Stamps) -> tuple[Array, NDArray[np.bool_]]:
        """(N, 4, 4) `map_T_body` at stamps, in the frame of the largest part of the map, and (N,) whether it has them.

        The sessions of that part share its frame: that of the earliest of them.
        """
        self._refresh()
        poses, known = np.tile(np.eye(4), (len(stamps), 1, 1)), np.zeros(len(stamps), bool)
        for session in self.sessions_of_map():
            chain = self._sessions.chains[session]
            mine = ~known & np.fromiter((chain.covers(stamp) for stamp in stamps.tolist()), bool, len(stamps))
            if mine.any():
                poses[mine] = self._sessions.at(session, stamps[mine])
                known |= mine
        return poses, known

    def sessions_of_map(self) -> list[int]:
        """Numbers of the sessions in the largest part of the map, by the order in which they began."""
        return self._sessions.members(self._sessions.largest)

    def session_spans(self) -> list[tuple[int, int] | None]:
        """First and last stamp of the odometry of every session; None without any."""
        self._refresh()
        chains = self._sessions.chains
        spans = ((chain.oldest_ns, chain.newest_ns) for chain in chains)
        return [None if first is None or last is None else (first, last) for first, last in spans]

    def odometry(self) -> tuple[Stamps, Array]:
        """Stamps (N,) in ns and `odom_T_body` (N, 4, 4) of the same keyframes as `trajectory`."""
        return self._keyframes(lambda _, chain: chain.poses)

    def _keyframes(self, poses_of: Callable[[int, OdometryChain], Array]) -> tuple[Stamps, Array]:
        self._refresh()
        chains = [(session, self._sessions.chains[session]) for session in self._sessions.joined]
        stamps = [np.empty(0, np.int64), *(chain.stamps for _, chain in chains)]
        return np.concatenate(stamps), np.concatenate([np.empty((0, 4, 4)), *(poses_of(*one) for one in chains)])

    def map_T_odom(self) -> Array:
        """(4, 4) pose of the newest session's odometry frame in the map: where its newest pose went."""
        self._refresh()
        chain = self._sessions.chains[-1]
        if not len(chain.stamps):
            return np.eye(4)
        last = np.array([chain.newest_ns])
        return self._sessions.at(len(self._sessions.chains) - 1, last)[0] @ invert(chain.poses_at(last)[0])

    def covariance(self) -> Array:
        """(6, 6) marginal covariance of the newest pose in ROS order about the map's axes; zero without odometry."""
        self._refresh()
        session = len(self._sessions.chains) - 1
        last = self._sessions.chains[session].newest_ns
        if last is None:
            return np.zeros((6, 6))
        covariance = self._sessions.covariance(session, last, self._rejection.scale)
        return gtsam_to_ros_covariance(covariance, self._sessions.at(session, np.array([last]))[0])

    def write_tum(self, path: str | Path, optimized: bool = True) -> None:
        """Write the trajectory, or the odometry, of all joined sessions in order of their stamps as a TUM file.

        Raises:
            OutputError: the file cannot be written.
        """
        stamps, poses = self.trajectory() if optimized else self.odometry()
        order = np.argsort(stamps, kind="stable")
        write_tum(path, Trajectory(stamps[order], poses[order]))

    def closure_lines(self) -> tuple[list[ClosureVerdict], Array]:
        """Verdicts of the N closures with known endpoints, and (N, 2, 3) map positions of match and query."""
        self._refresh()
        return [tracked.verdict for tracked in self._rejection.closures], self._rejection.endpoint_positions()

    def write_g2o(self, path: str | Path, planar: bool = False, vertex_of: Callable[[int], int] | None = None) -> None:
        """Write keyframes, odometry and accepted closures, with the covariances that the solution used.

        Args:
            path: the file.
            planar: two-dimensional.
            vertex_of: gives the vertex id of a stamp; None counts from 0 and writes `<name>.csv` beside the
                file, with vertex, session and stamp.

        Raises:
            OutputError: a file cannot be written.
        """
        self._refresh()
        endpoints = [self._rejection.endpoints_in(session) for session in range(len(self._sessions.chains))]
        full = self._sessions.expand(self._rejection.accepted, endpoints, self._rejection.scale)
        ids = [row if vertex_of is None else vertex_of(stamp) for row, (_, stamp) in enumerate(full.vertices)]
        write_g2o(path, full.poses, [full.edges[row] for row in range(len(full.edges))], planar, ids)
        if vertex_of is None:
            write_vertex_table(Path(path).with_suffix(".csv"), full.vertices)

    def write_results(self, folder: str | Path, within_s: float = float("inf")) -> bool:
        """Settle, and write trajectories (TUM), the graph (g2o and id-stamp table) and all verdicts (CSV).

        Returns:
            Whether there was time to settle; otherwise all is written as it stands.

        Raises:
            OutputError: the folder cannot be written.
        """
        folder = Path(folder)
        settled = self.settle(within_s) is not None
        with writing(f"to {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "graph_verdicts.csv").write_text(verdict_table(self.closures()), encoding="utf-8")
        self.write_tum(folder / "trajectory_odometry.tum", optimized=False)
        self.write_tum(folder / "trajectory_optimized.tum")
        self.write_g2o(folder / "graph.g2o")
        return settled
