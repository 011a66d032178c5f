"""Fine alignment of the scans of two keyframes, and what the geometry says about the result."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import small_gicp
from numpy.typing import NDArray

from umf_ros.frames import Keyframe, Points
from umf_ros.geometry import Array, invert, make_pose, transform
from umf_ros.levelling import upright
from umf_ros.verification import constants as const
from umf_ros.verification.elevation_map import ElevationMap
from umf_ros.verification.field_of_view import FieldOfView
from umf_ros.verification.free_space import RangeImage
from umf_ros.verification.surroundings import Surroundings


class PreparedScan:
    """A keyframe's scan made ready for comparison, each part when it is first asked for."""

    def __init__(self, points: Points, body_T_lidar: Array | None = None, blur_m: float = 0.0) -> None:
        """Prepare nothing yet.

        Args:
            points: (M, 3) m, body frame, thinned.
            body_T_lidar: where they were seen from; without it the origin.
            blur_m: how far points may be off because the LiDAR moved during the scan, standard deviation.
        """
        self.blur_m = blur_m
        self._lidar_T_body = np.eye(4) if body_T_lidar is None else invert(body_T_lidar)
        self.points: Array = points.astype(float)
        self._around: dict[float, Surroundings] = {}

    @property
    def usable(self) -> bool:
        """Whether there is anything to align."""
        return len(self.points) >= const.MIN_SCAN_POINTS

    @cached_property
    def bare(self) -> bool:
        """Whether it shows bare, even ground alone, which could lie anywhere on such ground."""
        return float(self.elevation.values.std()) < const.BARE_RELIEF_M if len(self.elevation.values) else False

    @cached_property
    def elevation(self) -> ElevationMap:
        """Heights and relief, upright."""
        return ElevationMap(self.upright_points)

    @cached_property
    def up(self) -> Array:
        """Rotation (3, 3) that sets the scan upright."""
        return upright(self.normals[self.picks])

    @cached_property
    def upright_points(self) -> Array:
        """(M, 3) m."""
        turned: Array = self.points @ self.up.T
        return turned

    @cached_property
    def view(self) -> FieldOfView:
        """The directions it looks into, upright."""
        return FieldOfView(self.upright_points)

    @cached_property
    def reach_m(self) -> float:
        """Median distance of the points, m."""
        return float(np.median(np.linalg.norm(self.points, axis=1)))

    def around(self, cell_m: float) -> Surroundings:
        """Map of what stands around it, in cells of this size, m."""
        if cell_m not in self._around:
            self._around[cell_m] = Surroundings(self.upright_points, cell_m)
        return self._around[cell_m]

    @cached_property
    def scouts(self) -> Array:
        """(S, 3) a few points, evenly taken, m."""
        return self.points[self._picks(const.SCOUTS)]

    @cached_property
    def scouts_cloud(self) -> small_gicp.PointCloud:
        """The few with covariances of their own."""
        return _cloud_of(self.scouts)

    def _picks(self, count: int) -> NDArray[np.intp]:
        return np.linspace(0, len(self.points) - 1, min(count, len(self.points))).astype(np.intp)

    @cached_property
    def cloud(self) -> small_gicp.PointCloud:
        """Points, normals and covariances."""
        return _cloud_of(self.points, self.tree)

    @cached_property
    def range_image(self) -> RangeImage:
        """How far the LiDAR saw."""
        return RangeImage(transform(self._lidar_T_body, self.points))

    def look_at(self, points: Array) -> NDArray[np.int8]:
        """(N,) what the rays of this scan say of points (N, 3) of its body frame, each a `Sight`."""
        return self.range_image.look_at(transform(self._lidar_T_body, points))

    @cached_property
    def picks(self) -> NDArray[np.intp]:
        """(S,) indices of at most 1500 points, evenly taken."""
        return self._picks(const.SAMPLE)

    @cached_property
    def sample(self) -> Array:
        """(S, 3) at most 1500 points, evenly taken."""
        return self.points[self.picks]

    @cached_property
    def spacing(self) -> Array:
        """(S,) m: how far the points of the sample are from the fifth of their neighbours."""
        _, squared = self.tree.batch_knn_search(self.sample, const.SPACING_NEIGHBOURS, 1)
        return np.sqrt(np.asarray(squared)[:, -1])

    @cached_property
    def sample_cloud(self) -> small_gicp.PointCloud:
        """The sample with covariances of its own."""
        return _cloud_of(self.sample)

    @cached_property
    def coarse_cloud(self) -> small_gicp.PointCloud:
        """A third of the sample, likewise: enough for where there is far to go."""
        return _cloud_of(self.sample[:: const.COARSE_EVERY])

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
        index, _ = self.tree.batch_knn_search(self.sample, const.NOISE_NEIGHBOURS, 1)
        neighbours = np.asarray(index, np.intp)
        offsets = self.points[neighbours[:, 1:]] - self.sample[:, None]
        away = np.abs(np.einsum("nki,ni->nk", offsets, self.normals[neighbours[:, 0]]))
        return 1.4826 * float(np.median(away))

    def nearest(self, points: Array) -> tuple[NDArray[np.intp], Array]:
        """Index (N,) of the nearest point to each of (N, 3), and its squared distance, m^2."""
        index, squared = self.tree.batch_nearest_neighbor_search(points, num_threads=1)
        return np.asarray(index, np.intp), np.asarray(squared)


