"""Odometry of one session: keyframes, accumulated noise and the path corrected by closures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import (
    Array,
    adjoint,
    expmap,
    invert,
    logmap,
    orthonormal,
    propagate,
    ros_to_gtsam_covariance,
)
from umf_ros.core.odometry_noise import (
    ANY_SPEED,
    LONGEST_SILENCE_S,
    SHORTEST_SILENCE_NS,
    STEPS_BEFORE,
    USUAL_GAPS,
    OdometryNoise,
    jump_excess,
)
from umf_ros.core.table import Table
from umf_ros.core.trajectory import bracket, interpolated

Stamps = NDArray[np.int64]
Rows = NDArray[np.int64]
PathPoints = NDArray[np.void]
POINT = np.dtype(
    [
        ("session", "i8"),
        ("part", "i8"),
        ("stamp", "i8"),
        ("travel", "f8"),
        ("pose", "f8", (4, 4)),
        ("noise", "f8", (6, 6)),
        ("drift", "f8", (6, 2)),
    ]
)
"""Fields of `PathPoints`, the odometry at some stamps: session, number of silences beyond `max_gap_s` so far, stamp in
ns, path length in m since its start, pose, the noise of all steps so far, and the twist of a constant error of heading
(rad/m) and of scale. Pose, noise and drift are seen from the session's first position, so that sums stay well
conditioned."""
# by hand: standard deviations of the constant errors of a rover's odometry, which no covariance states: heading, rad/m,
# and scale (wheels that slip in sand, a track width or a stereo baseline that is wrong)
_DRIFT_SIGMAS = np.array([np.deg2rad(0.2), 0.03])
# by hand: silence, s, after which a rover may have moved at its recent speed, or at any rover's, all the time
_FREE_S = 2.0


def noise_between(a: PathPoints, b: PathPoints) -> Array:
    """Return (..., 6, 6) noise of the odometry between points of one session, at the origin of both."""
    forward = (a["stamp"] <= b["stamp"])[..., None, None]
    return np.where(forward, 1.0, -1.0) * (b["noise"] - a["noise"])


def drift_between(a: PathPoints, b: PathPoints) -> Array:
    """Return (..., 6, 6) covariance of the constant errors of the odometry between points, at the origin of both."""
    return drift_covariance(b["drift"] - a["drift"])


def drift_covariance(twists: Array) -> Array:
    """Return (..., 6, 6) covariances of (..., 6, 2) twists of constant errors of heading and scale."""
    scaled = twists * _DRIFT_SIGMAS
    return np.asarray(scaled @ np.swapaxes(scaled, -1, -2))


class OdometryChain:
    """All messages of one session, and keyframes among them with the accumulated noise.

    The noise of the path from a to b is a difference of prefix sums: with `W` the covariance of a
    step carried to the origin by the adjoint, `cov(a_T_b) = Ad(b)^-1 (sum_b W - sum_a W) Ad(b)^-T`
    in the tangent space of b. So any two stamps of a session are compared in constant time. The same holds for the
    twist of constant errors. A step that jumps, as where a filter took a GNSS fix, is as uncertain as it is too long. A
    step over a silence is as uncertain as the motion that the recent speed allows: where the odometry restarted or
    jumped meanwhile, closures correct it.
    """

    def __init__(self, settings: PoseGraphSettings, session: int = 0) -> None:
        self._settings, self._session = settings, session
        self._noise = OdometryNoise.stated(settings)
        self._arrived: list[tuple[Stamps, Array]] = []
        self._covariances: dict[int, Array] = {}
        stamps, poses = np.empty(0, np.int64), np.empty((0, 4, 4))
        self._messages = Table(stamp=stamps, pose=poses)
        self._keyframes = Table(
            stamp=stamps,
            part=stamps,
            pose=poses,
            travel=np.empty(0),
            noise=np.empty((0, 6, 6)),
            drift=np.empty((0, 6, 2)),
        )

    @property
    def stamps(self) -> Stamps:
        """(N,) stamps of the keyframes."""
        return self._keyframes["stamp"]

    @property
    def poses(self) -> Array:
        """(N, 4, 4) odometry poses of the keyframes."""
        return self._keyframes["pose"]

    @property
    def travel(self) -> Array:
        """(N,) path length up to each keyframe, m."""
        return self._keyframes["travel"]

    @property
    def span(self) -> tuple[int, int] | None:
        """Stamps of the first and the last message; None without any."""
        stamps = self._messages["stamp"]
        return (int(stamps[0]), int(stamps[-1])) if len(stamps) else None

    def add(self, stamp_ns: int, pose: Array, covariance: Array | None = None) -> None:
        """Add a message; see `PoseGraph.add_odometry`."""
        self.extend(np.array([stamp_ns]), pose[None])
        if covariance is not None:
            self._covariances.setdefault(stamp_ns, covariance)

    def extend(self, stamps: Stamps, poses: Array) -> None:
        """Add N messages, (N,) and (N, 4, 4)."""
        self._arrived.append((stamps, poses))

    def update(self) -> bool:
        """Process the new messages; return true if the past changed and not only the end grew."""
        span, changed = self.span, self._sort_in()
        if changed is None:
            return False
        self._choose_keyframes(changed)
        return span is not None and changed < span[1]

    def covers(self, stamps: Stamps) -> NDArray[np.bool_]:
        """Return (N,) whether a stamp is a message's own or lies in a gap that is short enough to interpolate."""
        known = self._messages["stamp"]
        if not len(known):
            return np.zeros(len(stamps), bool)
        lower, upper, _ = bracket(known, stamps)
        is_inside = (known[0] <= stamps) & (stamps <= known[-1])
        return is_inside & (known[upper] - known[lower] <= self._settings.max_gap_s * 1e9)

    def poses_at(self, stamps: Stamps) -> Array:
        """Return (N, 4, 4) odometry poses interpolated at the stamps, held constant outside the messages."""
        return interpolated(self._messages["stamp"], self._messages["pose"], stamps)

    def at(self, stamps: Stamps) -> PathPoints:
        """Return the path (N,) at stamps that the odometry covers."""
        poses, travel = self.poses_at(stamps), self._keyframes["travel"]
        lower, upper, share = bracket(self.stamps, stamps)
        points = np.zeros(len(stamps), POINT)
        points["session"], points["stamp"], points["pose"] = self._session, stamps, self._from_origin(poses)
        points["part"] = self._keyframes["part"][lower]
        points["travel"] = (1 - share) * travel[lower] + share * travel[upper]
        shares = share[:, None, None]
        for name in ("noise", "drift"):
            collected = self._keyframes[name]
            points[name] = (1 - shares) * collected[lower] + shares * collected[upper]
        beyond = stamps > self.stamps[-1]
        if beyond.any():
            last = np.broadcast_to(self.poses[-1], poses[beyond].shape)
            elapsed_s = (stamps[beyond] - self.stamps[-1]) / 1e9
            steps = self._noise.covariances(self._noise.path_lengths(last, poses[beyond], elapsed_s))
            points["noise"][beyond] += propagate(adjoint(points["pose"][beyond]), steps)
        return points

    def _from_origin(self, poses: Array) -> Array:
        shifted = poses.copy()
        shifted[:, :3, 3] -= self._messages["pose"][0, :3, 3]
        return shifted

    def _sort_in(self) -> int | None:
        """Sort the new messages in, the first of each stamp; return the earliest new stamp."""
        if not self._arrived:
            return None
        stamps = np.concatenate([stamps for stamps, _ in self._arrived], dtype=np.int64)
        poses = orthonormal(np.concatenate([poses for _, poses in self._arrived]))
        poses[:, 3] = 0, 0, 0, 1
        self._arrived = []
        known = self._messages["stamp"]
        start = int(np.searchsorted(known, stamps.min()))
        stamps = np.concatenate([known[start:], stamps])
        poses = np.concatenate([self._messages["pose"][start:], poses])
        # the first index of a stamp arrived first: unique is stable, and older messages precede
        ordered, first = np.unique(stamps, return_index=True)
        new = ordered[first >= len(known) - start]
        self._messages.truncate(start)
        self._messages.extend(stamp=ordered, pose=poses[first])
        return int(new[0]) if len(new) else None

    def _choose_keyframes(self, changed_ns: int) -> None:
        """Sample the messages once per period, and keep a sample after every `keyframe_spacing_m` of path."""
        period = int(self._settings.keyframe_period_s * 1e9)
        self._keyframes.truncate(int(np.searchsorted(self.stamps, changed_ns - changed_ns % period)))
        known = len(self._keyframes)
        start = int(np.searchsorted(self._messages["stamp"], self.stamps[-1])) if known else 0
        messages = self._messages["stamp"][start:]
        given, cells = self._has_covariance(messages), messages // period
        loose = self._loose_steps(start)
        is_loose = np.any(loose > 0, axis=1)
        ends = is_loose | np.append(is_loose[1:], False)
        # the first row is the last keyframe that is known
        rows = np.flatnonzero(given | ends | (np.diff(cells, prepend=cells[0] - 1) > 0))
        stamps, poses = messages[rows], self._messages["pose"][start + rows]
        steps = self._noise.path_lengths(poses[:-1], poses[1:], np.diff(stamps) / 1e9)
        travel = np.cumsum([0.0, *steps]) + (self._keyframes["travel"][-1] if known else 0.0)
        keep = (given | ends)[rows] | (np.diff(np.floor(travel / self._settings.keyframe_spacing_m), prepend=-1) > 0)
        keep[0] = not known
        if keep.any():
            added = np.diff(np.cumsum(loose**2, axis=0)[np.concatenate([rows[:1], rows[keep]])], axis=0)
            is_parted = is_loose & (np.diff(messages, prepend=messages[0]) > self._settings.max_gap_s * 1e9)
            parts = np.cumsum(is_parted)[rows[keep]] + (self._keyframes["part"][-1] if known else 0)
            kept_poses = np.concatenate([poses[:1], poses[keep]])
            self._add_keyframes(stamps[keep], parts, kept_poses, travel[keep], travel[0], added)

    def _loose_steps(self, start: int) -> Array:
        """Return (M, 2) additional standard deviations, rad and m, of the steps that end at messages after `start`.

        They are 0 but for steps that jump or span a silence. The speed and the period of a step are compared with the
        medians of those before, so that later messages do not change it.
        """
        first = max(start - STEPS_BEFORE, 0)
        stamps, poses = self._messages["stamp"][first:], self._messages["pose"][first:]
        sigmas = np.zeros((len(stamps), 2))
        if len(stamps) > STEPS_BEFORE + 1:
            periods = np.diff(stamps)[:, None] / 1e9
            lengths = np.linalg.norm(logmap(invert(poses[:-1]) @ poses[1:]).reshape(-1, 2, 3), axis=2)
            before = sliding_window_view(np.hstack([lengths / periods, periods])[:-1], STEPS_BEFORE, axis=0)
            usual, seconds = np.median(before, axis=2), periods[STEPS_BEFORE:]
            jumped = jump_excess(lengths[STEPS_BEFORE:], seconds[:, 0], before[:, :2])
            free_s = np.minimum(seconds, LONGEST_SILENCE_S)
            unseen = np.maximum(usual[:, :2], ANY_SPEED[::-1]) * free_s * np.minimum(free_s / _FREE_S, 1.0)
            unseen[seconds[:, 0] <= np.maximum(SHORTEST_SILENCE_NS / 1e9, USUAL_GAPS * usual[:, 2])] = 0.0
            sigmas[STEPS_BEFORE + 1 :] = np.where(jumped > 0, jumped, np.minimum(unseen, [np.pi, np.inf]))
        sigmas[: start - first + 1] = 0.0  # known before
        return sigmas[start - first :]

    def _add_keyframes(
        self, stamps: Stamps, parts: Rows, poses: Array, travel: Array, start: float, added: Array
    ) -> None:
        """Add N keyframes after `poses[0]`, up to which the path length is `start`; `added` noise, rad^2 and m^2."""
        steps = self._noise.covariances(np.diff(travel, prepend=start))
        moved = invert(poses[:-1]) @ poses[1:]
        for row in np.flatnonzero(self._has_covariance(stamps)):
            steps[row] = ros_to_gtsam_covariance(self._covariances[int(stamps[row])], moved[row])
        steps += np.repeat(added, 3, axis=1)[:, :, None] * np.eye(6)
        twists = np.zeros((len(steps), 6, 2))
        twists[:, 2, 0] = np.linalg.norm(moved[:, :3, 3], axis=1)
        twists[:, 3:, 1] = (np.swapaxes(moved[:, :3, :3], 1, 2) @ moved[:, :3, 3:])[..., 0]
        carry = adjoint(self._from_origin(poses[1:]))
        sums = {"noise": propagate(carry, steps), "drift": carry @ twists}
        for name, one in sums.items():
            sums[name] = np.cumsum(one, axis=0) + (self._keyframes[name][-1] if len(self._keyframes) else 0.0)
        self._keyframes.extend(stamp=stamps, part=parts, pose=poses[1:], travel=travel, **sums)

    def _has_covariance(self, stamps: Stamps) -> NDArray[np.bool_]:
        return np.fromiter((stamp in self._covariances for stamp in stamps.tolist()), bool, len(stamps))


