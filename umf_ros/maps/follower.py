"""A rover in a map that stays as it is, asked like a pose graph: what the live back-end runs in mode localization."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Settings
from umf_ros.core.errors import GraphError, writing
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.maps.localizer import Localization, Localizer
from umf_ros.maps.outputs import read_poses
from umf_ros.pose_graph.closures import ClosureReason, ClosureVerdict, State
from umf_ros.sensors.sessions import OdometrySessionSplitter, Reset

Stamps = NDArray[np.int64]
_SPACING_M = 0.25


class MapFollower:
    """Follows a rover through a map; nothing is kept but where it went.

    It answers what `DurableGraph` and its graph answer, so that the back-end is the same node in both modes.

    Args:
        settings: all settings, mode localization.

    Attributes:
        feed: the way of the odometry into it.
        counts: odometry messages and closures, by what became of them.

    Raises:
        UmfError: there is no such map, or it has not been solved.
    """

    taken_up = changed = 0
    unsettled = False

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._begin()

    @property
    def graph(self) -> MapFollower:
        """Itself: there is no graph behind it."""
        return self

    @property
    def probability(self) -> float:
        """That the rover is where it is said to be; 0 while that is unknown."""
        found = self._localizer.estimate()
        return 0.0 if found is None else found.probability

    def take_odometry(self, stamp_ns: int, odom_T_body: Array) -> Reset | None:
        """Take one message; returns why a new session has begun with it."""
        reset = self.feed.take(stamp_ns, odom_T_body)
        found = self._localizer.estimate()
        if found is not None:
            self._follow(found)
        return reset

    def add_closure(self, closure: LoopClosure) -> list[ClosureVerdict]:
        """Take a closure with the map; returns what came of it."""
        before = Counter(self._localizer.counts)
        self._localizer.add_closure(closure)
        change = Counter(self._localizer.counts) - before
        verdict = _verdict(closure, next(iter(change), ""))
        self._verdicts[verdict.state] += 1
        return [verdict]

    def update(self) -> list[ClosureVerdict]:
        """There is nothing that waits for a decision."""
        return []

    def prepare(self, within_s: float) -> None:
        """There is nothing to settle."""

    def revoke(self, match_ns: int, query_ns: int) -> list[ClosureVerdict]:
        """No closure stays, so none can be taken out.

        Raises:
            GraphError: always.
        """
        raise GraphError("a map that stays as it is keeps no closures to reject")

    def end(self) -> None:
        """Forget the pose: the rover may be anywhere."""
        self._begin()

    def close(self) -> None:
        """There is nothing to let go of."""

    def retune(self, settings: object) -> None:
        """Gates are those of the start."""

    def map_T_odom(self) -> Array | None:
        """(4, 4) pose of the odometry's frame in the map; None while it is unknown."""
        return self._localizer.map_T_odom()

    def covariance(self) -> Array:
        """(6, 6) of the newest pose in ROS order; zero while it is unknown."""
        found = self._localizer.estimate()
        return np.zeros((6, 6)) if found is None else found.covariance

    def trajectory(self) -> tuple[Stamps, Array]:
        """Stamps (N,) in ns and `map_T_body` (N, 4, 4) where the rover went since it was found."""
        stamps = np.array([one.stamp_ns for one in self._way], np.int64)
        return stamps, np.array([one.map_T_body for one in self._way]).reshape(-1, 4, 4)

    def closures(self) -> list[ClosureVerdict]:
        """None are kept."""
        return []

    def closure_lines(self) -> tuple[list[ClosureVerdict], Array]:
        """None are drawn."""
        return [], np.empty((0, 2, 3))

    def verdict_counts(self) -> Counter[State]:
        """How many closures had which verdict."""
        return Counter(self._verdicts)

    def write_results(self, folder: str | Path, within_s: float = float("inf")) -> bool:
        """Write where the rover went, `trajectory_in_map.tum`; there is always the time for that.

        Raises:
            OutputError: it cannot be written.
        """
        stamps, poses = self.trajectory()
        with writing(f"to {folder}"):
            Path(folder).mkdir(parents=True, exist_ok=True)
        write_tum(Path(folder) / "trajectory_in_map.tum", Trajectory(stamps, poses))
        return True

    def _begin(self) -> None:
        self._localizer = Localizer(read_poses(Path(self._settings.map)), self._settings.pose_graph)
        self.feed = OdometrySessionSplitter(self._localizer)
        self._way: list[Localization] = []
        self._verdicts: Counter[State] = Counter()
        self.counts: Counter[str] = Counter()

    def _follow(self, found: Localization) -> None:
        """Note a pose that lies far enough from the last."""
        last = self._way[-1].map_T_body[:3, 3] if self._way else np.full(3, np.inf)
        if np.linalg.norm(found.map_T_body[:3, 3] - last) >= _SPACING_M:
            self._way.append(found)


def _verdict(closure: LoopClosure, fate: str) -> ClosureVerdict:
    """A closure by what the localizer did with it."""
    state, reason = {
        "agreed": (State.ACCEPTED, ClosureReason.AGREES_WITH_POSE),
        "contradicted": (State.REJECTED, ClosureReason.CONTRADICTS_POSE),
        "searching": (State.PENDING, ClosureReason.POSE_UNKNOWN),
        "unusable": (State.REFUSED, ClosureReason.NOT_OF_MAP),
    }.get(fate, (State.PENDING, ClosureReason.NO_ODOMETRY_YET))
    return ClosureVerdict(closure, state, reason)
