"""Poses for a candidate: from maps, from images where scans tell nothing, and from findings of earlier keyframes.

Scans are searched whatever the heading. The query's map is turned to every heading at which the two can see the same
things and is correlated with the match's over all shifts at once (FFT): its relief alone, and relief with structure; in
the open the one is right, among walls the other. Correlations of submaps are divided by what chance gives: seen from
two sides, they share little at the right pose and much at others. Every peak is refined by some steps of ICP on a few
points, and ranked by how many of those that the other scan should see have a counterpart. It needs no training and does
not depend on the light.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe, Points
from umf_ros.core.geometry import Array, heading, invert, make_pose, near, relative, transform
from umf_ros.verification import constants as const
from umf_ros.verification.grid_map import Spectra, terrain_fit
from umf_ros.verification.hypothesis import Hypothesis, same_pose
from umf_ros.verification.keypoints import common_keypoints
from umf_ros.verification.prepared_scan import PreparedScan, levelled, structured, submaps, views_decide
from umf_ros.verification.scan_alignment import run_gicp
from umf_ros.verification.view_alignment import PairedViews


class Fit(NamedTuple):
    """One way two scans could lie on each other.

    Attributes:
        pose: (4, 4) `match_T_query`.
        share: of some points that the other scan should see, how many have a counterpart; the mean of both ways.
        terrain: how well the relief fits there, in standard deviations of chance.
    """

    pose: Array
    share: float
    terrain: float

    @property
    def score(self) -> float:
        """Rank of the fit: counterparts, and terrain where they say little."""
        return self.share + const.TERRAIN_WEIGHT * self.terrain


class RotatedMaps:
    """Spectra of a query's map at every heading, each made when it is first asked for."""

    def __init__(self, scan: PreparedScan) -> None:
        self.scan = scan
        self.map = scan.map(scan.cell_m)
        self._spectra: dict[int, dict[int, Spectra]] = {1: {}, 2: {}}

    def spectra(self, wanted: NDArray[np.intp], power: int = 1) -> Spectra:
        """Spectra (H, 2, ...), conjugated, of the map or its square at the headings (H,) by index."""
        known = self._spectra[power]
        fresh = [index for index in wanted.tolist() if index not in known]
        if fresh:
            known |= dict(zip(fresh, self.map.turned_spectra(const.ALL_HEADINGS[fresh], power), strict=True))
        return np.stack([known[index] for index in wanted.tolist()])


def search(match: PreparedScan, turned: RotatedMaps) -> list[Fit]:
    """The best fits, best first, each from a peak of its own."""
    overlap = match.view.overlap(turned.scan.view, const.ALL_HEADINGS)
    wanted = np.flatnonzero(overlap >= const.SEARCHED_OVERLAP)
    theirs, ours = match.map(turned.map.cell_m), turned.map
    if not len(wanted) or min(len(theirs.rows), len(ours.rows)) < const.FEWEST_POINTS:
        return []
    correlation, peaks = _correlate(theirs.spectra, turned.spectra(wanted), theirs.side), const.PEAKS
    if submaps(match, turned.scan):
        peaks = const.SUBMAP_PEAKS
        variance = np.maximum(_correlate(theirs.squared_spectra, turned.spectra(wanted, 2), theirs.side), 1e-12)
        correlation /= np.sqrt(variance + const.LEAST_CHANCE * variance.max(axis=(1, 2, 3), keepdims=True))
    best = _peaks(correlation, wanted, peaks, ours.cell_m)
    guesses = [lifted(match, turned.scan, float(const.ALL_HEADINGS[index]), shift) for index, shift in best]
    return sorted(coarse_align(match, turned.scan, guesses), key=lambda fit: -fit.score)


def coarse_align(match: PreparedScan, query: PreparedScan, guesses: Sequence[Array]) -> list[Fit]:
    """Refine poses by a few points, and rank them by how many of these find a counterpart.

    Poses that nothing could have spoken against are left out: two bare planes fit anywhere.
    """
    poses = _by_scouts(match, query, guesses)
    reach_m = const.SCOUT_NEAR * query.cell_m
    there = _found_shares(match, query.oriented_scouts.points, poses, reach_m)
    back = _found_shares(query, match.oriented_scouts.points, [invert(pose) for pose in poses], reach_m)
    known = structured(match, query)
    fits = []
    for pose, share in zip(poses, (there + back) / 2, strict=True):
        terrain = terrain_fit(match.terrain, query.terrain, levelled(match, query, pose))
        if known or terrain >= const.MIN_MAP_SCORE:
            fits.append(Fit(pose, float(share), terrain))
    return fits


def _found_shares(scan: PreparedScan, points: Array, poses: list[Array], reach_m: float) -> Array:
    """(K,) of points (N, 3) at poses that a scan should see, the share within a reach of its own; less of few."""
    if not poses:
        return np.empty(0)
    points, reaches = np.ascontiguousarray(points), np.full(len(points), reach_m)
    misfits = scan.free_space.point_misfits(scan.tree, points, reaches, np.stack(poses), 1.0)
    return np.asarray((misfits < 1.0).sum(axis=1) / np.maximum(np.isfinite(misfits).sum(axis=1), const.FEWEST_POINTS))


