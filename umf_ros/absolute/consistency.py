"""Consistency of absolute measurements over time.

The difference between the measurements of a right source and the odometry changes slowly along the path, by the drift
of the odometry; multipath makes it jump. Dynamic programming finds the longest chain of measurements in which each
agrees with its predecessor within the drift of the odometry between them. Measurements outside the chain contradict it.
A mounting error rotates with the rover, so it is distinguished from drift.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from umf_ros.absolute.measurement import AbsoluteMeasurement, AbsoluteReason, AbsoluteVerdict, Aid
from umf_ros.core.frames import State
from umf_ros.core.geometry import Array, invert, make_pose
from umf_ros.core.odometry_noise import OdometryNoise

STRETCH_M = 10.0
"""Path length over which measurements are averaged (*by hand*: multipath jumps further than odometry drifts in it)."""
GATE, _FLAT_GATE = (float(chdtri(axes, 1 - 0.999)) for axes in (3, 2))
"""Largest squared Mahalanobis distance of a right measurement."""
SUPPORT = 4
"""Least number of consecutive stretches that agree (*by hand*: longer than the path through one reflection)."""
# by hand: longest gap of a chain, in stretches
_REACH = 60
# by hand: least jump by multipath, m; a link with a larger tolerance proves nothing
_LEAST_JUMP_M = 5.0
# by hand: attitude of the solved map, rad, and systematic error of odometry per metre
_ATTITUDE, _SYSTEMATIC, _SYSTEMATIC_RAD = np.deg2rad(1.0), 0.02, np.deg2rad(0.03)
_HEADINGS = np.deg2rad(np.arange(0, 360, 5.0))
_PAIRS = 5
# by hand: most measurements that a stretch counts as, since errors of consecutive ones are correlated
_MOST_COUNTED = 4
_MOST_DRIFT_M = 2000
_ALIGNED_STRETCHES = 40
_FEW_STRETCHES = 15
# by hand: least mounting error that is rejected, and its largest standard deviation: m for an antenna, rad for an IMU
_MOUNTING = {Aid.GNSS: (0.5, 1.0), Aid.GRAVITY: (np.deg2rad(2.5), np.deg2rad(1.0))}
_LEAST_SIGMA_M = 0.05
_STEP = np.log(1.2)

Rows = NDArray[np.int64]
Decision = tuple[State, AbsoluteReason]
_AGREES = State.ACCEPTED, AbsoluteReason.AGREES
_INCOMPLETE = State.PENDING, AbsoluteReason.INCOMPLETE
_UNSURE = State.PENDING, AbsoluteReason.UNSURE
_JUMPED = State.REJECTED, AbsoluteReason.JUMPED
_CONTRADICTS = State.REJECTED, AbsoluteReason.CONTRADICTS
_MOUNTED_WRONG = State.REJECTED, AbsoluteReason.MOUNTING


def position_drift(noise: OdometryNoise, path_m: Array) -> Array:
    """Return the variance per axis (m^2) of the odometry's translation over path lengths, from a known attitude."""
    random = noise.sigma_m**2 * path_m + noise.sigma_rad**2 * path_m**3 / 3
    return random + (_ATTITUDE**2 + _SYSTEMATIC**2) * path_m**2


def attitude_drift(noise: OdometryNoise, path_m: Array) -> Array:
    """Return the variance per axis (rad^2) of the odometry's attitude over path lengths."""
    return noise.sigma_rad**2 * path_m + (_SYSTEMATIC_RAD * path_m) ** 2


def longest_chain(values: Array, variances: Array, path_m: Array, drift: Array) -> NDArray[np.bool_]:
    """Return (N,) whether measurements are on the longest chain along the path.

    Args:
        values: (N, 3) differences that drift slowly.
        variances: (N, 3) of the values.
        path_m: (N,) increasing path lengths.
        drift: (K,) variance of the drift over 0, 1, 2, ... metres; the last applies beyond.
    """
    best, before = np.ones(len(values)), np.full(len(values), -1)
    for row in range(1, len(values)):
        start = max(0, row - _REACH)
        apart = drift[np.minimum((path_m[row] - path_m[start:row]).astype(int), len(drift) - 1)]
        spread = variances[start:row] + variances[row] + apart[:, None]
        fits = ((values[start:row] - values[row]) ** 2 / spread).sum(axis=1) <= GATE
        if fits.any():
            chosen = int(np.argmax(np.where(fits, best[start:row], 0.0)[::-1]))  # the nearest of equals
            before[row] = row - 1 - chosen
            best[row] += best[before[row]]
    members, row = np.zeros(len(values), bool), int(np.argmax(best)) if len(values) else -1
    while row >= 0:
        members[row], row = True, int(before[row])
    return members


