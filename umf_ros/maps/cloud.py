"""Make a map of the point cloud of another program: its places are views rendered out of the cloud.

A LiDAR is placed in the cloud along a trajectory, or else on the cells where a rover can stand, and looks in several
headings; points behind nearer ones are hidden. Each heading is a session with exact odometry, driven in its direction
along a trajectory, and joined to the first by exact closures: later recordings can be added as to any other map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d
from scipy.spatial.transform import Rotation

from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Frame, Keyframe, LoopClosure, ScanMotion
from umf_ros.core.geometry import Array, first_of_cubes, interpolate, invert, make_pose, relative, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.detector import make_keyframe
from umf_ros.embedding import Embedder
from umf_ros.maps.map_folder import MapFolder
from umf_ros.maps.mapping import Drive, add_drive
from umf_ros.sensors.calibration import NO_CAMERA
from umf_ros.sensors.decode import OdometrySample

SPACING_M, CELL_M = 1.0, 2.0
"""Distance of places along a trajectory, and sides of the cells without one."""
_START_NS, _SECOND_NS = 1_000_000_000 * 10**9, 10**9
_EXACT = np.diag([0.01, 0.01, 0.01, 0.002, 0.002, 0.002]) ** 2
# visibility: side of the cells of a depth image, deg, and by how much a point may lie behind the nearest, of its range
# and in m; points are so sparse near the LiDAR that wider cells close the gaps between them
_FINE, _COARSE, _COARSE_M = (1.0, 1.05, 0.3), (3.0, 1.4, 0.5), 6.0
_NEAREST_M, _FEWEST, _THIN_M, _WIDEST_M = 0.5, 100, 0.1, 50_000.0
BLIND = f"have fewer than {_FEWEST} points: is the trajectory in the frame of the cloud, in metres, z upwards?"
# a rover stands where so many points are, few of them in its way above the ground, and no step is next to it
_GROUND_POINTS, _GROUND_SHARE, _BODY_M, _IN_THE_WAY, _STEP_M = 20, 0.1, (0.4, 1.8), 0.05, 0.6


@dataclass(frozen=True)
class VirtualLidar:
    """The LiDAR that views are rendered for.

    Attributes:
        width_deg: of its field of view.
        low_deg, high_deg: elevations of its lowest and highest beam.
        range_m: nothing is seen beyond.
        height_m: above the ground, where there is no trajectory.
    """

    width_deg: float = 360.0
    low_deg: float = -30.0
    high_deg: float = 30.0
    range_m: float = 40.0
    height_m: float = 1.2

    def see(self, cloud: Array, map_T_lidar: Array) -> NDArray[np.float32]:
        """Return the points (M, 3) of a cloud (N, 3) in the map that it sees, in its own frame."""
        reach = np.abs(cloud[:, :2] - map_T_lidar[:2, 3]).max(axis=1) < self.range_m
        points = transform(invert(map_T_lidar), cloud[reach])
        away = np.linalg.norm(points, axis=1)
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        elevation = np.degrees(np.arcsin(points[:, 2] / np.maximum(away, _NEAREST_M)))
        seen = (away > _NEAREST_M) & (away < self.range_m) & (np.abs(azimuth) <= self.width_deg / 2)
        seen &= (elevation >= self.low_deg) & (elevation <= self.high_deg)
        seen &= ~_hidden(azimuth, elevation, away, *_FINE, away)
        near = away < _COARSE_M
        seen &= ~_hidden(azimuth, elevation, np.where(near, away, np.inf), *_COARSE, away)
        return np.asarray(points[seen], np.float32)


def _hidden(
    azimuth: Array, elevation: Array, away: Array, cell_deg: float, ratio: float, margin_m: float, own: Array
) -> NDArray[np.bool_]:
    """Return (N,) which points lie behind a nearer one in their direction; `away` are those that hide, `own` all."""
    columns = round(360 / cell_deg)
    column = np.floor((azimuth + 180) / cell_deg).astype(int) % columns
    row = np.floor((elevation + 90) / cell_deg).astype(int)
    image = np.full((int(180 / cell_deg) + 1, columns), np.inf)
    np.minimum.at(image, (row, column), away)
    nearest = minimum_filter1d(image, 3, axis=1, mode="wrap")[row, column]
    return np.asarray(own > ratio * nearest + margin_m)


def thinned(points: Array, path: Path) -> Array:
    """Return one of the points (N, 3) of the cloud of a file in every cube of 10 cm.

    Raises:
        UmfError: there are too few, or they lie too far apart.
    """
    if len(points) < _FEWEST:
        raise UmfError(f"{path} holds {len(points)} points that are no NaN and not at the origin: too few for a map")
    if (width_m := float(np.ptp(points, axis=0).max())) > _WIDEST_M:
        raise UmfError(f"{path} is {width_m:.3g} m wide: is it in metres, without outliers?")
    return points[first_of_cubes(points, _THIN_M)]


def along(trajectory: Trajectory) -> Array:
    """Return poses (K, 4, 4) of a trajectory, a metre apart; without rotations, they look along it.

    Raises:
        UmfError: it is shorter than that.
    """
    poses = trajectory.poses
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    rows = np.unique(np.floor(np.concatenate([[0.0], np.cumsum(steps)]) / SPACING_M), return_index=True)[1]
    if len(rows) < 2:
        raise UmfError(f"the trajectory has {len(poses)} poses within {SPACING_M:g} m: places are that far apart")
    chosen = poses[rows].copy()
    if not trajectory.has_orientation:
        ways = np.gradient(chosen[:, :2, 3], axis=0)
        chosen[:, :3, :3] = Rotation.from_euler("z", np.arctan2(ways[:, 1:], ways[:, :1])).as_matrix()
    return chosen


def standing(cloud: Array, height_m: float) -> Array:
    """Return poses (K, 4, 4) above the cells of a cloud where a rover can stand, row by row.

    Raises:
        UmfError: it can stand nowhere.
    """
    cells = np.floor(cloud[:, :2] / CELL_M).astype(int)
    cells -= cells.min(axis=0)
    shape = tuple(cells.max(axis=0) + 3)
    flat = np.ravel_multi_index(tuple((cells + 1).T), shape)
    order = np.lexsort((cloud[:, 2], flat))
    known, starts, counts = np.unique(flat[order], return_index=True, return_counts=True)
    ground = np.full(shape, np.nan)
    ground.flat[known] = cloud[order[starts + (_GROUND_SHARE * counts).astype(int)], 2]
    above = cloud[:, 2] - ground.flat[flat]
    blocking = np.bincount(flat[(above > _BODY_M[0]) & (above < _BODY_M[1])], minlength=ground.size)
    free = np.bincount(flat, minlength=ground.size) >= _GROUND_POINTS
    free &= blocking <= _IN_THE_WAY * np.bincount(flat, minlength=ground.size)
    beside = np.stack([np.roll(ground, shift, axis) for axis in (0, 1) for shift in (-1, 1)])
    level = ~(np.abs(beside - ground) > _STEP_M).any(axis=0)
    rows, columns = np.nonzero(free.reshape(shape) & level)
    if not len(rows):
        raise UmfError("no cell of the cloud where a rover can stand: is it a map in metres, z upwards? (--trajectory)")
    order = np.lexsort((np.where(rows % 2, -columns, columns), rows))  # there and back
    rows, columns = rows[order], columns[order]
    corner = np.floor(cloud[:, :2].min(axis=0) / CELL_M) - 1
    middles = (np.stack([rows, columns], axis=1) + corner + 0.5) * CELL_M
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = np.column_stack([middles, ground[rows, columns] + height_m])
    return poses


@dataclass(frozen=True)
class CloudViews:
    """Views of a cloud.

    Attributes:
        cloud: (N, 3) m, in the map, thinned.
        poses: (K, 4, 4) of the LiDAR in the map, in the order in which it drives.
        headings_deg: by which it is turned about its own axis; turned round, it drives the other way.
        lidar: it sees them.
    """

    cloud: Array
    poses: Array
    headings_deg: tuple[float, ...]
    lidar: VirtualLidar


def import_cloud(
    target: MapFolder, path: Path, views: CloudViews, embedder: Embedder, on_view: Callable[[float], None]
) -> int:
    """Add the views of the cloud of a file to a map; return their number; `on_view` takes the share that is done.

    Raises:
        UmfError: most of them show too little.
    """
    first, count, tried, wanted = dict[int, tuple[int, Array]](), 0, 0, len(views.poses) * len(views.headings_deg)
    for turn_deg in views.headings_deg:
        rows = list(range(len(views.poses)))[:: -1 if turn_deg == 180 else 1]
        turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
        walked, stamps = _walk(views.poses[rows] @ make_pose(turn, np.zeros(3)))
        places, between = dict[int, Keyframe](), list[LoopClosure]()
        for row, place in _places(views, embedder, walked, dict(zip(stamps, rows, strict=True))):
            tried += 1
            on_view(tried / wanted)
            if place is not None:
                places[row] = place
        if not places:
            continue
        for row in places.keys() & first.keys():
            (match_ns, match_pose), place = first[row], places[row]
            assert place.odom_T_body is not None
            step = relative(match_pose, place.odom_T_body)
            between.append(LoopClosure(place.stamp_ns, match_ns, step, _EXACT, 0.999))
        about: dict[str, Any] = {"start_ns": walked[0].stamp_ns, "end_ns": walked[-1].stamp_ns, "of_cloud": True}
        drive = Drive(f"{path.stem}_{turn_deg:.0f}", walked, list(places.values()), between)
        about |= {"path": str(path.resolve()), "messages": {drive.name: len(walked)}}
        session = add_drive(target, drive, (embedder.name, embedder.dimension), about)
        if not first:
            for row, one in places.items():
                assert one.odom_T_body is not None
                first[row] = one.stamp_ns + session.shift_ns, one.odom_T_body
        count += len(places)
    if 2 * count < wanted:
        raise UmfError(f"{path}: {wanted - count} of {wanted} views {BLIND}")
    return count


def _walk(poses: Array) -> tuple[list[OdometrySample], list[int]]:
    """Return exact odometry through poses at a metre per second, at most a metre apart, and the stamps of the poses."""
    samples, stamps = [OdometrySample(_START_NS, poses[0])], [_START_NS]
    for before, after in pairwise(poses):
        count = max(1, round(float(np.linalg.norm(after[:3, 3] - before[:3, 3]))))
        for share in np.arange(1, count + 1) / count:
            samples.append(OdometrySample(samples[-1].stamp_ns + _SECOND_NS, interpolate(before, after, share)))
        stamps.append(samples[-1].stamp_ns)
    return samples, stamps


def _places(
    views: CloudViews, embedder: Embedder, walked: list[OdometrySample], row_of: dict[int, int]
) -> Iterator[tuple[int, Keyframe | None]]:
    """Yield the row and the place of every pose on a walk; None where the cloud shows too little."""
    path_m, before = 0.0, walked[0].odom_T_body
    for one in walked:
        path_m, before = path_m + float(np.linalg.norm((one.odom_T_body - before)[:3, 3])), one.odom_T_body
        if one.stamp_ns in row_of:
            yield row_of[one.stamp_ns], _place(views, embedder, one, path_m)


def _place(views: CloudViews, embedder: Embedder, at: OdometrySample, path_m: float) -> Keyframe | None:
    points = views.lidar.see(views.cloud, at.odom_T_body)
    if len(points) < _FEWEST:
        return None
    frame = Frame(
        stamp_ns=at.stamp_ns,
        camera=NO_CAMERA,
        body_T_camera=np.eye(4),
        body_T_lidar=np.eye(4),
        points=points,
        odom_T_body=at.odom_T_body,
        motion=ScanMotion.none(len(points)),
    )
    return make_keyframe(frame, embedder, path_m)
