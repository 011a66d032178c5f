"""Bird's-eye maps of everything around a scan that was set upright, for the search over all headings.

Two quantities stand in every cell. *Relief*, the height above a plane fitted to the neighbourhood, tells terrain from
terrain. *Height of structure*, in how many layers a cell has points, tells walls, trunks and boxes from the floor they
stand on, also where a ceiling hides every height. The cells are as large as the place asks for: a room is some
metres wide, a field some ten.
"""

from __future__ import annotations

import math
from functools import cached_property

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from umf_ros.core.geometry import Array
from umf_ros.verification import constants as const
from umf_ros.verification.relief import Grid, relief_of

Spectra = NDArray[np.complex64]
SIDE = const.AROUND_CELLS


class Surroundings:
    """What stands around one scan.

    Attributes:
        cell_m: side of a cell, m.
        rows, columns: (C,) of the cells with points.
        centres: (C, 2) of these cells, m.
        lowest: (SIDE, SIDE) height of the lowest point of every cell, m; NaN without points.
        structured: whether enough of it stands up from the ground to tell one place from another.
        values: (2, C) relief and structure, each of mean 0 and, all cells together, of length 1.
    """

    def __init__(self, points: Array, cell_m: float) -> None:
        """Args: points (M, 3) m, upright, about the sensor; side of a cell, m."""
        self.cell_m = cell_m
        points = points[np.hypot(points[:, 0], points[:, 1]) < const.AROUND_RADIUS * cell_m]
        row, column = (np.floor(points[:, :2] / cell_m).astype(int) + SIDE // 2).T
        cell = row * SIDE + column
        count = np.bincount(cell, minlength=SIDE * SIDE)
        occupied = np.flatnonzero(count)
        self.rows, self.columns = occupied // SIDE, occupied % SIDE
        self.centres: Array = (np.column_stack([self.rows, self.columns]) - SIDE // 2 + 0.5) * cell_m
        bottom = np.full(SIDE * SIDE, np.inf)
        np.minimum.at(bottom, cell, points[:, 2])
        self.lowest: Array = np.where(count > 0, bottom, np.nan).reshape(SIDE, SIDE)
        mean = np.bincount(cell, points[:, 2], SIDE * SIDE) / np.maximum(count, 1)
        relief = relief_of(mean.reshape(SIDE, SIDE), np.isfinite(self.lowest), cell_m)[self.rows, self.columns]
        layers = _layers(cell, points[:, 2] - bottom[cell])[occupied]
        self.structured = bool((layers >= const.TALL_LAYERS).sum() >= const.MIN_TALL)
        structure = np.sqrt(layers)
        self.values = np.stack(
            [_unit(np.nan_to_num(relief)), _unit(structure - structure.sum() / max(len(structure), 1))]
        )

    @cached_property
    def maps(self) -> Grid:
        """Relief and structure (SIDE, SIDE, 2), 0 where there are no points."""
        maps = np.zeros((SIDE, SIDE, 2), np.float32)
        maps[self.rows, self.columns] = self.values.T
        return maps

    @cached_property
    def spectra(self) -> Spectra:
        """Spectra (2, ...) of relief and structure."""
        spectra: Spectra = scipy.fft.rfft2(self.maps.transpose(2, 0, 1))
        return spectra

    def turned(self, heading: float) -> Grid:
        """The maps (SIDE, SIDE, 2) turned about the sensor by a heading, rad."""
        cos, sin, middle = math.cos(heading), math.sin(heading), (SIDE - 1) / 2
        back = np.array([[cos, -sin, 0], [sin, cos, 0]])
        back[:, 2] = middle - back[:, :2].sum(axis=1) * middle
        turned = cv2.warpAffine(self.maps, back, (SIDE, SIDE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        return np.asarray(turned, np.float32)


def _layers(cell: NDArray[np.intp], rise: Array) -> Array:
    """In how many layers above its lowest point every cell (SIDE^2,) has points; 1 on any ground but a steep one."""
    layer = np.floor(rise / const.LAYER_M).astype(int)
    occupied = np.zeros((SIDE * SIDE, layer.max(initial=0) + 1), bool)
    occupied[cell, layer] = True
    return occupied.sum(axis=1).astype(float)


def _centred(values: Array) -> Array:
    return values - values.mean() if len(values) else values


def _unit(values: Array) -> Grid:
    return (values / max(float(np.linalg.norm(values)), 1e-9)).astype(np.float32)