def _cloud_of(points: Array, tree: small_gicp.KdTree | None = None) -> small_gicp.PointCloud:
    """Points (N, 3) with normals and covariances of their own."""
    cloud = small_gicp.PointCloud(points)
    small_gicp.estimate_normals_covariances(cloud, tree, const.NORMAL_NEIGHBOURS, 1)
    return cloud


def levelled(match: PreparedScan, query: PreparedScan, pose: Array) -> Array:
    """The pose `match_T_query` (4, 4) between the upright frames of two scans."""
    to_match, from_query = make_pose(match.up, np.zeros(3)), make_pose(query.up.T, np.zeros(3))
    found: Array = to_match @ pose @ from_query
    return found


def unlevelled(match: PreparedScan, query: PreparedScan, pose: Array) -> Array:
    """The pose `match_T_query` (4, 4) that is this one between the upright frames of two scans."""
    from_match, to_query = make_pose(match.up.T, np.zeros(3)), make_pose(query.up, np.zeros(3))
    found: Array = from_match @ pose @ to_query
    return found


def prepare(keyframe: Keyframe) -> PreparedScan:
    """The scan of a keyframe; one whose motion was not removed is blurred."""
    return PreparedScan(keyframe.points, keyframe.body_T_lidar, const.BLUR_M if keyframe.motion is None else 0.0)


def views_tell(match: PreparedScan, query: PreparedScan) -> bool:
    """Whether images have to tell the pose, where there are any: a scan is wanting, or both show bare ground alone."""
    return not (match.usable and query.usable) or (match.bare and query.bare)


def joint_blur(match: PreparedScan, query: PreparedScan) -> float:
    """How far points of two scans may be off together because a LiDAR moved, m."""
    return max(match.blur_m, query.blur_m)


class ScanCache:
    """The most recently used scans; a cache, so it changes no result."""

    def __init__(self) -> None:
        self._scans: OrderedDict[tuple[int, int], PreparedScan] = OrderedDict()

    def __getitem__(self, keyframe: Keyframe) -> PreparedScan:
        key = (keyframe.session, keyframe.stamp_ns)
        scan = self._scans.pop(key, None) or prepare(keyframe)
        self._scans[key] = scan
        if len(self._scans) > const.SCANS_KEPT:
            self._scans.popitem(last=False)
        return scan

    def clear(self) -> None:
        """Forget all scans, as when stamps start over."""
        self._scans.clear()


@dataclass(frozen=True, slots=True)
class CovarianceModel:
    """What residuals do not say about the error of a pose; fitted.

    Attributes:
        inflation: factor on the variance, for neighbouring residuals are not independent.
        floor_m: standard deviation of every translation, m, from calibration.
        floor_deg: of every rotation, deg.
        disorder: logarithm of one more factor on the variance where nothing overlaps, in proportion to the share of
            the points that have no counterpart: what grows, sways or hides each other misleads the others too.
        motion: factor on the standard deviation of what the odometry within a scan is measured to add.
        unknown_motion_m: like `floor_m`, added where the motion inside a scan was not removed.
        unknown_motion_deg: like `floor_deg`, likewise.
    """

    inflation: float
    floor_m: float
    floor_deg: float
    disorder: float = 0.0
    motion: float = 1.0
    unknown_motion_m: float = 0.0
    unknown_motion_deg: float = 0.0

    @property
    def floor(self) -> Array:
        """The floor as a covariance (6, 6), m^2 and rad^2."""
        return _diagonal(self.floor_m, self.floor_deg)

    @property
    def unknown_motion(self) -> Array:
        """What motion that was not removed adds to the covariance, (6, 6), m^2 and rad^2."""
        return _diagonal(self.unknown_motion_m, self.unknown_motion_deg)


def _diagonal(metres: float, degrees: float) -> Array:
    return np.diag([metres**2] * 3 + [np.radians(degrees) ** 2] * 3)


