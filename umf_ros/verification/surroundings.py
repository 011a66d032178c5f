"""Bird's-eye maps of everything around a scan that was set upright, for the search over all headings.

Two quantities stand in every cell. *Relief*, the height above a plane fitted to the neighbourhood, tells terrain from
terrain. *Height of structure*, in how many layers a cell has points, tells walls, trunks and boxes from the floor they
stand on, also where a ceiling hides every height. The cells are as large as the place asks for: a room is some
metres wide, a field some ten.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from umf_ros.geometry import Array
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
        values: (2, C) relief and structure, each of mean 0 and, all cells together, of length 1.
    """

    def __init__(self, points: Array, cell_m: float) -> None:
        """Args: points (M, 3) m, upright, about the sensor; side of a cell, m."""
        self.cell_m = cell_m
        points = points[np.hypot(points[:, 0], points[:, 1]) < const.AROUND_RADIUS * cell_m]
        row, column = (np.floor(points[:, :2] / cell_m).astype(int) + SIDE // 2).T
        keys, owner, count = np.unique(row * SIDE + column, return_inverse=True, return_counts=True)
        self.rows, self.columns = keys // SIDE, keys % SIDE
        self.centres: Array = (np.column_stack([self.rows, self.columns]) - SIDE // 2 + 0.5) * cell_m
        self.lowest: Grid = np.full((SIDE, SIDE), np.nan, np.float32)
        bottom = np.full(len(keys), np.inf)
        np.minimum.at(bottom, owner, points[:, 2])
        self.lowest[self.rows, self.columns] = bottom
        height = np.zeros((SIDE, SIDE), np.float32)
        height[self.rows, self.columns] = np.bincount(owner, points[:, 2], len(keys)) / np.maximum(count, 1)
        relief = relief_of(height, np.isfinite(self.lowest), cell_m)[self.rows, self.columns]
        structure = np.sqrt(_layers(owner, points[:, 2], len(keys)))
        self.values = np.stack([_unit(np.nan_to_num(relief)), _unit(structure - structure.mean())])

    @property
    def spectra(self) -> Spectra:
        """Spectra (2, ...) of relief and structure."""
        maps = np.zeros((2, SIDE, SIDE), np.float32)
        maps[:, self.rows, self.columns] = self.values
        spectra: Spectra = scipy.fft.rfft2(maps)
        return spectra


def _layers(owner: NDArray[np.intp], height: Array, cells: int) -> Array:
    """In how many layers every cell has points."""
    layer = np.floor(height / const.LAYER_M).astype(int)
    lowest, span = layer.min(initial=0), int(np.ptp(layer)) + 1 if len(layer) else 1
    occupied = np.unique(owner * span + layer - lowest)
    return np.bincount(occupied // span, minlength=cells).astype(float)


def _unit(values: Array) -> Grid:
    return (values / max(float(np.linalg.norm(values)), 1e-9)).astype(np.float32)
