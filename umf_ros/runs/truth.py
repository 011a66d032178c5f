"""Judge closures, their covariances and trajectories by ground truth."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from math import inf, isfinite, nan, radians
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from umf_ros.bags.reader import Bag
from umf_ros.core.config import Loop
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, align, heading, interpolate, invert, relative, transform, wrap_angle
from umf_ros.core.trajectory import Trajectory, bracket
from umf_ros.places.database import is_past
from umf_ros.runs.reader import FinishedRun
from umf_ros.runs.run_file import Endpoints
from umf_ros.sensors.motion_check import BETTER, CONTRAST
from umf_ros.sensors.sensor_check import SensorReport
from umf_ros.verification.hypothesis import Hypothesis

MEDIAN_EXPECTED = float(chdtri(6, 0.5))
"""Median of consistent normalised errors squared, 5.35: chi square with six degrees of freedom."""
CONSISTENT_MEDIAN = (3.0, 8.0)
CONSISTENT_INSIDE = 0.9


def pose_error(estimated: Array, true: Array) -> Array:
    """Return the error (..., 6) of poses (..., 4, 4) `match_T_query` in ROS order, about the axes of the match.

    The estimate is the truth, turned by the last three about the query's origin and shifted by the first three.
    """
    turn = Rotation.from_matrix(estimated[..., :3, :3] @ np.swapaxes(true[..., :3, :3], -1, -2)).as_rotvec()
    return np.concatenate([estimated[..., :3, 3] - true[..., :3, 3], turn], axis=-1)


def normalised_errors(errors: Array, covariances: Array) -> Array:
    """Return the normalised errors squared (...) of errors (..., 6) under covariances (..., 6, 6), ROS order."""
    weighed = np.linalg.solve(covariances, errors[..., None])[..., 0]
    found: Array = np.einsum("...i,...i->...", errors, weighed)
    return found


def share_inside(squared: Array) -> float:
    """Return the share of normalised errors squared inside the 95 % ellipsoid; NaN without any."""
    return float(np.mean(np.asarray(squared) < chdtri(6, 0.05))) if len(squared) else nan


def in_words(nees_median: float, inside_95: float) -> str:
    """Return a phrase that compares stated errors with true ones."""
    low, high = CONSISTENT_MEDIAN
    factor = (nees_median / MEDIAN_EXPECTED) ** 0.5
    if nees_median > high:
        return f"too small by a factor of {factor:.2g}"
    if nees_median < low:
        return f"too large by a factor of {1 / max(factor, 1e-9):.2g}"
    return "consistent" if inside_95 >= CONSISTENT_INSIDE else "consistent for most, too small for the worst"


PLACE_RADIUS_M = 12.0
PLACE_ANGLE_DEG = 30.0
POSE_TOLERANCE_M = 0.5
POSE_TOLERANCE_DEG = 5.0
TRUTH_SHARE = 0.5
"""By hand: largest error of an interpolated true pose, of the tolerances."""
CHORDS_S, LAGS_S = np.tile([2.0, 16.0], 150), np.arange(-600, 601) / 10
LEAST_OFFSET_S, COVERED = 0.3, 0.25
"""By hand: least offset of a clock that is reported, and least share of the odometry that the truth covers then."""

Stamps = NDArray[np.int64]


Judged = Any
"""(K,) closures judged by the truth, or one of them: a `numpy.recarray` or `numpy.record` of `JUDGED`."""
JUDGED = np.dtype(
    [
        ("query_stamp_ns", np.int64),
        ("match_stamp_ns", np.int64),
        ("probability", float),
        ("distance_m", float),
        ("translation_error_m", float),
        ("rotation_error_deg", float),
        ("nees", float),
        ("is_true", bool),
    ]
)
"""Stamps and probability of a closure, distance of its keyframes in truth, errors of its relative pose, its normalised
error squared under the stated covariance, and whether it is right. Where the truth has no orientation, the error of the
translation is that of its length, and those of rotation and normalised error are NaN."""


@dataclass(frozen=True)
class JudgedRun:
    """A run judged by the truth, if there is one, with its other data.

    Attributes:
        run: files of the run.
        closures: those whose endpoints the truth covers.
        revisits: keyframes that revisited an earlier place, in about the same direction.
        ate_odometry_m: error of the odometry, or None without odometry.
        ate_optimized_m: error of the optimised trajectory, or None.
        any_heading: numbers of keyframes near an earlier place, and of those with a true closure.
        covered: numbers of keyframes that the truth covers, and of all keyframes.
        missed: stamps of keyframes that revisited a place and have no closure.
        bag: the recording, or None.
        sensors: consistency of the recording's measurements.
        clock_offset_s: stamps of the truth minus those of the odometry; other than 0, nothing is judged.
    """

    run: FinishedRun
    closures: Judged = field(default_factory=lambda: judge_closures([], np.eye(4)[None], np.eye(4)[None]))
    revisits: int = 0
    ate_odometry_m: float | None = None
    ate_optimized_m: float | None = None
    any_heading: tuple[int, int] = (0, 0)
    covered: tuple[int, int] = (0, 0)
    missed: list[int] = field(default_factory=list)
    bag: Bag | None = None
    sensors: SensorReport = field(default_factory=SensorReport)
    clock_offset_s: float = 0.0

    def summary(self) -> dict[str, Any]:
        """Return the `ground_truth` entry of `summary.json`."""
        true = int(self.closures.is_true.sum())
        squared = self.closures.nees[np.isfinite(self.closures.nees)]
        return {
            "closures_true": true,
            "closures_false": len(self.closures) - true,
            "revisits": self.revisits,
            "revisits_any_heading": self.any_heading[0],
            "closed_any_heading": self.any_heading[1],
            "keyframes_covered": self.covered[0],
            "ate_odometry_m": _rounded(self.ate_odometry_m),
            "ate_optimized_m": _rounded(self.ate_optimized_m),
            # empty if no closure was judged by its whole pose
            "nees_median": _rounded(float(np.median(squared)) if len(squared) else None),
            "inside_95": _rounded(share_inside(squared) if len(squared) else None),
        }

    @cached_property
    def by_endpoints(self) -> dict[Endpoints, Judged]:
        """The judged closures by the stamps of query and match."""
        return {(int(one.query_stamp_ns), int(one.match_stamp_ns)): one for one in self.closures}

    @cached_property
    def tested(self) -> dict[int, list[Hypothesis]]:
        """The candidates of each keyframe by its stamp, in the order of the reranking."""
        tested: dict[int, list[Hypothesis]] = defaultdict(list)
        for candidate in self.run.candidates:
            tested[candidate.query_stamp_ns].append(candidate)
        return tested

    @cached_property
    def _true_poses(self) -> tuple[Array, NDArray[np.bool_]]:
        """True poses (N, 4, 4) of the keyframes, and (N,) whether each is known."""
        nowhere = Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4)), has_orientation=False)
        return true_poses(nowhere if self.clock_offset_s else self.run.truth or nowhere, self.run.stamps)[:2]

    @cached_property
    def _rows(self) -> dict[int, int]:
        return {stamp: row for row, stamp in enumerate(self.run.stamps.tolist())}

    def row(self, stamp_ns: int) -> int | None:
        """Return the row of a keyframe; None where there is none of this stamp."""
        return self._rows.get(stamp_ns)

    def admissible(self, row: int) -> NDArray[np.bool_]:
        """Return (row,) whether the gap rules allow earlier keyframes."""
        now, past = self.run.keyframes[row], self.run.keyframes[:row]
        ages, path_m = now["stamp_ns"] - past["stamp_ns"], now["path_length_m"] - past["path_length_m"]
        return is_past(ages, path_m, self.run.settings.loop, past["session"] == now["session"])

    def distances(self, row: int) -> NDArray[np.float64]:
        """Return (N,) metres in truth to every keyframe, infinite where it is unknown."""
        poses, known = self._true_poses
        apart = np.linalg.norm(poses[:, :3, 3] - poses[row, :3, 3], axis=1)
        return np.where(known & known[row], apart, np.inf)

    def distance(self, query_ns: int, match_ns: int) -> float:
        """Return metres in truth between two keyframes, infinite where it is unknown."""
        query, match = self.row(query_ns), self.row(match_ns)
        return inf if query is None or match is None else float(self.distances(query)[match])

    def same_places(self, row: int) -> NDArray[np.int64]:
        """Return earlier keyframes that are the same place and may be matched, the nearest first."""
        distances, same_view = self.distances(row)[:row], bool(self.run.truth and self.run.truth.has_orientation)
        near = np.isfinite(distances) & _near(self._true_poses[0], row, same_view)
        rows = np.flatnonzero(self.admissible(row) & near)
        return rows[np.argsort(distances[rows])]

    def is_same_place(self, query_ns: int, match_ns: int) -> bool | None:
        """Return whether two keyframes are within 12 m in truth, at any headings; None where that is unknown."""
        distance_m = self.distance(query_ns, match_ns)
        return distance_m <= PLACE_RADIUS_M if isfinite(distance_m) else None


def true_poses(truth: Trajectory, stamps: Stamps) -> tuple[Array, NDArray[np.bool_], Array]:
    """Return poses (K, 4, 4) at stamps, (K,) whether each is known, and (K, 2) errors of interpolation, m and rad.

    The errors follow from how far each sample is from the one interpolated without it. A pose whose error could make a
    right closure look false is unknown.
    """
    poses, known = truth.at(stamps)
    if len(truth) < 3:
        return poses, known, np.zeros((len(stamps), 2))
    past, future = np.diff(truth.stamps_ns[:-1]) * 1e-9, np.diff(truth.stamps_ns[1:]) * 1e-9
    guesses = interpolate(truth.poses[:-2], truth.poses[2:], past / (past + future))
    bends = np.pad(_sizes(relative(guesses, truth.poses[1:-1])) / (past * future), ((0, 0), (1, 1)), mode="edge")
    before, after, share = bracket(truth.stamps_ns, stamps)
    apart_s = (truth.stamps_ns[after] - truth.stamps_ns[before]) * 1e-9
    errors = (np.maximum(bends[:, before], bends[:, after]) * share * (1 - share) * apart_s**2).T
    limits = TRUTH_SHARE * np.array([POSE_TOLERANCE_M, radians(POSE_TOLERANCE_DEG)])
    return poses, known & (errors <= limits).all(axis=1), errors


def _sizes(poses: Array) -> Array:
    """Return (2, N) lengths in m and angles in rad of poses (N, 4, 4)."""
    return np.stack([np.linalg.norm(poses[:, :3, 3], axis=1), Rotation.from_matrix(poses[:, :3, :3]).magnitude()])


def clock_offset(odometry: Trajectory | None, truth: Trajectory) -> float:
    """Return seconds by which stamps of a truth are ahead of the odometry's, 0 unless the motion shows it clearly.

    Distances that the odometry and the truth cover within some seconds are compared, which need no common frame.
    """
    if odometry is None or not len(odometry) or not len(truth):
        return 0.0
    start_ns, end_ns = odometry.stamps_ns[[0, -1]].tolist()
    starts = np.linspace(0, max((end_ns - start_ns) * 1e-9 - max(CHORDS_S), 0), len(CHORDS_S))
    driven = _chords(odometry, starts, start_ns)
    differences = np.ma.masked_invalid(np.abs(_chords(truth, starts + LAGS_S[:, None], start_ns) - driven))
    costs = np.ma.masked_where(differences.count(axis=1) < COVERED * len(CHORDS_S), differences.mean(axis=1))
    # laps repeat the distances: of equal offsets the smallest
    best = int(np.ma.argmin(costs * (1 + 0.01 * np.abs(LAGS_S))))
    both = differences[[best, len(LAGS_S) // 2]]
    moved, unmoved = both[:, ~np.ma.getmaskarray(both).any(axis=0)].sum(axis=1)
    clear = moved < BETTER * unmoved and costs[best] < CONTRAST * np.ma.median(costs)
    return float(LAGS_S[best]) if clear and abs(LAGS_S[best]) >= LEAST_OFFSET_S else 0.0


def _chords(path: Trajectory, starts_s: Array, origin_ns: int) -> Array:
    """Return (...) distances from the positions at starts (...) to those `CHORDS_S` later, NaN outside."""
    seconds, positions = (path.stamps_ns - origin_ns) * 1e-9, path.poses[:, :3, 3].T
    begin, end = (
        np.stack([np.interp(starts_s + later, seconds, axis, nan, nan) for axis in positions])
        for later in (0, CHORDS_S)
    )
    return np.linalg.norm(end - begin, axis=0)


def judge_run(run: FinishedRun, bag: Bag | None = None) -> JudgedRun:
    """Judge closures, odometry and optimised trajectory of a run by the truth, if there is one."""
    truth, rules = run.truth, run.settings.loop
    if truth is None:
        return JudgedRun(run, bag=bag)
    if offset_s := clock_offset(run.odometry, truth):
        return JudgedRun(run, bag=bag, covered=(0, len(run.stamps)), clock_offset_s=offset_s)
    poses, known, _ = true_poses(truth, run.stamps)
    keyframes, poses = run.keyframes[known], poses[known]
    stamps = keyframes["stamp_ns"]
    ends, covered, errors = true_poses(truth, np.array([one.endpoints for one in run.closures], np.int64).ravel())
    both = np.flatnonzero(covered.reshape(-1, 2).all(axis=1))
    query, match = ends.reshape(-1, 2, 4, 4)[both].swapaxes(0, 1)
    of_truth = errors.reshape(-1, 2, 2)[both]
    judged = judge_closures([run.closures[row] for row in both], query, match, truth.has_orientation, of_truth)
    revisits = partial(find_revisits, stamps, poses, keyframes["path_length_m"], rules, sessions=keyframes["session"])
    again, same_view = revisits(same_view=False), revisits(same_view=truth.has_orientation)
    published = {closure.query_stamp_ns for closure in run.closures}
    return JudgedRun(
        run,
        closures=judged,
        revisits=int(same_view.sum()),
        any_heading=(int(again.sum()), int(np.isin(stamps[again], judged.query_stamp_ns[judged.is_true]).sum())),
        covered=(len(stamps), len(known)),
        missed=[stamp for stamp in stamps[same_view].tolist() if stamp not in published],
        ate_odometry_m=trajectory_error(run.odometry, truth),
        ate_optimized_m=trajectory_error(run.optimized, truth),
        bag=bag,
    )


def judge_closures(
    closures: Sequence[LoopClosure],
    world_T_query: Array,
    world_T_match: Array,
    has_orientation: bool = True,
    of_truth: ArrayLike = 0.0,
) -> Judged:
    """Judge closures (K,) by the true poses (K, 4, 4) of their keyframes.

    True means: both keyframes within 12 m of each other [UMF 5.1.2], at any headings, and the published
    relative pose within 0.5 m and 5 deg. A truth of positions alone (RTKLIB) checks distances only. Its own errors at
    both ends, `of_truth` (K, 2, 2) in m and rad, are allowed beyond these limits.
    """
    found: Judged = np.zeros(len(closures), JUDGED).view(np.recarray)
    if not closures:
        return found
    poses, truth = np.stack([one.match_T_query for one in closures]), relative(world_T_match, world_T_query)
    found.query_stamp_ns, found.match_stamp_ns = np.array([one.endpoints for one in closures], np.int64).T
    found.probability = [one.probability for one in closures]
    found.distance_m = np.linalg.norm(truth[:, :3, 3], axis=1)
    (query_m, query_rad), (match_m, match_rad) = np.broadcast_to(of_truth, (len(closures), 2, 2)).transpose(1, 2, 0)
    metres, turned = query_m + match_m + match_rad * found.distance_m, query_rad + match_rad
    if has_orientation:
        error = invert(truth) @ poses
        found.translation_error_m = np.linalg.norm(error[:, :3, 3], axis=1)
        found.rotation_error_deg = np.degrees(Rotation.from_matrix(error[:, :3, :3]).magnitude())
        own = np.repeat(np.stack([metres, turned], axis=1) ** 2, 3, axis=1)[:, None] * np.eye(6)
        found.nees = normalised_errors(pose_error(poses, truth), np.stack([one.covariance for one in closures]) + own)
    else:
        found.translation_error_m = np.abs(np.linalg.norm(poses[:, :3, 3], axis=1) - found.distance_m)
        found.rotation_error_deg = found.nees = nan
    pose_ok = found.translation_error_m <= POSE_TOLERANCE_M + metres
    pose_ok &= ~(found.rotation_error_deg > POSE_TOLERANCE_DEG + np.degrees(turned))
    found.is_true = (found.distance_m <= PLACE_RADIUS_M) & pose_ok
    return found


def find_revisits(
    stamps: Stamps,
    world_T_body: Array,
    path_length_m: Array,
    rules: Loop,
    same_view: bool = True,
    sessions: NDArray[np.int64] | None = None,
) -> NDArray[np.bool_]:
    """Return (N,) whether keyframes are revisits, within 12 m and 30 deg of heading of an admissible earlier keyframe.

    Args:
        stamps: (N,) ns, ascending.
        world_T_body: (N, 4, 4) true poses.
        path_length_m: (N,) path length, NaN where unknown.
        rules: gap rules that earlier keyframes must meet.
        same_view: whether headings count; otherwise a place may be revisited at any heading.
        sessions: (N,) of odometry, in each of which the path length begins again; None: one session.
    """
    sessions = np.zeros(len(stamps), np.int64) if sessions is None else sessions
    revisits = np.zeros(len(stamps), bool)
    for row in range(len(stamps)):
        path_m, same_session = path_length_m[row] - path_length_m[:row], sessions[:row] == sessions[row]
        past = is_past(stamps[row] - stamps[:row], path_m, rules, same_session)
        revisits[row] = bool((_near(world_T_body, row, same_view) & past).any())
    return revisits


def _near(world_T_body: Array, row: int, same_view: bool) -> NDArray[np.bool_]:
    """Return (row,) whether earlier poses of (N, 4, 4) are the same place as the one in this row."""
    there, here = world_T_body[:row], world_T_body[row]
    near = np.linalg.norm(there[:, :3, 3] - here[:3, 3], axis=1) <= PLACE_RADIUS_M
    if same_view:
        near &= np.abs(wrap_angle(heading(there) - heading(here))) <= radians(PLACE_ANGLE_DEG)
    return np.asarray(near)


def trajectory_error(estimate: Trajectory | None, truth: Trajectory) -> float | None:
    """Return ATE in metres where the truth covers the estimate; None when it covers fewer than three poses."""
    if estimate is None:
        return None
    poses, known = truth.at(estimate.stamps_ns)
    if np.count_nonzero(known) < 3:
        return None
    return absolute_trajectory_error(estimate.poses[known, :3, 3], poses[known, :3, 3])


def absolute_trajectory_error(estimate: Array, truth: Array) -> float:
    """Return the root mean square distance in metres of (N, 3) positions after rigid alignment [Sturm 2012]."""
    aligned = transform(align(estimate, truth)[0], estimate)
    return float(np.sqrt(np.mean(np.sum((aligned - truth) ** 2, axis=1))))


def pose_in_truth(trajectory: Trajectory, truth: Trajectory | None) -> Array:
    """Return the pose (4, 4) of a trajectory's frame in that of the truth, for drawing.

    They coincide at the first pose that the truth covers, or are aligned to a truth without headings. It is the
    identity without a truth, or where it covers fewer than three poses.
    """
    if truth is None or trajectory is truth:
        return np.eye(4)
    poses, known = truth.at(trajectory.stamps_ns)
    if np.count_nonzero(known) < 3:
        return np.eye(4)
    if not truth.has_orientation:
        return align(trajectory.poses[known, :3, 3], poses[known, :3, 3])[0]
    first = int(np.flatnonzero(known)[0])
    return np.asarray(poses[first] @ invert(trajectory.poses[first]))


def positions_in_truth(trajectory: Trajectory, truth: Trajectory | None) -> Array:
    """Return positions (N, 3) in metres in the frame of the truth, for drawing."""
    return transform(pose_in_truth(trajectory, truth), trajectory.poses[:, :3, 3])


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
