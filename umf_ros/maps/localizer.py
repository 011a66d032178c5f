"""Where a rover is in a map that is there: closures say it, odometry carries it on."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import exp, log
from typing import NamedTuple

import numpy as np

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import (
    Array,
    adjoint,
    expmap,
    gtsam_to_ros_covariance,
    invert,
    logmap,
    propagate,
    relative,
    rotation_angle,
)
from umf_ros.core.trajectory import Trajectory
from umf_ros.pose_graph.closures import check_closure, check_pose

BELIEVED = log(0.999 / 0.001)
"""A pose is told from these odds on, nats (*by hand*: one wrong in a thousand)."""
_MOST_PER_CLOSURE = log(0.99 / 0.01)
# what one place is mistaken for, the next is too: closures that follow count by the way between them
_NATS_PER_M = 1.0
_MOST_ODDS, _LEAST_ODDS = 12.0, -3.0
_MOST_HYPOTHESES = 8
_KEPT_MESSAGES = 3000
_SAME_M, _SAME_RAD = 0.5, 0.1
# poses of the map are no better than this
_MAP_SIGMAS = np.array([0.005, 0.005, 0.005, 0.05, 0.05, 0.05])
_TURN_M_PER_RAD = 0.5


class Localization(NamedTuple):
    """Where the rover is.

    Attributes:
        stamp_ns: when.
        map_T_body: (4, 4).
        covariance: (6, 6) in ROS order about the map's axes.
        probability: that the rover is there at all, not at a place that looks alike.
    """

    stamp_ns: int
    map_T_body: Array
    covariance: Array
    probability: float


class _Moment(NamedTuple):
    """A message of the odometry, and the metres driven up to it, turns included."""

    stamp_ns: int
    pose: Array
    way_m: float


@dataclass
class _Hypothesis:
    """Where the rover may have been at a moment.

    Attributes:
        at: the moment.
        pose: (4, 4) `map_T_body`.
        covariance: (6, 6) in the tangent space of the body, rotation first.
        odds: that it is there, nats.
        counted_m: way of the latest closure that counted.
        closures: that agree.
    """

    at: _Moment
    pose: Array
    covariance: Array
    odds: float
    counted_m: float
    closures: int = 1


class Localizer:
    """Follows the hypotheses that closures with the map leave open; the map itself stays as it is.

    A first closure makes a hypothesis. Those that follow agree with it or contradict it, as far as odometry and
    covariances let them, and are worth the way between them. Who is believed is followed until another is believed
    more: so a rover that was carried away finds itself again.

    Args:
        poses: of the map's keyframes, by the stamps that closures name as their match.
        settings: of the odometry's noise, and the gate.

    Attributes:
        relocalised: how often a pose was found, or another than before.
        counts: closures that agreed with the pose, contradicted it, came before there was one, or could not be used.
    """

    def __init__(self, poses: Trajectory, settings: PoseGraphSettings) -> None:
        self._map = dict(zip(poses.stamps_ns.tolist(), poses.poses, strict=True))
        self._settings = settings
        self.relocalised = 0
        self.counts = {"agreed": 0, "contradicted": 0, "searching": 0, "unusable": 0}
        self.begin_session()

    def begin_session(self) -> None:
        """The odometry begins anew, anywhere: every pose is forgotten."""
        self._moments: deque[_Moment] = deque(maxlen=_KEPT_MESSAGES)
        self._waiting: deque[LoopClosure] = deque(maxlen=50)
        self._hypotheses: list[_Hypothesis] = []
        self._believed: _Hypothesis | None = None

    def retune(self, settings: PoseGraphSettings) -> None:
        """Judge by other gates from now on."""
        self._settings = settings

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> bool:
        """Take one message; returns whether it could be used."""
        try:
            check_pose(odom_T_body)
        except GraphError:
            return False
        last = self._moments[-1] if self._moments else None
        if last is not None and stamp_ns <= last.stamp_ns:
            return False
        way_m = 0.0 if last is None else last.way_m + _way(last.pose, odom_T_body)
        self._moments.append(_Moment(stamp_ns, np.asarray(odom_T_body, float), way_m))
        for _ in range(len(self._waiting)):
            self.add_closure(self._waiting.popleft())
        return True

    def add_closure(self, closure: LoopClosure) -> Localization | None:
        """Take a closure between the rover's keyframe and one of the map; returns where it was then, if it is known."""
        if self._moments and closure.query_stamp_ns > self._moments[-1].stamp_ns:
            self._waiting.append(closure)
            return None
        at, match = self._moment(closure.query_stamp_ns), self._map.get(closure.match_stamp_ns)
        try:
            covariance = check_closure(closure, self._settings.max_closure_m)
        except GraphError:
            at = None
        if at is None or match is None:
            self.counts["unusable"] += 1
            return None
        self._weigh(at, match @ closure.match_T_query, covariance + np.diag(_MAP_SIGMAS**2), closure.probability)
        return None if self._believed is None else self._told(self._believed, at)

    def estimate(self) -> Localization | None:
        """Where the rover is by the newest odometry; None while it is unknown."""
        if self._believed is None or not self._moments:
            return None
        return self._told(self._believed, self._moments[-1])

    def map_T_odom(self) -> Array | None:
        """(4, 4) pose of the odometry's frame in the map; None while it is unknown."""
        known = self._believed
        return None if known is None else known.pose @ invert(known.at.pose)

    def _weigh(self, at: _Moment, pose: Array, covariance: Array, probability: float) -> None:
        """Hold a measured pose against every hypothesis, and begin one where none agrees."""
        trust = min(_logit(probability), _MOST_PER_CLOSURE)
        agreed = [one for one in self._hypotheses if self._agrees(one, at, pose, covariance)]
        gain = trust
        for one in agreed:
            gain = min(gain, _NATS_PER_M * max(at.way_m - one.counted_m, 0.0))
            self._correct(one, at, pose, covariance)
        for one in self._hypotheses:
            one.odds += gain if one in agreed else -trust if not agreed else -gain
            one.odds = min(one.odds, _MOST_ODDS)
            one.counted_m = at.way_m if one in agreed else one.counted_m
        if not agreed:
            self._hypotheses.append(_Hypothesis(at, pose, covariance, trust, at.way_m))
        self._note(agreed)
        self._choose()

    def _note(self, agreed: list[_Hypothesis]) -> None:
        if self._believed is None:
            self.counts["searching"] += 1
        else:
            self.counts["agreed" if self._believed in agreed else "contradicted"] += 1

    def _choose(self) -> None:
        """Keep the likeliest hypotheses, one of each pose, and believe the best where its odds suffice."""
        kept: list[_Hypothesis] = []
        for one in sorted(self._hypotheses, key=lambda one: -one.odds):
            if one.odds > _LEAST_ODDS and not any(self._same(one, other) for other in kept):
                kept.append(one)
        self._hypotheses = kept[:_MOST_HYPOTHESES]
        best = kept[0] if kept else None
        if best is not None and best.odds >= BELIEVED and best is not self._believed:
            self._believed = best
            self.relocalised += 1
        elif self._believed not in self._hypotheses:
            self._believed = None

    def _agrees(self, one: _Hypothesis, at: _Moment, pose: Array, covariance: Array) -> bool:
        expected, spread = self._carried(one, at)
        miss = logmap(relative(expected, pose)[None])[0]
        return float(miss @ np.linalg.solve(spread + covariance, miss)) <= self._settings.gate_chi2

    def _correct(self, one: _Hypothesis, at: _Moment, pose: Array, covariance: Array) -> None:
        """The hypothesis at a moment, and the measured pose, weighed by their covariances (a Kalman update)."""
        expected, spread = self._carried(one, at)
        gain = spread @ np.linalg.inv(spread + covariance)
        one.pose = expected @ expmap((gain @ logmap(relative(expected, pose)[None])[0])[None])[0]
        one.covariance = (np.eye(6) - gain) @ spread
        one.covariance = 0.5 * (one.covariance + one.covariance.T)
        one.at, one.closures = at, one.closures + 1

    def _carried(self, one: _Hypothesis, at: _Moment) -> tuple[Array, Array]:
        """Pose and covariance of a hypothesis, carried by odometry to another moment."""
        step = relative(one.at.pose, at.pose)
        way_m = abs(at.way_m - one.at.way_m)
        turn = np.deg2rad(self._settings.odometry_sigma_deg) ** 2
        noise = way_m * np.diag([turn] * 3 + [self._settings.odometry_sigma_m**2] * 3)
        # a turn made on the way shows at its end as a shift
        noise[3:, 3:] += np.eye(3) * turn * way_m**3 / 3
        return one.pose @ step, propagate(adjoint(invert(step)), one.covariance) + noise

    def _same(self, one: _Hypothesis, other: _Hypothesis) -> bool:
        gap = relative(self._carried(other, one.at)[0], one.pose)
        return bool(np.linalg.norm(gap[:3, 3]) < _SAME_M and rotation_angle(gap) < _SAME_RAD)

    def _told(self, one: _Hypothesis, at: _Moment) -> Localization:
        pose, covariance = self._carried(one, at)
        others = sum(exp(other.odds) for other in self._hypotheses if other is not one)
        probability = exp(one.odds) / (1 + exp(one.odds) + others)
        return Localization(at.stamp_ns, pose, gtsam_to_ros_covariance(covariance, pose), probability)

    def _moment(self, stamp_ns: int) -> _Moment | None:
        """The odometry at a stamp; None before the first message, or in a gap."""
        moments = list(self._moments)
        stamps = np.array([one.stamp_ns for one in moments], np.int64)
        pose, known = Trajectory(stamps, np.array([one.pose for one in moments]).reshape(-1, 4, 4)).at(
            np.array([stamp_ns], np.int64)
        )
        if not known[0]:
            return None
        way_m = float(np.interp(stamp_ns - stamps[0], stamps - stamps[0], [one.way_m for one in moments]))
        return _Moment(stamp_ns, pose[0], way_m)


def _way(a: Array, b: Array) -> float:
    step = relative(a, b)
    return float(np.linalg.norm(step[:3, 3])) + _TURN_M_PER_RAD * rotation_angle(step)


def _logit(probability: float) -> float:
    """Odds in nats; of an unknown probability those of a closure that just passes."""
    known = min(max(probability, 0.5), 0.9999) if np.isfinite(probability) else 0.9
    return log(known / (1 - known))
