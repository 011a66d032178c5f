"""The odometry of one session: every message, in any order, and how far its poses can be trusted."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from scipy.spatial.transform import Rotation

from umf_ros.config import PoseGraphSettings
from umf_ros.geometry import Array, adjoint, interpolate, orthonormal, propagate, relative, ros_to_gtsam_covariance

Stamps = NDArray[np.int64]
_TURN_M_PER_RAD = 0.5
_DRIFT_M_PER_S = 1e-4


class GrowingArray:
    """An array that grows at its end in amortised constant time, and can be cut back."""

    def __init__(self, shape: tuple[int, ...] = (), dtype: DTypeLike = float) -> None:
        self._data: NDArray[Any] = np.empty((64, *shape), dtype)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def view(self) -> NDArray[Any]:
        """The rows so far; valid until the next change."""
        return self._data[: self._size]

    def extend(self, rows: ArrayLike) -> None:
        """Append (N, ...) rows."""
        added = np.asarray(rows)
        size = self._size + len(added)
        if size > len(self._data):
            grown = np.empty((max(size, 2 * len(self._data)), *self._data.shape[1:]), self._data.dtype)
            grown[: self._size] = self.view
            self._data = grown
        self._data[self._size : size] = added
        self._size = size

    def truncate(self, size: int) -> None:
        """Keep the first `size` rows."""
        self._size = min(size, self._size)


class OdometryLog:
    """Odometry messages sorted by stamp; a second message of the same stamp is dropped."""

    def __init__(self) -> None:
        self._stamps = GrowingArray(dtype=np.int64)
        self._poses = GrowingArray((3, 4))
        self._arrived: list[tuple[int, Array]] = []
        self.duplicates = 0

    @property
    def stamps(self) -> Stamps:
        """(N,) stamps of the sorted messages."""
        return self._stamps.view

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Remember one (4, 4) pose; it is sorted in by the next `sort`."""
        self._arrived.append((stamp_ns, pose))

    def sort(self) -> int | None:
        """Sort the new messages in; returns the earliest stamp that is new, None without one."""
        if not self._arrived:
            return None
        stamps = np.array([stamp for stamp, _ in self._arrived], np.int64)
        poses = orthonormal(np.stack([pose for _, pose in self._arrived]))
        self._arrived = []
        return self._merge(stamps, poses[:, :3])

    def _merge(self, stamps: Stamps, rows: Array) -> int | None:
        start = int(np.searchsorted(self.stamps, stamps.min()))
        old = len(self.stamps) - start
        stamps = np.concatenate([self.stamps[start:], stamps])
        rows = np.concatenate([self._poses.view[start:], rows])
        # the first index of a stamp is the one that arrived first: unique is stable and old ones lead
        sorted_stamps, first = np.unique(stamps, return_index=True)
        self.duplicates += len(stamps) - len(first)
        new = sorted_stamps[first >= old]
        self._stamps.truncate(start)
        self._poses.truncate(start)
        self._stamps.extend(sorted_stamps)
        self._poses.extend(rows[first])
        return int(new[0]) if len(new) else None

    def poses(self, rows: NDArray[np.int64] | slice) -> Array:
        """(N, 4, 4) poses of the given rows."""
        values = self._poses.view[rows]
        poses = np.zeros((len(values), 4, 4))
        poses[:, :3] = values
        poses[:, 3, 3] = 1.0
        return poses

    def known(self, stamps: Stamps, max_gap_ns: int) -> NDArray[np.bool_]:
        """Which stamps are a message's own or lie in a gap of at most `max_gap_ns` between two."""
        if not len(self.stamps):
            return np.zeros(len(stamps), bool)
        after = np.searchsorted(self.stamps, stamps)
        upper = np.minimum(after, len(self.stamps) - 1)
        lower = np.maximum(upper - 1, 0)
        exact = self.stamps[upper] == stamps
        between = (after > 0) & (after < len(self.stamps))
        return exact | (between & (self.stamps[upper] - self.stamps[lower] <= max_gap_ns))

    def poses_at(self, stamps: Stamps) -> Array:
        """(N, 4, 4) poses interpolated at the stamps, held constant outside the log."""
        upper = np.clip(np.searchsorted(self.stamps, stamps), 0, len(self.stamps) - 1)
        exact = self.stamps[upper] == stamps
        lower = np.where(exact, upper, np.maximum(upper - 1, 0))
        span = np.maximum(self.stamps[upper] - self.stamps[lower], 1)
        fractions = np.clip((stamps - self.stamps[lower]) / span, 0.0, 1.0)
        poses, between = self.poses(lower), np.flatnonzero(fractions)
        if len(between):
            poses[between] = interpolate(poses[between], self.poses(upper[between]), fractions[between])
        return poses


