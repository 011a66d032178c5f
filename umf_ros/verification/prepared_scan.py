"""A scan prepared for comparison: thinned, with normals, nearest neighbours and maps."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, Keyframe, Points, ScanMotion
from umf_ros.core.geometry import Array, evenly, invert, make_pose, median_range, transform
from umf_ros.core.levelling import upright
from umf_ros.scan import _kernels as kernels
from umf_ros.verification import constants as const
from umf_ros.verification.grid_map import GridMap
from umf_ros.verification.keypoints import Keypoints, find_keypoints
from umf_ros.verification.visibility import FieldOfView, free_space

Indices = NDArray[np.intp]


def thin_scan(points: Points | None) -> Points:
    """One mean point per occupied cube nearer than 40 m: (M, 3) float32, body frame.

    Cubes of 0.25 m; half of that where a scan would keep fewer points than are compared.
    """
    points = np.empty((0, 3), np.float32) if points is None else points
    return _cell_means(points, points)


def thin_frame(frame: Frame) -> tuple[Points, ScanMotion | None]:
    """The thinned scan of a frame, and the motion meanwhile with a mean moment for every thinned point."""
    if frame.points is None or frame.motion is None:
        return thin_scan(frame.points), None
    means = _cell_means(frame.points, np.column_stack([frame.points, frame.motion.moments_s]))
    return np.ascontiguousarray(means[:, :3]), replace(frame.motion, moments_s=means[:, 3])


def _cell_means(points: Points, values: Points) -> Points:
    """Means (M, C) float32 of values (N, C) over the points (N, 3) nearer than 40 m in every occupied cube."""
    points, values = (np.ascontiguousarray(rows, np.float32) for rows in (points, values))
    means = kernels.cell_means(points, values, const.THIN_CELL_M, const.MAX_RANGE_M)
    few = len(means) < const.SAMPLE
    return kernels.cell_means(points, values, const.THIN_CELL_M / 2, const.MAX_RANGE_M) if few else means


class OrientedPoints(NamedTuple):
    """Points (N, 3), m, with unit normals (N, 3) that their neighbours among themselves have; zero on a single ring."""

    points: Array
    normals: Array

    @classmethod
    def of(cls, points: Array) -> OrientedPoints:
        """Give points (N, 3) their normals."""
        points = np.ascontiguousarray(points)
        return cls(points, kernels.KdTree(points).normals(points, 2 * const.NEIGHBOURS, const.RING_WIDTH))


@dataclass(frozen=True)
class Surfaces:
    """Points with the planes through their neighbourhoods.

    Attributes:
        points: (M, 3) m.
        tree: their nearest neighbours.
        normals: (M, 3) unit vectors.
        centres: (M, 3) m, of the neighbourhoods.
        reach_m: (M,) radius of the neighbourhood.
        planar: (M,) whether the neighbours determine a plane; those on a single ring do not.
    """

    points: Array
    tree: kernels.KdTree
    normals: Array
    centres: Array
    reach_m: Array
    planar: NDArray[np.bool_]

    @classmethod
    def of(cls, points: Array) -> Surfaces:
        """Fit a plane at each of (M, 3) points."""
        points = points if len(points) else np.full((1, 3), 10 * const.MAX_RANGE_M)  # a tree needs a point
        tree = kernels.KdTree(np.ascontiguousarray(points))
        centres, normals, reach, spread = tree.planes(const.PLANE_NEIGHBOURS)
        thickness, width, length = spread.T
        even = (thickness < const.PLANE_SIGMA_M) & (4 * thickness < width)
        wide = (width > const.PLANE_WIDTH_M) & (width > const.PLANE_ROUNDNESS * length)
        return cls(points, tree, normals, centres, reach, even & wide & (reach < const.PLANE_REACH_M))


class PreparedScan:
    """A keyframe's scan made ready for comparison, each part when it is first asked for.

    Attributes:
        points: (M, 3) m, body frame.
        blur_m: how far points may be off because the LiDAR moved during the scan, standard deviation.
        owner: (M,) the merged scan of each point, 0 to K - 1.
        scans: of K merged scans, each by itself in the same body frame; empty for a single scan.
    """

    def __init__(
        self, points: Points, body_T_lidar: Array | None = None, blur_m: float = 0.0, owner: Indices | None = None
    ) -> None:
        """Prepare nothing yet.

        Args:
            points: (M, 3) m, body frame, thinned.
            body_T_lidar: where they were seen from, (4, 4), or (K, 4, 4) of merged scans; without it the origin.
            blur_m: how far points may be off because the LiDAR moved during the scan, standard deviation.
            owner: (M,) the merged scan of each point, 0 to K - 1.
        """
        self.points: Array = points.astype(float)
        self.blur_m = blur_m
        self._lidars_T_body = invert(np.eye(4)[None] if body_T_lidar is None else body_T_lidar.reshape(-1, 4, 4))
        self.owner = np.zeros(len(points), np.intp) if owner is None else owner
        self._maps: dict[float, GridMap] = {}
        self.scans: tuple[PreparedScan, ...] = ()

    @classmethod
    def of(cls, keyframe: Keyframe) -> PreparedScan:
        """The scan of a keyframe; one whose motion was not removed is blurred."""
        motion = keyframe.motion
        blur_m = const.BLUR_M if motion is None or not motion.removed else 0.0
        if motion is None or not len(motion.body_T_lidars):
            return cls(keyframe.points, keyframe.body_T_lidar, blur_m)
        submap = cls(keyframe.points, motion.body_T_lidars, blur_m, np.unique(motion.moments_s, return_inverse=True)[1])
        submap.scans = tuple(cls(*one, blur_m) for one in zip(motion.scans, motion.body_T_lidars, strict=True))
        return submap

    @property
    def merged(self) -> int:
        """Number of merged scans; 1 for a single scan."""
        return len(self._lidars_T_body)

    @cached_property
    def lidars(self) -> Array:
        """(K, 3) m: where the merged scans were taken."""
        return np.asarray(invert(self._lidars_T_body)[:, :3, 3])

    @cached_property
    def middles(self) -> Array:
        """(K, 3) m: the middle of what each merged scan shows; where they look all around, where they were taken."""
        return np.array([scan.points.mean(axis=0) for scan in self.scans]) if self.narrow else self.lidars

    @cached_property
    def narrow(self) -> bool:
        """Whether it was merged from scans that see little around the sensor."""
        if self.merged == 1:
            return False
        number = int(np.bincount(self.owner).argmax())
        own = transform(self._lidars_T_body[number], self.points[self.owner == number])
        return FieldOfView(own).width_deg < const.NARROW_DEG

    def make_ready(self) -> None:
        """Make at once what a query's scan is asked for in every comparison."""
        if self.usable:
            self.map(self.cell_m)
            for part in ("view", "terrain", "free_space", "spacing", "oriented_scouts", "oriented_sample"):
                getattr(self, part)

    @property
    def usable(self) -> bool:
        """Whether there is anything to align."""
        return len(self.points) >= const.MIN_SCAN_POINTS

    @cached_property
    def up(self) -> Array:
        """Rotation (3, 3) that sets the scan upright."""
        return upright(self.sample_normals)[0]

    @cached_property
    def upright_T_body(self) -> Array:
        """The same as a pose (4, 4)."""
        return make_pose(self.up, np.zeros(3))

    @cached_property
    def upright_points(self) -> Array:
        """(M, 3) m."""
        return np.asarray(self.points @ self.up.T)

    @cached_property
    def view(self) -> FieldOfView:
        """The directions it looks into, upright."""
        return FieldOfView(self.upright_points)

    @cached_property
    def reach_m(self) -> float:
        """Median range of its points, m."""
        return median_range(self.points)

    @cached_property
    def cell_m(self) -> float:
        """Side of a cell of the map, m, as the place asks for it."""
        steps = np.round(np.log2(self.reach_m / const.REACH_CELLS) * 2) / 2
        return float(np.clip(2.0**steps, *const.MAP_CELL_M))

    def map(self, cell_m: float) -> GridMap:
        """Map of what lies around it, in cells of this size, m."""
        if cell_m not in self._maps:
            self._maps[cell_m] = GridMap(self.upright_points, cell_m)
        return self._maps[cell_m]

    @cached_property
    def terrain(self) -> GridMap:
        """Map of the relief out to 26 m, in cells in which rocks and ripples are seen at any range."""
        return GridMap(self.upright_points, const.TERRAIN_CELL_M, 2 * const.MAP_RADIUS)

    @cached_property
    def keypoints(self) -> Keypoints:
        """Keypoints of this relief."""
        return find_keypoints(self.terrain.relief)

    @cached_property
    def free_space(self) -> kernels.FreeSpace:
        """Free space of this scan, in its body frame."""
        poses = self._lidars_T_body
        return free_space([transform(pose, self.points[self.owner == i]) for i, pose in enumerate(poses)], poses)

    @cached_property
    def tree(self) -> kernels.KdTree:
        """Nearest neighbours among the points."""
        return kernels.KdTree(self.points)

    @cached_property
    def normals(self) -> Array:
        """(M, 3) unit normals for the alignment, zero where the neighbours are too few or on a single ring."""
        return self.tree.normals(self.points, 2 * const.NEIGHBOURS, const.RING_WIDTH)

    @cached_property
    def picks(self) -> Indices:
        """(S,) indices of at most 1500 points, evenly taken."""
        return evenly(len(self.points), const.SAMPLE)

    @cached_property
    def sample(self) -> Array:
        """(S, 3) these points, m."""
        return self.points[self.picks]

    @cached_property
    def oriented_sample(self) -> OrientedPoints:
        """The sample with normals of its own."""
        return OrientedPoints.of(self.sample)

    @cached_property
    def sample_normals(self) -> Array:
        """(S, 3) unit normals of the sample, those on a single ring too."""
        return self.tree.normals(self.sample, 2 * const.NEIGHBOURS)

    @cached_property
    def oriented_scouts(self) -> OrientedPoints:
        """Every fifth of the sample, enough for the far-sighted steps."""
        return OrientedPoints.of(self.sample[:: const.SCOUT_EVERY])

    @cached_property
    def spacing(self) -> Array:
        """(S,) m: how far the points of the sample are from the fifth of their neighbours."""
        return np.sqrt(self.tree.neighbours(self.sample, const.NEIGHBOURS + 1)[1][:, -1])

    @cached_property
    def noise_m(self) -> float:
        """How far the points scatter about their neighbours' planes, m: sensor noise and roughness together."""
        neighbours, _ = self.tree.neighbours(self.sample, const.NEIGHBOURS)
        offsets = self.points[neighbours[:, 1:]] - self.sample[:, None]
        return 1.4826 * float(np.median(np.abs(np.einsum("nki,ni->nk", offsets, self.sample_normals))))

    @cached_property
    def surfaces(self) -> tuple[Surfaces, Surfaces]:
        """Planes through the points of every second band of elevations, and through those between."""
        elevation = np.degrees(np.arcsin(self.rays[:, 2]))
        odd = (np.floor(elevation / const.SIGHT_DEG) % 2).astype(bool)
        return Surfaces.of(self.points[~odd]), Surfaces.of(self.points[odd])

    @cached_property
    def rays(self) -> Array:
        """(M, 3) unit vectors to its points, in the frame of the LiDAR that saw each."""
        poses = self._lidars_T_body[self.owner]
        seen = np.einsum("nij,nj->ni", poses[:, :3, :3], self.points) + poses[:, :3, 3]
        return np.asarray(seen / np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-9))

    @cached_property
    def passage(self) -> Array | None:
        """(3,) the direction of the passage that it was taken in; None where it shows none.

        A place is a passage where surfaces across it outweigh those along it.
        """
        sums, _ = self._least_across(self.sample_normals)
        if sums[0] > const.PASSAGE_RATIO * sums[1]:  # most places are none: their planes are never asked for
            return None
        flat = np.concatenate([planes.normals[planes.planar] for planes in self.surfaces])
        if len(flat) < const.PASSAGE_SURFACE * len(self.points):
            return None
        # door frames, windows and goods show sides along it, and not evenly: walls and floor tell its direction
        way, up = self._least_across(flat)[1], self.up[2]
        for _ in range(const.STEPS):
            weights = 1.0 / (1.0 + (flat @ way / const.WALL_RAD) ** 2) ** 2
            level = const.LEVEL_WEIGHT * weights.sum() * np.outer(up, up)  # where no floor is seen, it is level
            way = np.linalg.eigh((flat.T * weights) @ flat + level)[1][:, 0]
        return way

    def _least_across(self, normals: Array) -> tuple[Array, Array]:
        """Sums (2,) of squared normals (N, 3) along two horizontal ways, the least first, and its direction (3,)."""
        level = (normals @ self.up.T)[:, :2]
        sums, ways = np.linalg.eigh(level.T @ level)
        way: Array = self.up.T @ np.append(ways[:, 0], 0.0)
        return sums, way


