"""Fine alignment of two scans (generalised ICP) and what the geometry says about the result."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import small_gicp
from numpy.typing import NDArray

from umf_ros.frames import Points
from umf_ros.geometry import Array, transform

NORMAL_NEIGHBOURS = 10
SAMPLE = 1500  # points of the query that are aligned: a third of the scan is as good in half the time
COARSE_REACH_M = 1.0
FINE_REACH_M = 0.4
MIN_POINTS = 100


class Surface:
    """A scan made ready for registration: points with normals and a search tree."""

    def __init__(self, points: Points) -> None:
        """Args: points (M, 3) m, body frame, thinned."""
        self.points: Array = points.astype(float)

    @property
    def usable(self) -> bool:
        """Whether there is anything to align."""
        return len(self.points) >= MIN_POINTS

    @cached_property
    def cloud(self) -> small_gicp.PointCloud:
        """Points, normals and covariances."""
        cloud = small_gicp.PointCloud(self.points)
        small_gicp.estimate_normals_covariances(cloud, self.tree, NORMAL_NEIGHBOURS, 1)
        return cloud

    @cached_property
    def sample(self) -> Array:
        """(S, 3) at most 1500 points, evenly taken."""
        picks = np.linspace(0, len(self.points) - 1, min(SAMPLE, len(self.points))).astype(int)
        return self.points[picks]

    @cached_property
    def sample_cloud(self) -> small_gicp.PointCloud:
        """The sample with covariances of its own."""
        cloud = small_gicp.PointCloud(self.sample)
        small_gicp.estimate_normals_covariances(cloud, None, NORMAL_NEIGHBOURS, 1)
        return cloud

    @cached_property
    def tree(self) -> small_gicp.KdTree:
        """Nearest neighbours among the points."""
        return small_gicp.KdTree(self.points)

    @cached_property
    def normals(self) -> Array:
        """(M, 3) unit normals, zero where the neighbourhood is too small."""
        return np.asarray(self.cloud.normals())[:, :3]

    @cached_property
    def noise_m(self) -> float:
        """How far the points scatter about their neighbours' planes, m: sensor noise and roughness together."""
        index, _ = self.tree.batch_knn_search(self.sample, 5, 1)
        neighbours = np.asarray(index, np.intp)
        offsets = self.points[neighbours[:, 1:]] - self.sample[:, None]
        away = np.abs(np.einsum("nki,ni->nk", offsets, self.normals[neighbours[:, 0]]))
        return 1.4826 * float(np.median(away))

    def nearest(self, points: Array) -> tuple[NDArray[np.intp], Array]:
        """Index (N,) of the nearest point to each of (N, 3), and its squared distance, m^2."""
        index, squared = self.tree.batch_nearest_neighbor_search(points, num_threads=1)
        return np.asarray(index, np.intp), np.asarray(squared)


@dataclass(frozen=True, slots=True)
class Alignment:
    """How a query scan lies on a match scan.

    Attributes:
        pose: (4, 4) `match_T_query`.
        residuals: (N,) point-to-plane distances, m, of the query points that have a counterpart.
        jacobian: (N, 6) of the residuals by (x y z rx ry rz) about the match axes at the query's origin.
        overlap: share of the query points seen by both that have a counterpart.
    """

    pose: Array
    residuals: Array
    jacobian: Array
    overlap: float


def align(match: Surface, query: Surface, guess: Array) -> Array:
    """Generalised ICP (Segal, RSS 2009) from `guess`, first far-sighted, then near-sighted: `match_T_query`."""
    pose = guess
    for reach, steps in ((COARSE_REACH_M, 10), (FINE_REACH_M, 8)):
        result = small_gicp.align(
            match.cloud,
            query.sample_cloud,
            match.tree,
            pose,
            registration_type="GICP",
            max_correspondence_distance=reach,
            num_threads=1,
            max_iterations=steps,
        )
        pose = np.asarray(result.T_target_source)
    return pose


def inspect(match: Surface, query: Surface, pose: Array) -> Alignment:
    """Residuals, their Jacobian and the overlap of two scans at a pose."""
    moved = transform(pose, query.sample)
    index, squared = match.nearest(moved)
    normals = match.normals[index]
    offset = moved - match.points[index]
    residual = np.einsum("ij,ij->i", offset, normals)
    solid = np.einsum("ij,ij->i", normals, normals) > 0.5
    # a counterpart lies within reach along the surface: the spacing of far returns is wider than the noise
    close = solid & (squared < FINE_REACH_M**2)
    seen = solid & (squared < COARSE_REACH_M**2)
    arm = np.cross(moved[close] - pose[:3, 3], normals[close])
    overlap = float(close.sum()) / max(int(seen.sum()), 1)
    return Alignment(pose, residual[close], np.hstack([normals[close], arm]), overlap)