def supported(members: NDArray[np.bool_], variances: Array, path_m: Array, drift: Array) -> NDArray[np.bool_]:
    """Return (N,) members of a chain with enough consecutive neighbours whose links tolerate no jump."""
    rows = np.flatnonzero(members)
    gaps = np.minimum(np.diff(path_m[rows]).astype(int), len(drift) - 1)
    room = np.sqrt(GATE * (variances[rows[1:]] + variances[rows[:-1]]).mean(axis=1) + GATE * drift[gaps])
    part = np.concatenate([[0], np.cumsum(room > _LEAST_JUMP_M)]) if len(rows) else np.empty(0, int)
    found = np.zeros(len(members), bool)
    found[rows] = np.bincount(part)[part] >= SUPPORT if len(rows) else False
    return found


def find_heading(measured: Array, mapped: Array, variances: Array, path_m: Array, drift: Array) -> float | None:
    """Return the heading (rad) of an upright map in the world; None where too little of the path agrees on one.

    The heading with the longest chain is chosen and refined. `measured` (N, 3) are positions in the world, `mapped` the
    same positions in the map; the others as for `longest_chain`.
    """
    best: tuple[int, float, float] | None = None
    for heading in _HEADINGS:
        values = measured - turned(mapped, heading)
        members = longest_chain(values, variances, path_m, drift)
        scatter = float(np.square(values[members] - np.median(values[members], axis=0)).sum(axis=1).mean())
        if best is None or (int(members.sum()), -scatter) > best[:2]:
            best, chain = (int(members.sum()), -scatter, float(heading)), members
    if best is None or best[0] < max(SUPPORT, 0.6 * len(measured)):
        return None
    world, here = (points[chain, :2] - points[chain, :2].mean(axis=0) for points in (measured, mapped))
    reach = np.linalg.norm(here - here[0], axis=1).max()
    if np.sqrt(variances[chain].mean()) > 0.07 * reach:  # by hand: 4 degrees
        return None
    cross = (here[:, 0] * world[:, 1] - here[:, 1] * world[:, 0]).sum()
    return float(np.arctan2(cross, (here * world).sum()))


def turned(points: Array, heading: float) -> Array:
    """Return points (N, 3) rotated about z."""
    cos, sin = np.cos(heading), np.sin(heading)
    return points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1.0]])


def body_offset(values: Array, variances: Array, rotations: Array, path_m: Array, drift: Array) -> tuple[Array, Array]:
    """Return the error (3,) in `values` that rotates with the body, and its covariance (3, 3).

    `rotations` (N, 3, 3) are those of the body in the frame of the values; the others as for `longest_chain`.
    """
    pairs = [(row, row + step) for step in range(1, _PAIRS + 1) for row in range(len(values) - step)]
    first, second = np.array(pairs).reshape(-1, 2).T
    apart = drift[np.minimum((path_m[second] - path_m[first]).astype(int), len(drift) - 1)]
    stated = (variances[first] + variances[second]).mean(axis=1) + apart
    design, missed, weights = rotations[second] - rotations[first], values[second] - values[first], 1 / stated
    for _ in range(3):  # iteratively reweighted: some links of the chain are outliers
        information = np.einsum("n,nji,njk->ik", weights, design, design) + 1e-9 * np.eye(3)
        offset = np.linalg.solve(information, np.einsum("n,nji,nj->i", weights, design, missed))
        left = np.square(missed - design @ offset).sum(axis=1) / stated
        weights = 1 / (stated * (1 + left / 4))
    # every value is in several pairs
    return offset, _PAIRS * max(1.0, float(np.median(left)) / 3) * np.linalg.inv(information)


