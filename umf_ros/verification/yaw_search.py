"""Where one scan could lie on another, whatever the heading: an exhaustive search over heading and position.

The query's surroundings are turned to every heading that lets the two see the same things and are correlated with
the match's over all shifts at once (FFT). Relief alone is asked, and relief with structure: in the open the one is
right, among walls the other. Every peak is settled in height and tilt, drawn to the match by some steps of ICP on
a few points, and ranked by how many of these then have a counterpart. It needs no training and does not
know about the sun.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, make_pose, transform
from umf_ros.core.geometry import heading as heading_of
from umf_ros.verification import constants as const
from umf_ros.verification.elevation_map import evaluate
from umf_ros.verification.prepared_scan import PreparedScan, levelled, unlevelled
from umf_ros.verification.scan_alignment import run_gicp
from umf_ros.verification.surroundings import SIDE, Spectra, Surroundings


@dataclass(frozen=True, slots=True)
class Fit:
    """One way two scans could lie on each other.

    Attributes:
        pose: (4, 4) `match_T_query`.
        share: of some of the query's points, how many have a counterpart.
        terrain: how well the elevation maps fit there, in standard deviations of chance.
        structured: whether enough stands around both to be compared, where terrain says nothing.
    """

    pose: Array
    share: float
    terrain: float
    structured: bool

    @property
    def score(self) -> float:
        """Rank of the fit: counterparts, and terrain where they say little."""
        return self.share + const.TERRAIN_WEIGHT * self.terrain

    @property
    def telling(self) -> bool:
        """Whether there is anything that could have spoken against it; two bare planes fit anywhere."""
        return self.structured or self.terrain >= const.MIN_MAP_SCORE


class RotatedElevationMap:
    """A query's surroundings at every heading, each made when it is first asked for."""

    def __init__(self, scan: PreparedScan) -> None:
        self.scan = scan
        self.cell_m = scan.cell_m
        self.around = scan.around(self.cell_m)
        self._ready = np.zeros(len(const.ALL_HEADINGS), bool)
        self._spectra: Spectra = np.zeros((len(const.ALL_HEADINGS), 2, SIDE, SIDE // 2 + 1), np.complex64)

    def spectra(self, wanted: NDArray[np.intp]) -> Spectra:
        """Spectra (H, 2, ...), conjugated, at the headings (H,) by index."""
        fresh = wanted[~self._ready[wanted]]
        self._ready[fresh] = True
        if len(fresh):
            maps = np.stack([self.around.turned(heading) for heading in const.ALL_HEADINGS[fresh]])
            self._spectra[fresh] = scipy.fft.rfft2(maps.transpose(0, 3, 1, 2)).conj()
        return self._spectra[wanted]


def search(match: PreparedScan, turned: RotatedElevationMap) -> list[Fit]:
    """The best fits, best first, each from a peak of its own."""
    overlap = match.view.overlap(turned.scan.view, const.ALL_HEADINGS)
    wanted = np.flatnonzero(overlap >= const.SEARCHED_OVERLAP)
    around = match.around(turned.cell_m)
    if not len(wanted) or min(len(around.rows), len(turned.around.rows)) < const.MIN_CELLS:
        return []
    fits = []
    for index, row, column in _peaks(_correlate(around, turned.spectra(wanted)), wanted, const.PEAKS):
        shift = (np.array([row, column]) - const.AROUND_SHIFT) * turned.cell_m
        guess = fit_ground(match, turned.scan, turned.cell_m, float(const.ALL_HEADINGS[index]), shift)
        fits.append(coarse_align(match, turned.scan, guess))
    return sorted((fit for fit in fits if fit.telling), key=lambda fit: -fit.score)


def coarse_align(match: PreparedScan, query: PreparedScan, guess: Array) -> Fit:
    """Draw a pose to the match by a few points, and see how many of them find a counterpart."""
    cell_m = query.cell_m
    pose = run_gicp(match, query.scouts_cloud, guess, const.SCOUT_REACH * cell_m, const.SCOUT_STEPS)
    squared = match.nearest(transform(pose, query.scouts))[1]
    near = squared < (const.SCOUT_NEAR * cell_m) ** 2
    terrain = evaluate(match.elevation, query.elevation, levelled(match, query, pose)).score
    structured = all(scan.around(cell_m).structured for scan in (match, query))
    return Fit(pose, float(near.mean()), terrain, structured)


def alternatives(match: PreparedScan, query: PreparedScan, pose: Array) -> list[Array]:
    """Where else the query could lie at the heading of a pose, drawn to the match: the peaks but that of the pose."""
    cell_m, level = query.cell_m, levelled(match, query, pose)
    theirs, ours, turn = match.around(cell_m), query.around(cell_m), float(heading_of(level))
    spectra: Spectra = scipy.fft.rfft2(ours.turned(turn).transpose(2, 0, 1)).conj()
    volumes = _correlate(theirs, spectra[None])
    row, column = np.round(level[:2, 3] / cell_m).astype(int) + const.AROUND_SHIFT
    volumes[:, :, max(row - 1, 0) : max(row + 2, 0), max(column - 1, 0) : max(column + 2, 0)] = -np.inf
    found = []
    for _, row, column in _peaks(volumes, np.zeros(1, np.intp), const.ALTERNATIVES):
        shift = (np.array([row, column]) - const.AROUND_SHIFT) * cell_m
        guess = fit_ground(match, query, cell_m, turn, shift)
        found.append(run_gicp(match, query.scouts_cloud, guess, const.SCOUT_REACH * cell_m, const.SCOUT_STEPS))
    return found


def _correlate(around: Surroundings, turned: Spectra) -> NDArray[np.float32]:
    """Correlation (2, H, shifts, shifts) of the relief, and of relief and structure together."""
    products = around.spectra * turned
    products[:, 1] += products[:, 0]
    window = np.arange(-const.AROUND_SHIFT, const.AROUND_SHIFT + 1)
    rows = scipy.fft.ifft(products, axis=-2)[..., window, :]
    found: NDArray[np.float32] = scipy.fft.irfft(rows, SIDE, axis=-1)[..., window].swapaxes(0, 1)
    return found


def _peaks(
    volumes: NDArray[np.float32], headings: NDArray[np.intp], counts: tuple[int, ...]
) -> list[tuple[int, int, int]]:
    """Heading, row and column of the highest peaks, so many of each volume, no two of them neighbours."""
    peaks: list[tuple[int, int, int]] = []
    every = np.full((len(const.ALL_HEADINGS), *volumes.shape[2:]), -np.inf, np.float32)
    taken = np.zeros(every.shape, bool)
    for volume, count in zip(volumes, counts, strict=True):
        every[headings] = volume
        for _ in range(count):
            every[taken] = -np.inf
            heading, row, column = (int(i) for i in np.unravel_index(int(every.argmax()), every.shape))
            if not every[heading, row, column] > 0:
                break
            peaks.append((heading, row, column))
            beside = np.arange(heading - 1, heading + 2) % len(every)
            taken[beside, max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = True
    return peaks


def fit_ground(match: PreparedScan, query: PreparedScan, cell_m: float, heading: float, shift: Array) -> Array:
    """`match_T_query` of a planar fit, rad and (2,) m between the upright frames, with the height and tilt it needs."""
    return unlevelled(match, query, planar_to_pose(match.around(cell_m), query.around(cell_m), heading, shift))


def planar_to_pose(match: Surroundings, query: Surroundings, heading: float, shift: Array) -> Array:
    """Full pose of a planar fit: height and tilt from the height differences of the shared cells."""
    cos, sin = math.cos(heading), math.sin(heading)
    planar = make_pose(np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]), [*shift, 0.0])
    moved = query.centres @ planar[:2, :2].T + shift
    row, column = (np.floor(moved / match.cell_m).astype(np.intp) + SIDE // 2).T.clip(0, SIDE - 1)
    offset = match.lowest[row, column] - query.lowest[query.rows, query.columns]
    known = np.isfinite(offset)
    place, offset = moved[known], offset[known]
    if len(offset) < 3:
        return planar
    design = np.column_stack([np.ones(len(place)), place])
    away = np.abs(offset - _middle(offset))
    keep = away <= _middle(away) * 3 + const.SETTLE_M
    for _ in range(3):
        kept = design[keep]
        plane = np.linalg.solve(kept.T @ kept + 1e-3 * np.eye(3), kept.T @ offset[keep])
        residual = np.abs(offset - design @ plane)
        keep = residual <= max(const.SETTLE_MEDIANS * _middle(residual), const.SETTLE_M)
    lift, slope_x, slope_y = plane
    tilt = Rotation.from_rotvec(np.clip([slope_y, -slope_x, 0.0], -const.MAX_SLOPE, const.MAX_SLOPE)).as_matrix()
    return make_pose(tilt, [0, 0, lift]) @ planar


def _middle(values: Array) -> float:
    """The median, of an even number the upper one: numpy's own takes most of the time of a small fit."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])