# information (6, 6) of the search itself: nothing is less known than that
SEARCHED = np.diag([const.SEARCH_M**-2] * 3 + [const.SEARCH_RAD**-2] * 3)
NOMINAL = CovarianceModel(const.NOMINAL_INFLATION, const.NOMINAL_FLOOR_M, const.NOMINAL_FLOOR_DEG)
"""A fixed yardstick of what a pose is known to: refitting the covariance must not move the decision."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """How the scan of a query lies on that of a match.

    Attributes:
        pose: (4, 4) `match_T_query`.
        residuals: (N,) m: point-to-plane distances of the query points that have a counterpart.
        jacobian: (N, 6) of the residuals by (x y z rx ry rz) about the match axes at the query's origin.
        overlap: share of the query points seen by both that have a counterpart.
        points: (P, 3) m: the query points that have one, in the match's body frame.
        pairs: (N, 2) index of the query's and of the match's point behind each residual; one row per residual.
    """

    pose: Array
    residuals: Array
    jacobian: Array
    overlap: float
    points: Array
    pairs: NDArray[np.intp] = field(default_factory=lambda: np.empty((0, 2), np.intp))

    @property
    def weights(self) -> Array:
        """Information (N,) of each residual as if they were independent, 1/m^2, with outliers weighed down."""
        if not len(self.residuals):
            return np.empty(0)
        noise = max(1.4826 * float(np.median(np.abs(self.residuals))), const.MIN_RESIDUAL_NOISE_M)
        found: Array = 1.0 / (1.0 + (self.residuals / (2 * noise)) ** 2) / noise**2
        return found

    @property
    def information(self) -> Array:
        """Information (6, 6) of the residuals."""
        found: Array = (self.jacobian * self.weights[:, None]).T @ self.jacobian
        return found


def align_scans(match: PreparedScan, query: PreparedScan, guess: Array) -> Alignment:
    """Generalised ICP (Segal, RSS 2009) from the pose `guess`, first far-sighted, then near-sighted."""
    pose = draw(match, query.coarse_cloud, guess, const.COARSE_REACH_M, const.COARSE_STEPS)
    pose = draw(match, query.sample_cloud, pose, const.FINE_REACH_M, const.FINE_STEPS)
    return inspect(match, query, pose)


def draw(match: PreparedScan, query: small_gicp.PointCloud, guess: Array, reach_m: float, steps: int) -> Array:
    """`match_T_query` after some steps of generalised ICP from a guess; counterparts are nearer than `reach_m`."""
    result = small_gicp.align(
        match.cloud,
        query,
        match.tree,
        guess,
        registration_type="GICP",
        max_correspondence_distance=reach_m,
        num_threads=1,
        max_iterations=steps,
    )
    return np.asarray(result.T_target_source)


def inspect(match: PreparedScan, query: PreparedScan, pose: Array) -> Alignment:
    """Residuals, their Jacobian and the overlap of two scans at a pose."""
    moved = transform(pose, query.sample)
    index, squared = match.nearest(moved)
    normals = match.normals[index]
    offset = moved - match.points[index]
    residual = np.einsum("ij,ij->i", offset, normals)
    solid = np.einsum("ij,ij->i", normals, normals) > 0.5
    close = solid & (squared < const.FINE_REACH_M**2)
    seen = solid & (squared < const.COARSE_REACH_M**2)
    arm = np.cross(moved[close] - pose[:3, 3], normals[close])
    overlap = float(close.sum()) / max(int(seen.sum()), 1)
    pairs = np.column_stack([query.picks, index])[close]
    return Alignment(pose, residual[close], np.hstack([normals[close], arm]), overlap, moved[close], pairs)


def covariance_of(found: Array, model: CovarianceModel, overlap: float | Array = 1.0) -> Array:
    """Covariance (..., 6, 6) of a pose in ROS order (x y z rx ry rz, match axes), m^2 and rad^2.

    The information gives the shape: a plane leaves two shifts and a turn as wide as the search.

    Args:
        found: information (..., 6, 6) of the residuals.
        model: what they do not say.
        overlap: (...) of the alignment.
    """
    inflation = np.asarray(model.inflation * np.exp(model.disorder * (1.0 - np.asarray(overlap, float))))
    covariance = np.linalg.inv(SEARCHED + found / inflation[..., None, None]) + model.floor
    return (covariance + covariance.swapaxes(-1, -2)) / 2


def nominal_deviations(found: Array) -> tuple[float, float]:
    """Nominal standard deviations of the position along its least known direction, m, and of the heading, deg.

    Args:
        found: information (6, 6) of the residuals.
    """
    nominal = covariance_of(found, NOMINAL)
    return float(np.sqrt(np.linalg.eigvalsh(nominal[:3, :3])[-1])), float(np.degrees(np.sqrt(nominal[5, 5])))
