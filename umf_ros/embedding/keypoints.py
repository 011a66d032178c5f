"""Which local features are worth keeping [UMF 4.4]: the salient ones, capped and spread."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Points


def select_salient(saliency: Points, group: NDArray[np.int64], threshold: float, limit: int) -> NDArray[np.int64]:
    """Choose features so that no region takes more than its share.

    The k-th best of every region comes before any region's (k+1)-th; ties go to the lower index.

    Args:
        saliency: (N,) attention received, 1 is the fair share.
        group: (N,) region of each feature.
        threshold: features below are dropped.
        limit: most features to keep.

    Returns:
        Indices of the chosen features, most salient first.
    """
    candidates = np.flatnonzero(saliency >= threshold)
    by_region = candidates[np.lexsort((candidates, -saliency[candidates], group[candidates]))]
    regions = group[by_region]
    starts = np.r_[True, regions[1:] != regions[:-1]] if len(regions) else np.empty(0, bool)
    start_of = np.maximum.accumulate(np.where(starts, np.arange(len(regions)), 0))
    rank = np.arange(len(regions)) - start_of
    fair = by_region[np.lexsort((by_region, -saliency[by_region], rank))[:limit]]
    return fair[np.lexsort((fair, -saliency[fair]))]


def cell_regions(rows: int, columns: int, side: int = 4) -> NDArray[np.int64]:
    """(rows * columns,) region of each cell of a map: squares of `side` cells."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    return row // side * (columns // side + 1) + column // side


def ground_regions(points: Points, side_m: float = 4.0) -> NDArray[np.int64]:
    """(N,) region of each point: squares of `side_m` on the ground."""
    cell = np.floor(points[:, :2] / side_m).astype(np.int64) + 1000
    return cell[:, 0] * 10000 + cell[:, 1]