def alternatives(match: PreparedScan, query: PreparedScan, pose: Array) -> list[Array]:
    """Where else the query could lie at the heading of a pose or turned round, refined: the peaks but that of the pose.

    Rooms often look much the same turned by 180 deg.
    """
    level = levelled(match, query, pose)
    theirs, ours = match.map(query.cell_m), query.map(query.cell_m)
    turns = float(heading(level)) + np.array([0.0, np.pi])
    correlation = _correlate(theirs.spectra, ours.turned_spectra(turns), theirs.side)
    row, column = np.round(level[:2, 3] / query.cell_m).astype(int) + const.MAP_SHIFT
    correlation[:, 0, max(row - 1, 0) : max(row + 2, 0), max(column - 1, 0) : max(column + 2, 0)] = -np.inf
    found = []
    for number in np.flatnonzero(match.view.overlap(query.view, turns) >= const.SEARCHED_OVERLAP):
        peaks = _peaks(correlation[:, [number]], np.zeros(1, np.intp), const.PEAKS // 2, query.cell_m)
        found += _by_scouts(match, query, [lifted(match, query, turns[number], shift) for _, shift in peaks])
    return [one for one in found if not near(one, pose, const.DISTINCT_M, np.pi / 2)]


def _by_scouts(match: PreparedScan, query: PreparedScan, guesses: Sequence[Array]) -> list[Array]:
    """Poses refined by some steps on a few points."""
    return [run_gicp(match, query.oriented_scouts, guess, const.COARSE_REACH_M) for guess in guesses]


def _correlate(around: Spectra, turned: Spectra, side: int) -> NDArray[np.float32]:
    """Correlation (2, H, shifts, shifts) of the relief, and of relief and structure together."""
    products = around * turned
    products[:, 1] += products[:, 0]
    window = np.arange(-const.MAP_SHIFT, const.MAP_SHIFT + 1)
    rows = scipy.fft.ifft(products, axis=-2)[..., window, :]
    return np.asarray(scipy.fft.irfft(rows, side, axis=-1)[..., window].swapaxes(0, 1))


def _peaks(volumes: NDArray[np.float32], turns: NDArray[np.intp], count: int, cell_m: float) -> list[tuple[int, Array]]:
    """Heading and shift (2,) m of the highest peaks of each volume, so many of each, no two of them neighbours."""
    peaks: list[tuple[int, Array]] = []
    every = np.full((len(const.ALL_HEADINGS), *volumes.shape[2:]), -np.inf, np.float32)
    taken = np.zeros(every.shape, bool)
    for volume in volumes:
        every[turns] = volume
        for _ in range(count):
            every[taken] = -np.inf
            index, row, column = (int(i) for i in np.unravel_index(int(every.argmax()), every.shape))
            if not every[index, row, column] > 0:
                break
            peaks.append((index, (np.array([row, column]) - const.MAP_SHIFT) * cell_m))
            beside = np.arange(index - 1, index + 2) % len(every)
            taken[beside, max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = True
    return peaks


def lifted(match: PreparedScan, query: PreparedScan, turn: float, shift: Array) -> Array:
    """`match_T_query` of a planar fit, rad and (2,) m between the upright frames, with the height of the ground."""
    theirs, ours = match.map(query.cell_m), query.map(query.cell_m)
    cos, sin = math.cos(turn), math.sin(turn)
    planar = make_pose(np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]), [*shift, 0.0])
    offset = theirs.look_up(theirs.lowest, transform(planar, ours.cells)) - ours.lowest[ours.rows, ours.columns]
    known = offset[np.isfinite(offset)]
    if len(known):
        planar[2, 3] = np.median(known)
    return np.asarray(invert(match.upright_T_body) @ planar @ query.upright_T_body)


def predicted_hypotheses(
    query: Keyframe, offered: tuple[Candidate, Keyframe], scans: tuple[PreparedScan, PreparedScan], pose: Array
) -> list[Hypothesis]:
    """The pose `match_T_query` for a candidate that odometry carries over from a closure; none where it fits nothing.

    Args:
        query: the query keyframe.
        offered: the candidate, and its keyframe.
        scans: of match and query; only where they tell the pose is there a hypothesis.
        pose: as odometry has it.
    """
    if not all(scan.usable for scan in scans) or views_decide(*scans):
        return []
    fits = coarse_align(*scans, [pose])
    return [Hypothesis.of(query, *offered, pose=fit.pose, score=fit.score) for fit in fits]