@dataclass(frozen=True)
class CorrectedPath:
    """Poses of a session, interpolated between solved poses.

    Between two solved poses the correction is distributed in proportion to the odometry's noise,
    which is the least-squares optimum; beyond the last one the path follows the odometry.

    Attributes:
        points: (N,) the odometry at the solved poses, sorted by stamp.
        poses: (N, 4, 4) solved `map_T_body`.
    """

    points: PathPoints
    poses: Array

    def at(self, points: PathPoints) -> Array:
        """Return (M, 4, 4) `map_T_body` at points of the session."""
        after = np.searchsorted(self.points["stamp"], points["stamp"], side="right")
        lower = np.maximum(after - 1, 0)
        twists = np.zeros((len(points), 6))
        inside = (after > 0) & (after < len(self.points))
        if inside.any():
            steps, which = np.unique(lower[inside], return_inverse=True)
            noise = points["noise"][inside] - self.points["noise"][lower[inside]]
            twists[inside] = (noise @ self._multipliers(steps)[which][..., None])[..., 0]
        start = self.poses[lower] @ invert(self.points["pose"][lower])
        return start @ expmap(twists) @ points["pose"]

    def _multipliers(self, steps: NDArray[np.int64]) -> Array:
        """(M, 6) corrections from solved poses to the next per noise: Lagrange multipliers of the solved poses."""
        here, there = self.points[steps], self.points[steps + 1]
        step = invert(here["pose"]) @ there["pose"]
        misfits = logmap(invert(step) @ invert(self.poses[steps]) @ self.poses[steps + 1])
        twists = adjoint(there["pose"]) @ misfits[..., None]
        return np.linalg.solve(there["noise"] - here["noise"], twists)[..., 0]
