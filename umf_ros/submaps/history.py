"""Submaps: scans of the metres around a keyframe, merged where its own scan shows too little of the place."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Keyframe, ScanMotion
from umf_ros.core.geometry import Array, cubes, first_of_cubes, heading, median_range, relative, transform
from umf_ros.places.store import KeyframeStore
from umf_ros.submaps.lookalikes import KeypointIndex
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan
from umf_ros.verification.scan_alignment import align_scans


def submap_of(keyframe: Keyframe, others: Sequence[Keyframe], drift: DriftMeter) -> Keyframe | None:
    """The keyframe with the scans merged that it needs, as if they were one scan; None where it needs or may have none.

    Args:
        keyframe: its own scan stays as it is.
        others: of the same session, the nearest along the path first.
        drift: of the odometry.
    """
    reach_m = median_range(keyframe.points)
    needed = needed_scans(keyframe, others)
    sharp = [one for one in needed if drift.blur(_way_m(keyframe, one), reach_m) < const.MAX_BLUR_M]
    return _merged(keyframe, sharp, drift) if sharp else None


def needed_scans(keyframe: Keyframe, others: Sequence[Keyframe]) -> Sequence[Keyframe]:
    """The first of the others that together show most of what all do nearby; none where the keyframe's own does.

    A sensor that is sparse at the distances of the structure, or sees little of what is around, needs many.
    """
    reach_m = median_range(keyframe.points)
    cell_m = float(np.clip(reach_m / const.REACH_CELLS, *const.MAP_CELL_M))
    seen, counts = np.empty(0, np.int64), []
    for one in (keyframe, *others):
        points = moved_to(keyframe, one)
        near = points[np.einsum("ij,ij->i", points, points) < reach_m**2]
        seen = np.union1d(seen, cubes(near, cell_m))
        counts.append(len(seen))
    shares = np.array(counts) / max(counts[-1], 1)
    return [] if shares[0] >= const.ENOUGH_SEEN else others[: int(np.argmax(shares >= const.MOST_SEEN))]


def moved_to(keyframe: Keyframe, other: Keyframe) -> Array:
    """Points (N, 3) of another keyframe of the session in the body frame of this one, by odometry, m."""
    return transform(_body_T_other(keyframe, other), other.points.astype(float))


def _merged(keyframe: Keyframe, others: Sequence[Keyframe], drift: DriftMeter) -> Keyframe:
    """The keyframe with the points of others where it has none; of those in a cube, of the nearest along the path."""
    scans = [keyframe, *others]
    clouds = [moved_to(keyframe, one) for one in scans]
    points = np.concatenate(clouds)
    owner = np.repeat(np.arange(len(scans)), [len(one.points) for one in scans])
    inside = (owner == 0) | (np.einsum("ij,ij->i", points, points) < const.MAX_RANGE_M**2)
    points, owner = points[inside], owner[inside]
    cell_m, chosen = const.THIN_CELL_M, first_of_cubes(points, const.THIN_CELL_M)
    while len(chosen) > const.MERGED_POINTS and len(chosen) > len(keyframe.points):
        cell_m *= max(float(np.sqrt(len(chosen) / const.MERGED_POINTS)), 1.05)
        chosen = first_of_cubes(points, cell_m)
        chosen = np.concatenate([np.arange(len(keyframe.points)), chosen[owner[chosen] > 0]])
    taken = sorted(set(owner[chosen].tolist()), key=lambda number: scans[number].stamp_ns)
    seconds = np.array([1e-9 * (one.stamp_ns - keyframe.stamp_ns) for one in scans], np.float32)
    way_m, lasted_s = max(_way_m(keyframe, one) for one in scans), max(float(np.abs(seconds).max()), 1e-3)
    motion = ScanMotion(
        seconds[owner[chosen]],
        np.zeros(6),
        drift.variance(way_m) / lasted_s,
        removed=keyframe.motion is not None,
        body_T_lidars=np.stack([_body_T_other(keyframe, scans[i]) @ scans[i].body_T_lidar for i in taken]),
        scans=tuple(clouds[i].astype(np.float32) for i in taken),
    )
    return replace(keyframe, points=points[chosen].astype(np.float32), motion=motion)


def _body_T_other(keyframe: Keyframe, other: Keyframe) -> Array:
    if keyframe.odom_T_body is None or other.odom_T_body is None:
        raise ValueError("scans are merged by odometry")
    return relative(keyframe.odom_T_body, other.odom_T_body)


def _way_m(keyframe: Keyframe, other: Keyframe) -> float:
    return abs(keyframe.path_length_m - other.path_length_m)


def submap_around(keyframe: Keyframe, others: Sequence[Keyframe]) -> Keyframe | None:
    """The keyframe merged with those around it on its path, by the drift that they themselves show; as `submap_of`."""
    others = sorted(others, key=lambda one: _way_m(keyframe, one))
    if not needed_scans(keyframe, others):
        return None
    return submap_of(keyframe, others, drift_along(sorted([keyframe, *others], key=lambda one: one.path_length_m)))


def drift_along(path: Sequence[Keyframe]) -> DriftMeter:
    """The drift of odometry on the second half of a path, where there are scans before."""
    drift = DriftMeter()
    for number in range(len(path) // 2, len(path)):
        keyframe = path[number]
        before = [one for one in path[number - 1 :: -1] if _way_m(keyframe, one) <= const.ODOMETRY_REACH_M]
        if number and needed_scans(keyframe, before):
            drift.add(keyframe, before)
    return drift


class DriftMeter:
    """Compares scans with those before them, as odometry joins them, over the latest tens of metres.

    A submap is no better than the odometry that joined it, and a wheel that slips in proportion to the path is nothing
    that its noise would show. Against all scans before it even a sparse scan can be aligned.
    """

    def __init__(self) -> None:
        self._gaps: deque[Array] = deque(maxlen=const.DRIFT_STEPS)

    def add(self, keyframe: Keyframe, before: Sequence[Keyframe]) -> None:
        """Compare a scan with those before it, newest first."""
        points = np.concatenate([moved_to(before[0], one) for one in before[::-1]])
        ways_m = np.concatenate([np.full(len(one.points), _way_m(keyframe, one)) for one in before[::-1]])
        oldest = first_of_cubes(points, const.TERRAIN_CELL_M)
        match = PreparedScan(points[oldest].astype(np.float32))
        query = PreparedScan.of(keyframe)
        if not (match.usable and query.usable):
            return
        moved = _body_T_other(before[0], keyframe)
        aligned = align_scans(match, query, moved)
        if aligned.overlap >= const.ENOUGH_SEEN:
            gap = relative(moved, aligned.pose)
            way_m = float(ways_m[oldest[aligned.pairs[:, 1]]].mean())
            self._gaps.append(np.array([*gap[:3, 3], heading(gap), way_m]))

    def variance(self, way_m: float) -> Array:
        """Variances (6,) x y z rx ry rz that odometry gains on a path, m^2 and rad^2; infinite if unknown."""
        if len(self._gaps) < const.DRIFT_KNOWN:
            return np.full(6, np.inf)
        gaps = np.array(self._gaps)
        ways = gaps[:, 4:]
        # what every metre adds alike, and what metres add by chance
        bias = np.median(gaps[:, :4] / ways, axis=0)
        chance = 1.4826 * np.median(np.abs(gaps[:, :4] - bias * ways) / np.sqrt(ways), axis=0)
        # the estimate of the bias errs too: by more, the shorter the path it was measured on
        variance = (bias * way_m) ** 2 + chance**2 * way_m * (1 + way_m / ways.sum())
        return np.append(variance, variance[[3, 3]])

    def blur(self, way_m: float, reach_m: float) -> float:
        """How far a point at a distance lies beside its place after a path, standard deviation, m."""
        variance = self.variance(way_m)
        return float(np.sqrt(variance[:2].sum() + variance[5] * reach_m**2))


Rows = NDArray[np.intp]


class SubmapHistory:
    """Keyframes of the database by where they lie on the path of their session, and submaps of their scans.

    Args:
        store: has the keyframes; only their odometry and some submaps are kept here.

    Attributes:
        needed: whether single scans of this session show too little of a place.
        keypoints: of submaps, of every third metre; those of a stored file are read.
    """

    def __init__(self, store: KeyframeStore) -> None:
        self.store = store
        self._odometry: dict[int, Array] = {}
        self._drifts: dict[int, DriftMeter] = {}
        self._submaps: OrderedDict[tuple[int, int], Keyframe] = OrderedDict()
        self.keypoints = KeypointIndex(store.keypoints())
        self._described = set(self.keypoints.rows)
        self.reset()

    def reset(self) -> None:
        """Begin a session."""
        self.needed = False
        self._recent: list[Keyframe] = []

    def add(self, keyframe: Keyframe) -> bool:
        """Take up the newest keyframe if it lies far enough from the one before; returns whether it did."""
        if not can_be_merged(keyframe) or not self.lengthens(keyframe):
            return False
        before = self.scans_before(keyframe)
        self.needed = bool(needed_scans(keyframe, before))
        if self.needed:
            self._drifts.setdefault(keyframe.session, DriftMeter()).add(keyframe, before)
        self._recent = [keyframe, *before]
        return True

    def lengthens(self, keyframe: Keyframe) -> bool:
        """Whether the newest keyframe lies far enough from the last one that was taken up."""
        before = self.scans_before(keyframe)
        return not before or keyframe.path_length_m - before[0].path_length_m >= const.MERGE_STEP_M

    def describe(self, session: int, complete_m: float = np.inf, most: int | None = None) -> None:
        """Find and store the keypoints of submaps of a session, of every third metre of its path.

        Args:
            session: whose keyframes are stored.
            complete_m: where on its path submaps are complete.
            most: submaps that are described now, a tenth of a second each; None: all.
        """
        rows = self.rows(session, -np.inf, complete_m)[:: const.DESCRIBED_EVERY].tolist()
        for row in [one for one in rows if one not in self._described][:most]:
            self._described.add(row)
            if (submap := self.around(row)) is not None:
                keypoints = PreparedScan.of(submap).keypoints
                self.keypoints.add(row, keypoints)
                self.store.add_keypoints(row, keypoints)

    def rows(self, session: int, first_m: float, last_m: float) -> Rows:
        """Rows of the database on a part of a session's path, in its order, one of every 1.5 m."""
        keys = self.store.keys
        path_m = keys["travelled_m"]  # NaN without odometry
        rows = np.flatnonzero((keys["session"] == session) & (path_m >= first_m) & (path_m <= last_m))
        return rows[np.unique(path_m[rows] // const.MERGE_STEP_M, return_index=True)[1]]

    def drift(self, session: int) -> DriftMeter:
        """Drift of the odometry of a session; a stored one's is measured in the middle of its path."""
        if session not in self._drifts:
            rows, reach = self.rows(session, -np.inf, np.inf), round(const.ODOMETRY_REACH_M / const.MERGE_STEP_M)
            middle = rows[max(len(rows) // 2 - reach, 0) : len(rows) // 2 + reach].tolist()
            path = [one for one in map(self.store.__getitem__, middle) if can_be_merged(one)]
            self._drifts[session] = drift_along(path)
        return self._drifts[session]

    def odometry(self, row: int) -> Array:
        """Odometry (4, 4) of a keyframe that has some."""
        if row not in self._odometry:
            found = self.store[row].odom_T_body
            assert found is not None
            self._odometry[row] = found
        return self._odometry[row]

    def scans_before(self, keyframe: Keyframe, first_m: float = -np.inf) -> list[Keyframe]:
        """Keyframes on the last metres before the newest one, newest first, none of them before a place of the path."""
        first_m = max(first_m, keyframe.path_length_m - const.ODOMETRY_REACH_M)
        recent = [one for one in self._recent if one.session == keyframe.session]
        return [one for one in recent if first_m <= one.path_length_m < keyframe.path_length_m]

    def before(self, keyframe: Keyframe, first_m: float = -np.inf) -> Keyframe | None:
        """The newest keyframe as the submap of the last metres; None where there is none."""
        if not can_be_merged(keyframe):
            return None
        return submap_of(keyframe, self.scans_before(keyframe, first_m), self.drift(keyframe.session))

    def around(self, row: int, last_m: float = np.inf) -> Keyframe | None:
        """A keyframe of the database as the submap of what was seen before and after it; None where there is none.

        Args:
            row: of the keyframe.
            last_m: metres driven up to the last scan that may be used.
        """
        keyframe = self.store[row]
        if not can_be_merged(keyframe):
            return None
        centre_m = keyframe.path_length_m
        last_m = min(last_m, centre_m + const.ODOMETRY_REACH_M)
        key = row, round(last_m)
        submap = self._submaps.pop(key, None)
        if submap is None:
            rows = self.rows(keyframe.session, centre_m - const.ODOMETRY_REACH_M, last_m)
            others = [one for one in (self.store[i] for i in rows.tolist() if i != row) if can_be_merged(one)]
            others.sort(key=lambda one: _way_m(keyframe, one))
            submap = submap_of(keyframe, others, self.drift(keyframe.session))
        if submap is not None:
            self._submaps[key] = submap
            if len(self._submaps) > const.SCANS_KEPT:
                self._submaps.popitem(last=False)
        return submap


def can_be_merged(keyframe: Keyframe) -> bool:
    """Whether a keyframe has odometry and a scan."""
    return keyframe.odom_T_body is not None and len(keyframe.points) >= const.MIN_SCAN_POINTS