class Factor(NamedTuple):
    """The average of the measurements of a stretch.

    Attributes:
        stamp_ns: of its middle.
        middle: (4, 4) odometry there.
        numbers: values that identify the factor.
        make: returns the factor of a vertex, given the pose (4, 4) of the middle in its frame and its number.
    """

    stamp_ns: int
    middle: Array
    numbers: tuple[float, ...]
    make: Callable[[Array, int], gtsam.NonlinearFactor]


@dataclass(frozen=True)
class MeasuredPath:
    """The path at N measurements, and its stretches.

    Attributes:
        odometry: (N, 4, 4) poses by odometry alone.
        poses: (N, 4, 4) in the world, or in the map while its pose in the world is unknown.
        travel: (N,) m.
        finished: number of finished stretches.
        at_middle: returns stamp and odometry (4, 4) in the middle of a stretch.
    """

    odometry: Array
    poses: Array
    travel: Array
    finished: int
    at_middle: Callable[[int], tuple[int, Array]]


@dataclass(frozen=True)
class _Stretches:
    """Averages over K stretches: numbers, rows of the measurements, medians and their variances (K, 3), travel (K,)."""

    cells: Rows
    rows: list[Rows]
    middles: Array
    spreads: Array
    travel: Array

    @classmethod
    def of(cls, values: Array, variances: Array, path: MeasuredPath) -> _Stretches:
        """Return the averages of (N, 3) values over the finished stretches."""
        cells = (path.travel // STRETCH_M).astype(int)
        names, first, counts = np.unique(cells, return_index=True, return_counts=True)
        done = names < path.finished
        rows = [np.arange(start, start + count) for start, count in zip(first[done], counts[done], strict=True)]
        middles = np.array([np.median(values[own], axis=0) for own in rows]).reshape(-1, 3)
        spreads = np.array([variances[own].mean(axis=0) / min(len(own), _MOST_COUNTED) for own in rows]).reshape(-1, 3)
        return cls(names[done], rows, middles, spreads, np.array([path.travel[own].mean() for own in rows]))


class Track:
    """Measurements of one source in one session, and the decisions about them.

    Attributes:
        mounting: mounting error (2,), forward and left, m, or of the upward direction, rad, for which the source is
            rejected; None if there is none.
        factors: accepted stretches, by number.
    """

    def __init__(self, source: Aid, noise: OdometryNoise) -> None:
        metres = np.arange(_MOST_DRIFT_M, dtype=float)
        self._source = source
        self._drift = (position_drift if source is Aid.GNSS else attitude_drift)(noise, metres)
        self._measurements: list[AbsoluteMeasurement] = []
        self._decisions: list[Decision] = []
        self._misfits = self._distances = np.empty(0)
        self._levers = self._variances = np.empty((0, 3))
        self._solved: set[int] = set()
        self._scale = 1.0
        self.mounting: Array | None = None
        self.factors: dict[int, Factor] = {}

    def add(self, measurements: list[AbsoluteMeasurement]) -> None:
        """Add measurements; they are pending until `judge`."""
        self._measurements = sorted([*self._measurements, *measurements], key=lambda one: one.stamp_ns)
        self._levers = np.array([one.lever for one in self._measurements])
        self._variances = np.array([np.diag(one.covariance) for one in self._measurements])
        self._decisions += [_INCOMPLETE] * len(measurements)
        more = np.full(len(measurements), np.nan)
        self._misfits, self._distances = np.append(self._misfits, more), np.append(self._distances, more)

    @property
    def stamps(self) -> Rows:
        """(N,) stamps of the measurements."""
        return np.array([one.stamp_ns for one in self._measurements], np.int64)

    @property
    def values(self) -> Array:
        """(N, 3) values of the measurements."""
        return np.array([one.value for one in self._measurements])

    def verdicts(self) -> list[AbsoluteVerdict]:
        """The latest verdicts, in order of the stamps."""
        figures = zip(np.sqrt(self._distances).tolist(), self._misfits.tolist(), strict=True)
        rows = zip(self._measurements, self._decisions, figures, strict=True)
        return [AbsoluteVerdict(one.source, one.stamp_ns, *decision, *figure) for one, decision, figure in rows]

    def align(self, measured: Array, path: MeasuredPath) -> Array | None:
        """Return `world_T_map` by the newest stretches of (N, 3) positions; None while it is unknown."""
        mapped = path.poses[:, :3, 3] + apply(path.poses, self._levers)
        world, here = (_Stretches.of(points, self._variances, path) for points in (measured, mapped))
        newest = slice(-_ALIGNED_STRETCHES, None)
        ends, known = (world.middles[newest], here.middles[newest]), (world.spreads[newest], world.travel[newest])
        direction = find_heading(*ends, *known, self._drift) if len(ends[0]) else None
        if direction is None:
            self._decide_all((State.PENDING, AbsoluteReason.NOT_ALIGNED))
            return None
        return make_pose(turned(np.eye(3), direction).T, np.median(ends[0] - turned(ends[1], direction), axis=0))

    def judge(self, measured: Array, path: MeasuredPath, in_world: bool) -> None:
        """Decide about all measurements; `measured` (N, 3) are positions in the world, or upward directions."""
        self.factors = {}
        self._decide_all(_INCOMPLETE if self.mounting is None else _MOUNTED_WRONG)
        if self.mounting is not None:
            return
        values, rotations = self._drifting(measured, path)
        self._scale = _scatter(values, self._variances, _Stretches.of(values, self._variances, path))
        variances = self._scale**2 * self._variances
        stretches = _Stretches.of(values, variances, path)
        parts = stretches.middles, stretches.spreads, stretches.travel, self._drift
        members = longest_chain(*parts)
        firm, mounted = supported(members, *parts[1:]), self._judge_mounting(stretches, members, rotations)
        if in_world:
            missed = self._missed(measured, path)
            self._misfits = np.linalg.norm(missed, axis=1)
            self._distances = (missed**2 / variances).sum(axis=1)
        for cell, rows, middle, member, sure in zip(
            stretches.cells.tolist(), stretches.rows, stretches.middles, members, firm, strict=True
        ):
            if sure and mounted == _AGREES:
                near = ((values[rows] - middle) ** 2 / variances[rows]).sum(axis=1) <= GATE
                kept = self._judge_stretch(cell, rows, near)
                if len(kept):
                    self._average(cell, kept, measured, path)
            else:
                self._decide(rows, mounted if sure else _UNSURE if member else _JUMPED)

    def _judge_stretch(self, cell: int, rows: Rows, near: NDArray[np.bool_]) -> Rows:
        """Decide about the measurements of a consistent stretch; return the accepted ones.

        If the stretch was in the map before, its measurements must also agree with the map. A stretch of which most
        measurements are rejected is rejected as a whole.
        """
        agrees = near & ((self._distances[rows] <= GATE) | (cell not in self._solved))
        if 2 * agrees.sum() < len(rows):
            agrees[:] = False
        self._decide(rows, _CONTRADICTS)
        self._decide(rows[~near], _JUMPED)
        self._decide(rows[agrees], _AGREES)
        if agrees.any():
            self._solved.add(cell)
        return rows[agrees]

    def _decide(self, rows: Rows, decision: Decision) -> None:
        for row in rows.tolist():
            self._decisions[row] = decision

    def _decide_all(self, decision: Decision) -> None:
        self._decisions = [decision] * len(self._measurements)
        self._misfits, self._distances = np.full((2, len(self._measurements)), np.nan)

    def _drifting(self, measured: Array, path: MeasuredPath) -> tuple[Array, Array]:
        """Return the (N, 3) values that drift slowly, and the rotations (N, 3, 3) of the body in their frame.

        The values are positions minus dead reckoning by the map's attitudes, or directions in the odometry's frame.
        """
        if self._source is Aid.GRAVITY:
            return apply(path.odometry, measured), path.odometry[:, :3, :3]
        steps = invert(path.odometry[:-1]) @ path.odometry[1:]
        walked = np.cumsum(np.concatenate([np.zeros((1, 3)), apply(path.poses[:-1], steps[:, :3, 3])]), axis=0)
        return measured - walked - apply(path.poses, self._levers), path.poses[:, :3, :3]

    def _judge_mounting(self, stretches: _Stretches, members: NDArray[np.bool_], rotations: Array) -> Decision:
        """Return whether a source may be accepted, by the error that rotates with the rover."""
        large, well_known = _MOUNTING[self._source]
        unknown = _AGREES  # a lever-arm error has little effect before the rover turns
        if self._source is Aid.GRAVITY:
            unknown = State.PENDING, AbsoluteReason.NOT_TURNED
        if members.sum() < _FEW_STRETCHES:
            return unknown
        turns = np.array([rotations[rows[len(rows) // 2]] for rows in stretches.rows])
        parts = stretches.middles, stretches.spreads, turns, stretches.travel
        values, spreads, turns, travel = (part[members] for part in parts)
        offset, covariance = body_offset(values, spreads, turns, travel, self._drift)
        offset, covariance = offset[:2], covariance[:2, :2]  # turns about the vertical do not show the third
        if np.sqrt(np.linalg.eigvalsh(covariance).max()) > well_known:
            return unknown
        if np.linalg.norm(offset) > large and float(offset @ np.linalg.solve(covariance, offset)) > _FLAT_GATE:
            self.mounting = offset
            return _MOUNTED_WRONG
        return _AGREES

    def _missed(self, measured: Array, path: MeasuredPath) -> Array:
        """Return the (N, 3) residuals of the measurements in the map."""
        if self._source is Aid.GRAVITY:
            return apply(path.poses, measured) - [0.0, 0.0, 1.0]
        return measured - path.poses[:, :3, 3] - apply(path.poses, self._levers)

    def _average(self, cell: int, rows: Rows, measured: Array, path: MeasuredPath) -> None:
        """Make the factor of a stretch: the mean position, at the mean of the lever arms along the path."""
        stamp_ns, middle = path.at_middle(cell)
        there = invert(middle) @ path.odometry[rows]
        # that of one measurement: errors of GNSS are correlated over more than a stretch
        covariance = np.mean([self._measurements[row].covariance for row in rows], axis=0) * self._scale**2
        if self._source is Aid.GNSS:
            mean = measured[rows].mean(axis=0)
            lever = (there[:, :3, 3] + apply(there, self._levers[rows])).mean(axis=0)
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance + _LEAST_SIGMA_M**2 * np.eye(3))
            numbers = stamp_ns, *mean, *lever, covariance.trace()

            def make(pose: Array, vertex: int) -> gtsam.NonlinearFactor:
                return gtsam.GPSFactorArm(vertex, mean, pose[:3, :3] @ lever + pose[:3, 3], noise)
        else:
            up = apply(there, measured[rows]).mean(axis=0)
            tilt = gtsam.noiseModel.Isotropic.Sigma(2, float(np.sqrt(covariance.trace() / 3)))
            numbers = stamp_ns, *up, covariance.trace()

            def make(pose: Array, vertex: int) -> gtsam.NonlinearFactor:
                return gtsam.AttitudeFactorPose3(vertex, gtsam.Unit3([0, 0, 1]), tilt, gtsam.Unit3(pose[:3, :3] @ up))

        self.factors[cell] = Factor(stamp_ns, middle, tuple(round(float(number), 6) for number in numbers), make)


def apply(poses: Array, vectors: Array) -> Array:
    """Return vectors (N, 3) rotated by poses (N, 4, 4)."""
    return (poses[:, :3, :3] @ vectors[..., None])[..., 0]


def _scatter(values: Array, variances: Array, stretches: _Stretches) -> float:
    """Return the factor by which measurements scatter more than stated, at least 1, in steps: it changes rarely."""
    ratios = [
        np.abs(values[rows] - middle) / np.sqrt(variances[rows])
        for rows, middle in zip(stretches.rows, stretches.middles, strict=True)
        if len(rows) > 2
    ]
    scale = 1.4826 * float(np.median(np.concatenate(ratios))) if ratios else 1.0
    return float(np.exp(_STEP * max(0.0, np.ceil(np.log(max(scale, 1e-9)) / _STEP))))
