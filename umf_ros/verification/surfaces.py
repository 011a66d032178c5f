"""Planes that the points of a scan determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import small_gicp
from numpy.typing import NDArray

from umf_ros.core.geometry import Array
from umf_ros.verification import constants as const


@dataclass(frozen=True)
class Surfaces:
    """Planes through the neighbourhoods of points.

    Attributes:
        points: (M, 3) m.
        tree: their nearest neighbours.
        normals: (M, 3) unit vectors.
        centres: (M, 3) m, of the neighbourhoods.
        reach_m: (M,) radius of the neighbourhood.
        planar: (M,) whether the neighbours determine a plane; those on a single ring do not.
    """

    points: Array
    tree: small_gicp.KdTree
    normals: Array
    centres: Array
    reach_m: Array
    planar: NDArray[np.bool_]

    @staticmethod
    def of(points: Array) -> Surfaces:
        """Fit a plane at each of (M, 3) points."""
        tree = small_gicp.KdTree(points)
        index, squared = tree.batch_knn_search(points, const.PLANE_NEIGHBOURS, 1)
        neighbours = points[np.asarray(index, np.intp)]
        centres = neighbours.mean(axis=1)
        offsets = neighbours - centres[:, None]
        variances, axes = np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets / neighbours.shape[1])
        thickness, width, length = np.sqrt(np.maximum(variances, 0.0)).T
        reach = np.sqrt(np.asarray(squared)[:, -1])
        even = (thickness < const.PLANE_THICKNESS_M) & (4 * thickness < width)
        wide = (width > const.PLANE_WIDTH_M) & (width > const.PLANE_ROUNDNESS * length)
        planar = even & wide & (reach < const.PLANE_REACH_M)
        return Surfaces(points, tree, axes[:, :, 0], centres, reach, planar)

    def nearest(self, points: Array) -> tuple[NDArray[np.intp], Array]:
        """Index (N,) of the nearest point to each of (N, 3), and its squared distance, m^2."""
        index, squared = self.tree.batch_nearest_neighbor_search(points, num_threads=1)
        return np.asarray(index, np.intp), np.asarray(squared)