class OdometryChain:
    """Keyframes of one session's odometry with the noise collected along the way.

    The noise of the way from a to b is a difference of prefix sums: with `W` the covariance of a
    step carried to the origin by the adjoint, `cov(a_T_b) = Ad(b)^-1 (sum_b W - sum_a W) Ad(b)^-T`
    in the tangent space of b. So any two stamps of a session are compared in constant time.
    """

    def __init__(self, settings: PoseGraphSettings) -> None:
        self._settings = settings
        self.log = OdometryLog()
        self._covariances: dict[int, Array] = {}
        self._samples = GrowingArray(dtype=np.int64)
        self._sample_travel = GrowingArray()
        self._stamps = GrowingArray(dtype=np.int64)
        self._poses = GrowingArray((4, 4))
        self._travel = GrowingArray()
        self._noise = GrowingArray((6, 6))
        self._origin: Array = np.zeros(3)

    @property
    def stamps(self) -> Stamps:
        """(N,) stamps of the keyframes."""
        return self._stamps.view

    @property
    def poses(self) -> Array:
        """(N, 4, 4) odometry poses of the keyframes."""
        return self._poses.view

    def add(self, stamp_ns: int, pose: Array, covariance: Array | None = None) -> None:
        """Remember a message; see `PoseGraph.add_odometry`."""
        self.log.add(stamp_ns, pose)
        if covariance is not None:
            self._covariances.setdefault(stamp_ns, covariance)

    def update(self) -> bool:
        """Take the new messages in; True when the past changed, not only the end grew."""
        last = int(self.log.stamps[-1]) if len(self.log.stamps) else None
        changed = self.log.sort()
        if changed is None:
            return False
        self._rebuild_from(changed)
        return last is not None and changed < last

    def covers(self, stamps: Stamps) -> NDArray[np.bool_]:
        """Which stamps have a trustworthy odometry pose."""
        return self.log.known(stamps, int(self._settings.max_gap_s * 1e9))

    def poses_at(self, stamps: Stamps) -> Array:
        """(N, 4, 4) odometry poses."""
        return self.log.poses_at(stamps)

    def travel_at(self, stamps: Stamps) -> Array:
        """(N,) metres driven since the start of the session, turns on the spot included."""
        return np.interp(stamps.astype(float), self.stamps.astype(float), self._travel.view)

    def noise_at(self, stamps: Stamps, poses: Array) -> Array:
        """(N, 6, 6) noise collected from the start to the stamps, whose odometry poses are given, at the origin."""
        upper = np.clip(np.searchsorted(self.stamps, stamps), 0, len(self.stamps) - 1)
        exact = self.stamps[upper] == stamps
        lower = np.where(exact, upper, np.maximum(upper - 1, 0))
        span = np.maximum(self.stamps[upper] - self.stamps[lower], 1)
        fractions = np.clip((stamps - self.stamps[lower]) / span, 0.0, 1.0)[:, None, None]
        noise = (1 - fractions) * self._noise.view[lower] + fractions * self._noise.view[upper]
        beyond = stamps > self.stamps[-1]
        if beyond.any():
            noise[beyond] += self._steps_beyond(stamps[beyond], poses[beyond])
        return noise

    def at_origin(self, poses: Array) -> Array:
        """Odometry poses seen from the chain's first pose's position: keeps the prefix sums well conditioned."""
        shifted = poses.copy()
        shifted[..., :3, 3] -= self._origin
        return shifted

    def _steps_beyond(self, stamps: Stamps, poses: Array) -> Array:
        last = np.broadcast_to(self.poses[-1], poses.shape)
        steps = _path_steps(last, poses, stamps - self.stamps[-1])
        return propagate(adjoint(self.at_origin(poses)), self._model(steps))

    def _model(self, travel: Array) -> Array:
        turn = np.deg2rad(self._settings.odometry_sigma_deg) ** 2
        shift = self._settings.odometry_sigma_m**2
        return travel[:, None, None] * np.diag([turn] * 3 + [shift] * 3)

    def _rebuild_from(self, changed: int) -> None:
        """Sample the log once per period, then keep a sample wherever enough way has been made."""
        period = int(self._settings.keyframe_period_s * 1e9)
        start = int(np.searchsorted(self.log.stamps, changed - changed % period))
        kept = int(np.searchsorted(self._samples.view, changed - changed % period))
        self._samples.truncate(kept)
        self._sample_travel.truncate(kept)
        keyframes = int(np.searchsorted(self.stamps, changed - changed % period))
        for rows in (self._stamps, self._poses, self._travel, self._noise):
            rows.truncate(keyframes)
        tail = self.log.stamps[start:]
        first_of_cell = np.ones(len(tail), bool)
        first_of_cell[1:] = np.diff(tail // period) > 0
        if self._covariances:
            first_of_cell |= np.fromiter((int(stamp) in self._covariances for stamp in tail), bool, len(tail))
        self._extend(start + np.flatnonzero(first_of_cell))

    def _extend(self, rows: NDArray[np.int64]) -> None:
        stamps, poses = self.log.stamps[rows], self.log.poses(rows)
        previous = len(self._samples)
        if previous:
            before = self._samples.view[-1:]
            steps = _path_steps(
                np.concatenate([self.log.poses_at(before), poses[:-1]]), poses, np.diff(stamps, prepend=before)
            )
            travel: Array = self._sample_travel.view[-1] + np.cumsum(steps)
            previous_travel: Array = np.concatenate([self._sample_travel.view[-1:], travel[:-1]])
        else:
            self._origin = poses[0, :3, 3].copy()
            steps = _path_steps(poses[:-1], poses[1:], np.diff(stamps))
            travel = np.concatenate([[0.0], np.cumsum(steps)])
            previous_travel = np.concatenate([[-1.0], travel[:-1]])
        self._samples.extend(stamps)
        self._sample_travel.extend(travel)
        spacing = self._settings.keyframe_spacing_m
        keep = np.floor(travel / spacing) > np.floor(previous_travel / spacing)
        if self._covariances:
            keep |= np.fromiter((int(stamp) in self._covariances for stamp in stamps), bool, len(stamps))
        self._add_keyframes(stamps[keep], poses[keep], travel[keep])

    def _add_keyframes(self, stamps: Stamps, poses: Array, travel: Array) -> None:
        if not len(stamps):
            return
        steps = np.diff(travel, prepend=self._travel.view[-1] if len(self._travel) else travel[0])
        model = self._model(np.maximum(steps, 0.0))
        if self._covariances:
            self._take_given(model, stamps, poses)
        carried = propagate(adjoint(self.at_origin(poses)), model)
        start = self._noise.view[-1] if len(self._noise) else np.zeros((6, 6))
        self._stamps.extend(stamps)
        self._poses.extend(poses)
        self._travel.extend(travel)
        self._noise.extend(start + np.cumsum(carried, axis=0))

    def _take_given(self, model: Array, stamps: Stamps, poses: Array) -> None:
        """Replace the model by the covariances that came with the messages."""
        before = self.poses[-1] if len(self.poses) else None
        for row, stamp in enumerate(stamps):
            given = self._covariances.get(int(stamp))
            if given is not None and before is not None:
                model[row] = ros_to_gtsam_covariance(given, relative(before, poses[row]))
            before = poses[row]


def _path_steps(a: Array, b: Array, elapsed_ns: Stamps) -> Array:
    """(N,) lengths of the steps from `a` to `b` in metres, counting turns and, barely, time."""
    turns = Rotation.from_matrix(np.swapaxes(a[:, :3, :3], -1, -2) @ b[:, :3, :3]).magnitude()
    moved = np.linalg.norm(b[:, :3, 3] - a[:, :3, 3], axis=1)
    return moved + _TURN_M_PER_RAD * turns + _DRIFT_M_PER_S * np.asarray(elapsed_ns) / 1e9