def find_hypotheses(
    query: Keyframe,
    candidate: Candidate,
    keyframe: Keyframe,
    turned: RotatedMaps | None,
    match: PreparedScan,
    settings: Verification,
    guess: Array | None = None,
) -> list[Hypothesis]:
    """Distinct poses for one candidate, best first; where scans tell places apart, those at which their maps fit.

    Args:
        query: the query keyframe.
        candidate: the candidate, reranked.
        keyframe: its keyframe.
        turned: the query's map at every heading; None without a usable scan.
        match: the candidate's scan, usable or not.
        settings: RANSAC iterations and seed.
        guess: `match_T_query` (4, 4) as odometry has it; without it the keypoints of submaps give one.
    """
    if turned is None or views_decide(match, turned.scan):
        views = paired_views(query, keyframe, settings)
        seen = views.best_pose() if views else None
        if seen is not None:
            return [Hypothesis.of(query, candidate, keyframe, pose=seen[0], score=seen[1], views=views)]
        if turned is None or not match.usable or views is not None:
            return []
    fits = search(match, turned)
    if guess is None and submaps(match, turned.scan):
        count, turn, shift = common_keypoints(turned.scan.keypoints, match.keypoints)
        guess = lifted(match, turned.scan, turn, shift) if count else None
    if guess is not None:  # submaps that share little would not rank it first
        fits = [fit._replace(share=1.0) for fit in coarse_align(match, turned.scan, [guess])] + fits
    distinct: list[Fit] = []
    for fit in fits:
        if not any(same_pose(fit.pose, other.pose) for other in distinct):
            distinct.append(fit)
    return [Hypothesis.of(query, candidate, keyframe, pose=fit.pose, score=fit.score) for fit in distinct]


def consistent_pixels(hypothesis: Hypothesis, settings: Verification) -> Points:
    """Return the pixels (K, 4) of the image features of query and match that agree with the pose of a hypothesis."""
    query, match = hypothesis.keyframes
    views = hypothesis.views or paired_views(query, match, settings)
    return np.empty((0, 4), np.float32) if views is None else views.consistent_pixels(hypothesis.pose)


def paired_views(query: Keyframe, match: Keyframe, settings: Verification) -> PairedViews | None:
    """Both images with their paired features; None without any."""
    if settings.modalities == "cloud":
        return None
    return PairedViews.of(query, match, const.VIEW_NOISE[settings.features])


class _Finding(NamedTuple):
    query: Keyframe
    match: Keyframe
    match_T_query: Array
    accepted: bool


class TemporalMemory:
    """Poses found for the last few keyframes, accepted or not; the same live and offline."""

    def __init__(self) -> None:
        self._findings: dict[int, list[_Finding]] = {}  # by the query's stamp

    def reset(self) -> None:
        """Forget everything."""
        self._findings.clear()

    def remember(self, query: Keyframe, found: list[tuple[Keyframe, Array, bool]]) -> None:
        """Add what one keyframe found: matched keyframes, `match_T_query` and whether it was accepted."""
        self._findings.setdefault(query.stamp_ns, []).extend(_Finding(query, *finding) for finding in found)
        if len(self._findings) > const.MEMORY_KEYFRAMES:
            del self._findings[next(iter(self._findings))]

    def expected(
        self, query: Keyframe, candidates: Sequence[tuple[Candidate, Keyframe]]
    ) -> tuple[tuple[Candidate, Keyframe], Array] | None:
        """The candidate nearest to where earlier closures and odometry put the rover, and its `match_T_query` there.

        None without one within 4 m.
        """
        poses = [(one, self._expected_pose(query, one[1])) for one in candidates]
        away = [(float(np.linalg.norm(pose[:3, 3])), one, pose) for one, pose in poses if pose is not None]
        nearest = min(away, key=lambda found: found[0], default=None)
        return nearest[1:] if nearest is not None and nearest[0] < const.SAME_PLACE_M else None

    def _expected_pose(self, query: Keyframe, match: Keyframe) -> Array | None:
        """`match_T_query` as odometry carries it over from the latest accepted closure near the pair; None without."""
        accepted = (one for findings in reversed(self._findings.values()) for one in findings if one.accepted)
        carried = (_carried(finding, query, match) for finding in accepted)
        return next((pose for pose in carried if pose is not None), None)

    def support(self, query: Keyframe, match: Keyframe, match_T_query: Array) -> float:
        """How many of the remembered earlier keyframes found a pose that odometry carries over to this one."""
        earlier = [findings for stamp_ns, findings in self._findings.items() if stamp_ns != query.stamp_ns]
        carried = [[_carried(finding, query, match) for finding in findings] for findings in earlier]
        return float(sum(any(one is not None and same_pose(one, match_T_query) for one in poses) for poses in carried))


def _carried(found: _Finding, query: Keyframe, match: Keyframe) -> Array | None:
    """`match_T_query` as odometry carries it over from an earlier finding; None where that is far or unknown."""
    steps, way_m = [], 0.0
    for before, now in ((found.query, query), (found.match, match)):
        if before.odom_T_body is None or now.odom_T_body is None or before.session != now.session:
            return None
        steps.append((before.odom_T_body, now.odom_T_body))
        way_m += math.dist(before.odom_T_body[:3, 3], now.odom_T_body[:3, 3])
    if way_m > const.ODOMETRY_REACH_M:
        return None
    return relative(relative(*steps[1]), found.match_T_query @ relative(*steps[0]))
