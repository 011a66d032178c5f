"""Compiled functions of points; sources in `kernels/`.

Arrays are C-contiguous. Every function checks shapes, releases Python's lock and keeps no state.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Floats = NDArray[np.float32]

class KdTree:
    """Nearest neighbours among points (N, 3), m, kept in single precision."""

    def __init__(self, points: Array) -> None: ...
    def __len__(self) -> int: ...
    def nearest(self, queries: Array, within_m: float = np.inf) -> tuple[NDArray[np.int64], Array]:
        """Return the index (M,) of the point nearest to each of (M, 3), and its squared distance, m^2.

        Where none is nearer than `within_m`, they are 0 and infinity; a short distance saves most of the search.
        """

    def neighbours(self, queries: Array, count: int) -> tuple[NDArray[np.int64], Array]:
        """Return indices (M, K) of the K nearest points, the nearest first, and squared distances.

        Of fewer points the last stands for the others, at an infinite distance.
        """

    def normals(self, places: Array, neighbours: int, width: float = 0.0) -> Array:
        """Return unit normals (M, 3) at places (M, 3) towards the origin; zero where fewer than five are neighbours.

        Likewise where these lie on a line: with less than `width` of the standard deviation along it across.
        """

    def planes(self, neighbours: int) -> tuple[Array, Array, Array, Array]:
        """Return the planes through the neighbourhoods of the points.

        Their centres (N, 3), unit normals (N, 3), radii (N,), and standard deviations (N, 3) along the axes, the
        smallest first; m.
        """

class RangeImage:
    """How far a scan (N, 3), thinned to cubes of `thin_m`, sees in every direction from its sensor at the origin."""

    def __init__(
        self,
        points: Array,
        cell_deg: float,
        margin_m: float,
        margin: float,
        from_m: float,
        thin_m: float,
        known: float,
    ) -> None: ...

class FreeSpace:
    """Rays of merged scans: their range images and poses `lidar_T_body` (K, 4, 4)."""

    def __init__(self, images: Sequence[RangeImage], lidars_T_body: Array) -> None: ...
    def look_at(self, points: Array) -> NDArray[np.int8]:
        """Return 0 for each of points (N, 3) that lies where rays end, 1 where rays passed it by, 2 where hidden."""

    def point_misfits(self, tree: KdTree, points: Array, reach_m: Array, poses: Array, most: float) -> Floats:
        """Return distances (K, N) to the nearest of a tree in units of `reach_m` (N,), at most `most`.

        Of points (N, 3) at poses (K, 4, 4); NaN where hidden.
        """

    def plane_misfits(
        self,
        tree: KdTree,
        centres: Array,
        normals: Array,
        reach_m: Array,
        planar: NDArray[np.bool_],
        points: Array,
        poses: Array,
        sigma_m: float,
        furthest_m: float,
    ) -> Floats:
        """Return misfits (K, N) of points (N, 3) at poses (K, 4, 4) with the planes at the points of a tree.

        0 on a plane to 1 off it or in space seen empty, by deviations of `sigma_m`; NaN where there is no plane.
        """

def align(
    tree: KdTree,
    normals: Array,
    points: Array,
    own_normals: Array,
    guess: Array,
    reach_m: float,
    steps: int,
    least_m: float,
    least_rad: float,
) -> Array:
    """Return the pose (4, 4) of points (N, 3) on a tree after some steps of generalised ICP (Segal et al., RSS 2009).

    Counterparts are nearer than `reach_m`. It ends where a step is below `least_m` and `least_rad`.
    """

def cell_means(points: Floats, values: Floats, cell_m: float, range_m: float) -> Floats:
    """Return means (M, C) of values (N, C) over points (N, 3) nearer than `range_m` in every occupied cube, sorted."""

def deskew(points: Floats, times: Array, moments: Array, motions: Array) -> Floats:
    """Return points (N, 3), each turned and moved by the motion at its time (N,).

    Motions (K, 6), rotation vectors and shifts, are interpolated between their rising moments (K,), and held outside.
    """
