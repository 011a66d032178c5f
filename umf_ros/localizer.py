"""Localisation in a fixed map: closures with the map give the pose, odometry propagates it."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, inf, log
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from umf_ros.absolute.measurement import AbsoluteMeasurement
from umf_ros.core.config import PoseGraphSettings, Settings
from umf_ros.core.errors import GraphError, writing
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import (
    Array,
    adjoint,
    expmap,
    gtsam_to_ros_covariance,
    invert,
    logmap,
    near,
    propagate,
    relative,
    ros_to_gtsam_covariance,
)
from umf_ros.core.odometry_noise import OdometryNoise
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.map_poses import InitialPose, MapPoses
from umf_ros.pose_graph.backend import MAX_WAITING, Key, PoseGraph
from umf_ros.pose_graph.closures import ClosureReason, ClosureVerdict, State, check_closure, check_pose

ACCEPTED_ODDS = log(0.999 / 0.001)
"""Least odds of a reported pose, nats (*by hand*: one wrong in a thousand)."""
_MOST_PER_CLOSURE = log(0.99 / 0.01)
# neighbouring places look like the same wrong place: consecutive closures count by the path length between them
_NATS_PER_M = 1.0
_MOST_ODDS, _LEAST_ODDS = 12.0, -3.0
_MOST_HYPOTHESES = 8
_KEPT_MESSAGES = 3000
_SAME_M, _SAME_RAD = 0.5, 0.1
# lower bound of the uncertainty of the poses in the map
_MAP_SIGMAS = np.array([0.005, 0.005, 0.005, 0.05, 0.05, 0.05])
_SPACING_M = 0.25


class Localization(NamedTuple):
    """A pose in the map.

    Attributes:
        stamp_ns: of the pose.
        map_T_body: (4, 4).
        covariance: (6, 6) in ROS order about the map's axes.
        probability: that the rover is not at a similar place elsewhere.
    """

    stamp_ns: int
    map_T_body: Array
    covariance: Array
    probability: float


class _Sample(NamedTuple):
    """An odometry message, and the path length up to it in m, turns included."""

    stamp_ns: int
    pose: Array
    path_m: float


@dataclass(eq=False)
class _PoseHypothesis:
    """A pose that the rover may have at a sample of the odometry.

    Attributes:
        at: the sample.
        pose: (4, 4) `map_T_body`.
        covariance: (6, 6) in the tangent space of the body, rotation first.
        odds: of the hypothesis, nats.
        counted_m: path length at the latest closure that counted.
    """

    at: _Sample
    pose: Array
    covariance: Array
    odds: float
    counted_m: float


class Localizer(PoseGraph):
    """Localisation in a fixed map by pose hypotheses from closures and odometry, with the interface of a pose graph.

    A closure that agrees with no hypothesis adds one, and so does an initial pose, which counts as one closure. Later
    closures agree with a hypothesis or contradict it, within the covariances of closure and odometry, and change its
    odds by the path length between them. The pose is that of the accepted hypothesis until another one is accepted, so
    a kidnapped rover is relocalised. Closures are counted and not kept.

    `poses` are those of the map's keyframes, by the stamps that closures name as their match.

    Attributes:
        relocalised: number of times that a hypothesis was accepted.
        reasons: number of closures by the reason of their verdict, those without odometry left out.
    """

    def __init__(self, poses: Trajectory, settings: PoseGraphSettings) -> None:
        super().__init__(settings)
        self._map = dict(zip(poses.stamps_ns.tolist(), poses.poses, strict=True))
        self._noise = OdometryNoise.stated(settings)
        self._path: list[Localization] = []
        self.relocalised = 0
        self.reasons: Counter[ClosureReason] = Counter()
        self._decided: list[ClosureVerdict] = []
        self._initial: InitialPose | None = None
        self.begin_session()

    def begin_session(self) -> None:
        """Delete all hypotheses: the odometry restarts at any place."""
        self._samples: deque[_Sample] = deque(maxlen=_KEPT_MESSAGES)
        self._early: deque[LoopClosure] = deque(maxlen=50)
        self._received: dict[Key, None] = {}
        self._hypotheses: list[_PoseHypothesis] = []
        self._accepted: _PoseHypothesis | None = None

    def expect(self, initial: InitialPose) -> None:
        """Add a pose that the rover may have now, or at its first odometry, with the odds of one closure."""
        if not self._samples:
            self._initial = initial
            return
        self._initial = None
        pose, covariance = initial.map_T_body, ros_to_gtsam_covariance(initial.covariance, initial.map_T_body)
        self._hypotheses.append(_PoseHypothesis(self._samples[-1], pose, covariance, _MOST_PER_CLOSURE, -inf))

    def add_odometry(self, stamp_ns: int, odom_T_body: Array, covariance: Array | None = None) -> bool:
        """Add an odometry message; return whether it was usable."""
        try:
            check_pose(odom_T_body)
        except GraphError:
            return False
        path_m = 0.0
        if self._samples:
            last = self._samples[-1]
            if stamp_ns <= last.stamp_ns:
                return False
            # a stationary rover gathers no evidence
            path_m = last.path_m + float(self._noise.path_lengths(last.pose[None], odom_T_body[None], np.zeros(1))[0])
        self._samples.append(_Sample(stamp_ns, np.asarray(odom_T_body, float), path_m))
        if self._initial is not None:
            self.expect(self._initial)
        for _ in range(len(self._early)):
            decided = self._add(self._early.popleft())
            self._decided += [verdict for verdict in decided if verdict.reason is not ClosureReason.NO_ODOMETRY_YET]
        found = self.estimate()
        if found is not None:
            before = self._path[-1].map_T_body[:3, 3] if self._path else np.full(3, np.inf)
            if np.linalg.norm(found.map_T_body[:3, 3] - before) >= _SPACING_M:
                self._path.append(found)
        return True

    def add_absolute(self, measurement: AbsoluteMeasurement) -> None:
        """Count a measurement; the map stays unchanged."""
        self.counts["absolute measurements unused"] += 1

    def receive(self, closures: Sequence[LoopClosure]) -> list[ClosureVerdict]:
        """Add closures with keyframes of the map; return the verdicts of new ones, repeated ones are counted only."""
        verdicts: list[ClosureVerdict] = []
        for closure in closures:
            key = *closure.pair, closure.match_T_query.tobytes()
            verdicts += [] if key in self._received else self._add(closure)
            self.counts["closure twice"] += key in self._received
            self._received[key] = None
            if len(self._received) > MAX_WAITING:
                del self._received[next(iter(self._received))]
        return verdicts

    def decide(self, within_s: float = float("inf")) -> list[ClosureVerdict]:
        """Return no verdicts: `receive` decides at once."""
        return []

    def _add(self, closure: LoopClosure) -> list[ClosureVerdict]:
        if self._samples and closure.query_stamp_ns > self._samples[-1].stamp_ns:
            self._early.append(closure)
            return [ClosureVerdict(closure, State.PENDING, ClosureReason.NO_ODOMETRY_YET)]
        reason = self._judge(closure)
        self.reasons[reason] += 1
        return [ClosureVerdict(closure, _STATES[reason], reason)]

    def update(self, exactly: bool = True, within_s: float = float("inf")) -> list[ClosureVerdict]:
        """Return the verdicts on closures whose odometry has arrived since the last call."""
        decided, self._decided = self._decided, []
        return decided

    def estimate(self) -> Localization | None:
        """Return the pose at the newest odometry; None while it is unknown."""
        if self._accepted is None or not self._samples:
            return None
        return self._localization(self._accepted, self._samples[-1])

    @property
    def probability(self) -> float:
        """Probability of the pose; 0 while it is unknown."""
        found = self.estimate()
        return 0.0 if found is None else found.probability

    def map_T_odom(self) -> Array | None:
        """Return (4, 4) pose of the odometry's frame in the map; None while it is unknown."""
        known = self._accepted
        return None if known is None else known.pose @ invert(known.at.pose)

    def covariance(self) -> Array:
        """Return (6, 6) of the newest pose in ROS order; zero while it is unknown."""
        found = self.estimate()
        return np.zeros((6, 6)) if found is None else found.covariance

    def trajectory(self, optimized: bool = True) -> tuple[NDArray[np.int64], Array]:
        """Return stamps (N,) in ns and `map_T_body` (N, 4, 4) since the rover was localised, 0.25 m apart."""
        stamps = np.array([one.stamp_ns for one in self._path], np.int64)
        return stamps, np.array([one.map_T_body for one in self._path]).reshape(-1, 4, 4)

    def verdict_counts(self) -> Counter[State]:
        """Return the number of closures by state."""
        counts = Counter({State.PENDING: len(self._early)} if self._early else {})
        for reason, count in self.reasons.items():
            counts[_STATES[reason]] += count
        return counts

    def decide_by_hand(self, match_stamp_ns: int, query_stamp_ns: int, state: State) -> list[ClosureVerdict]:
        """Raise a `GraphError`: there is nothing to decide about."""
        raise GraphError("localisation in a fixed map keeps no closures to decide about")

    def add_by_hand(self, closure: LoopClosure) -> list[ClosureVerdict]:
        """Raise a `GraphError`: the evidence alone decides where the rover is."""
        return self.decide_by_hand(*closure.pair, State.ACCEPTED)

    def write_results(self, folder: Path, within_s: float = float("inf")) -> bool:
        """Write the trajectory, `trajectory_in_map.tum`; return true, as there is nothing to settle."""
        with writing(f"to {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
        write_tum(folder / "trajectory_in_map.tum", Trajectory(*self.trajectory()))
        return True

    def _judge(self, closure: LoopClosure) -> ClosureReason:
        """Compare the pose by a closure with every hypothesis, and add one if none agrees."""
        at, match = self._sample(closure.query_stamp_ns), self._map.get(closure.match_stamp_ns)
        try:
            check_closure(closure, self._settings.max_closure_m)
        except GraphError:
            at = None
        if at is None or match is None:
            return ClosureReason.NOT_OF_MAP
        pose = match @ closure.match_T_query
        covariance = ros_to_gtsam_covariance(closure.covariance, closure.match_T_query) + np.diag(_MAP_SIGMAS**2)
        gain = trust = min(_logit(closure.probability), _MOST_PER_CLOSURE)
        agreed = [one for one in self._hypotheses if self._correct(one, at, pose, covariance)]
        for one in agreed:
            gain = min(gain, _NATS_PER_M * max(at.path_m - one.counted_m, 0.0))
            one.counted_m = at.path_m
        for one in self._hypotheses:
            one.odds = min(one.odds + (gain if one in agreed else -gain), _MOST_ODDS)
        if not agreed:
            self._hypotheses.append(_PoseHypothesis(at, pose, covariance, trust, at.path_m))
        reason = ClosureReason.AGREES_WITH_POSE if self._accepted in agreed else ClosureReason.CONTRADICTS_POSE
        if self._accepted is None:
            reason = ClosureReason.POSE_UNKNOWN
        self._choose()
        return reason

    def _choose(self) -> None:
        """Keep the likeliest hypotheses, one per pose, and accept the best if its odds suffice."""
        kept: list[_PoseHypothesis] = []
        for one in sorted(self._hypotheses, key=lambda one: -one.odds):
            if one.odds > _LEAST_ODDS and not any(self._same(one, other) for other in kept):
                kept.append(one)
        self._hypotheses = kept[:_MOST_HYPOTHESES]
        best = kept[0] if kept else None
        if best is not None and best.odds >= ACCEPTED_ODDS and best is not self._accepted:
            self._accepted = best
            self.relocalised += 1
        elif self._accepted not in self._hypotheses:
            self._accepted = None

    def _correct(self, one: _PoseHypothesis, at: _Sample, pose: Array, covariance: Array) -> bool:
        """Correct a hypothesis by a measured pose that agrees with it (Kalman update); return whether it agrees."""
        expected, spread = self._propagated(one, at)
        miss = logmap(relative(expected, pose)[None])[0]
        if not float(miss @ np.linalg.solve(spread + covariance, miss)) <= self._settings.gate_chi2:
            return False
        gain = spread @ np.linalg.inv(spread + covariance)
        corrected = (np.eye(6) - gain) @ spread
        one.at, one.pose = at, expected @ expmap((gain @ miss)[None])[0]
        one.covariance = 0.5 * (corrected + corrected.T)
        return True

    def _propagated(self, one: _PoseHypothesis, at: _Sample) -> tuple[Array, Array]:
        """Return the pose and covariance of a hypothesis, propagated by odometry to another sample."""
        step = relative(one.at.pose, at.pose)
        path_m = abs(at.path_m - one.at.path_m)
        noise = self._noise.covariances(np.array([path_m]))[0]
        # an error of heading along the path is a translation at its end
        noise[3:, 3:] += noise[:3, :3] * path_m**2 / 3
        return one.pose @ step, propagate(adjoint(invert(step)), one.covariance) + noise

    def _same(self, one: _PoseHypothesis, other: _PoseHypothesis) -> bool:
        return near(self._propagated(other, one.at)[0], one.pose, _SAME_M, _SAME_RAD)

    def _localization(self, one: _PoseHypothesis, at: _Sample) -> Localization:
        pose, covariance = self._propagated(one, at)
        others = sum(exp(other.odds) for other in self._hypotheses if other is not one)
        probability = exp(one.odds) / (1 + exp(one.odds) + others)
        return Localization(at.stamp_ns, pose, gtsam_to_ros_covariance(covariance, pose), probability)

    def _sample(self, stamp_ns: int) -> _Sample | None:
        """Return the odometry at a stamp; None before the first message, or in a gap."""
        stamps = np.array([one.stamp_ns for one in self._samples], np.int64)
        odometry = Trajectory(stamps, np.array([one.pose for one in self._samples]).reshape(-1, 4, 4))
        pose, known = odometry.at(np.array([stamp_ns], np.int64))
        if not known[0]:
            return None
        path_m = float(np.interp(stamp_ns - stamps[0], stamps - stamps[0], [one.path_m for one in self._samples]))
        return _Sample(stamp_ns, pose[0], path_m)


def _logit(probability: float) -> float:
    """Return the odds in nats; an unknown probability counts as 0.9, the threshold of acceptance."""
    known = min(max(probability, 0.5), 0.9999) if np.isfinite(probability) else 0.9
    return log(known / (1 - known))


def open_localizer(settings: Settings) -> Localizer:
    """Return a localizer in the map of the settings, with their initial pose; raise an `UmfError` if there is none."""
    known = MapPoses(Path(settings.map))
    localizer = Localizer(known.places, settings.pose_graph)
    if (initial := known.from_settings(settings)) is not None:
        localizer.expect(initial)
    return localizer


_STATES = {
    ClosureReason.AGREES_WITH_POSE: State.ACCEPTED,
    ClosureReason.CONTRADICTS_POSE: State.REJECTED,
    ClosureReason.POSE_UNKNOWN: State.PENDING,
    ClosureReason.NOT_OF_MAP: State.REFUSED,
}