def levelled(match: PreparedScan, query: PreparedScan, pose: Array) -> Array:
    """The pose `match_T_query` (4, 4) between the upright frames of two scans."""
    return np.asarray(match.upright_T_body @ pose @ invert(query.upright_T_body))


def views_decide(match: PreparedScan, query: PreparedScan) -> bool:
    """Whether images have to tell the pose, where there are any: a scan is wanting, or both show bare ground alone."""
    return not (match.usable and query.usable) or (match.terrain.even and query.terrain.even)


def structured(match: PreparedScan, query: PreparedScan) -> bool:
    """Whether enough stands up from the ground around both to tell one place from another."""
    return all(scan.map(query.cell_m).structured for scan in (match, query))


def same_rays(match: PreparedScan, query: PreparedScan) -> bool:
    """Whether the rays of two single scans lie nearer to each other than after a turn of the sensor by a degree.

    Those of rings do. Those of a scanner whose pattern never comes again do not, and its points tell positions apart.
    """
    turns = Rotation.from_euler("xy", [[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], degrees=True).as_matrix()
    turned = (query.rays[evenly(len(query.rays), const.SAMPLE)] @ turns).reshape(-1, 3)
    here, *others = np.median(kernels.KdTree(match.rays).nearest(turned)[1].reshape(len(turns), -1), axis=1)
    return bool(here < const.NO_PATTERN**2 * np.mean(others))


def submaps(match: PreparedScan, query: PreparedScan) -> bool:
    """Whether one of two scans at least is merged of several."""
    return max(match.merged, query.merged) > 1


def common_blur(match: PreparedScan, query: PreparedScan) -> float:
    """How far points of two scans may be off together because a LiDAR moved, m."""
    return max(match.blur_m, query.blur_m)


class ScanCache:
    """The most recently used scans; a cache, so it changes no result."""

    def __init__(self) -> None:
        self._scans: OrderedDict[tuple[int, int, int], PreparedScan] = OrderedDict()

    def __getitem__(self, keyframe: Keyframe) -> PreparedScan:
        # submaps of one keyframe differ by how far they reach
        key = keyframe.session, keyframe.stamp_ns, crc32(keyframe.points.tobytes())
        scan = self._scans.pop(key, None) or PreparedScan.of(keyframe)
        self._scans[key] = scan
        if len(self._scans) > const.SCANS_KEPT:
            self._scans.popitem(last=False)
        return scan

    def clear(self) -> None:
        """Forget all scans, as when stamps start over."""
        self._scans.clear()
