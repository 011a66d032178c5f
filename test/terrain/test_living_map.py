import numpy as np
import pytest
from ground import BODY_T_LIDAR, WALL, pose_at, scan
from scipy.spatial.transform import Rotation

from umf_ros.core.config import TerrainSettings
from umf_ros.core.geometry import Array, make_pose
from umf_ros.core.trajectory import Trajectory
from umf_ros.terrain import voxels
from umf_ros.terrain.voxels import LivingMap

SECOND = 10**9
METRES = np.arange(0.0, 10.0, 0.5)
SCANS = [scan(pose_at(x), WALL) for x in METRES]


def driven(shift_m: float = 0.0) -> LivingMap:
    """A drive at 0.5 m/s; its odometry begins at a place of its own."""
    living = LivingMap(TerrainSettings())
    for row, x in enumerate(METRES):
        living.add_odometry(row * SECOND, pose_at(x + shift_m))
        living.add_scan(row * SECOND, SCANS[row], BODY_T_LIDAR[:3, 3])
    return living


def path(places: Array, count: int = len(METRES)) -> Trajectory:
    return Trajectory(np.arange(count) * SECOND, np.stack([pose_at(*place) for place in places[:count]]))


def straight(y: float = 0.0) -> Array:
    return np.column_stack([METRES, np.full(len(METRES), y)])


def wall_y(living: LivingMap) -> float:
    points = living.voxels.points()
    return float(np.median(points[points[:, 2] > 1.5, 1]))


def test_scans_wait_for_the_path() -> None:
    living = driven()
    assert not living.update() and living.waiting == len(METRES)
    living.correct(path(straight(), 11))
    assert living.update() and living.voxels.scans == 11 and living.newest_ns == 10 * SECOND
    assert not living.update()


def test_the_map_moves_with_the_path_and_small_corrections_move_nothing() -> None:
    living = driven(shift_m=50.0)
    living.correct(path(straight()))
    assert living.update() and abs(wall_y(living) - 5.8) < 0.2 and living.rebuilt == 0
    living.correct(path(straight(0.05)))
    assert not living.update()
    living.correct(path(straight(3.0)))
    assert living.update() and abs(wall_y(living) - 8.8) < 0.2 and living.rebuilt == 1


def test_a_thinned_path_places_scans_by_the_odometry_between_its_poses() -> None:
    living = LivingMap(TerrainSettings())
    there = np.stack([pose_at(x, 0.5 * np.sin(x)) for x in METRES])
    for row, pose in enumerate(there):
        living.add_odometry(row * SECOND, pose)
        living.add_scan(row * SECOND, SCANS[row], BODY_T_LIDAR[:3, 3])
    living.correct(Trajectory(np.arange(0, 20, 4) * SECOND, there[::4]))
    assert living.update()
    assert living.voxels.scans == 17  # up to the last pose of the path
    shown = living.voxels.points()
    living.correct(Trajectory(np.arange(20) * SECOND, there))  # all of its poses
    living.update()
    assert living.rebuilt == 0 and len(living.voxels.points()) >= len(shown)


def test_a_session_that_is_not_in_the_map_is_left_out() -> None:
    living = LivingMap(TerrainSettings())
    for row, x in enumerate(METRES):
        jump = 100.0 if 8 <= row < 14 else 0.0
        living.add_odometry(row * SECOND, make_pose(np.eye(3), [x + jump, 0.0, 0.0]))
        living.add_scan(row * SECOND, SCANS[row], BODY_T_LIDAR[:3, 3])
    rows = np.array([row for row in range(len(METRES)) if not 8 <= row < 14])
    living.correct(Trajectory(rows * SECOND, np.stack([pose_at(METRES[row]) for row in rows])))
    assert living.update() and living.voxels.scans == len(rows)


def test_a_clock_that_is_set_back_begins_a_new_map() -> None:
    living = driven()
    living.correct(path(straight()))
    living.update()
    living.add_odometry(0, pose_at(0.0))
    assert len(living.voxels) == 0 and living.newest_ns == 0


def test_memory_stops_growing_on_the_same_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxels, "LATEST", 100)
    angles = np.deg2rad(np.arange(0.0, 360.0, 6.0))
    places = 6.0 * np.column_stack([np.sin(angles), 1 - np.cos(angles), np.zeros(len(angles))])
    loop = np.stack(
        [make_pose(Rotation.from_euler("z", a).as_matrix(), at) for a, at in zip(angles, places, strict=True)]
    )
    seen = [scan(pose, WALL) for pose in loop]
    living, sizes = LivingMap(TerrainSettings()), []
    for lap in range(8):
        for row, pose in enumerate(loop):
            stamp_ns = (lap * len(loop) + row) * SECOND
            drift = make_pose(np.eye(3), [0.0, 0.3 * stamp_ns / (len(loop) * SECOND), 0.0])
            living.add_odometry(stamp_ns, drift @ pose)
            living.add_scan(stamp_ns, seen[row], BODY_T_LIDAR[:3, 3])
        driven = np.tile(loop, (lap + 1, 1, 1))
        rows = np.append(np.arange(0, len(driven) - 1, 2 ** (1 + lap // 2)), len(driven) - 1)
        living.correct(Trajectory(rows * SECOND, driven[rows]))
        assert living.update() and living.waiting == 0
        sizes.append((*living.kept, len(living.voxels)))
    scans, odometry, cells = np.array(sizes).T
    assert scans.max() < 1.2 * scans[1] and odometry.max() < 100 + 2 * (scans.max() + len(rows))
    assert cells[-1] < 1.1 * cells[1]
    living.correct(Trajectory(rows * SECOND, make_pose(np.eye(3), [0.0, 3.0, 0.0]) @ driven[rows]))
    assert living.update() and living.rebuilt == 1 and abs(wall_y(living) - 8.8) < 0.3
    assert len(living.voxels) > 0.9 * cells[-1]


def test_scans_without_a_path_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxels, "WAITING", 5)
    living = driven()
    assert not living.update() and living.kept == (5, len(METRES))
    living.correct(path(straight()))
    assert living.update() and living.voxels.scans == 5 and living.newest_ns == 19 * SECOND


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("far_m", [65.6, -70.0, 135.0, 9000.0, np.nan, np.inf])
def test_a_return_beyond_the_range_of_a_stored_point_is_no_wall_nearby(axis: int, far_m: float) -> None:
    living, clean = LivingMap(TerrainSettings()), driven()
    for row, x in enumerate(METRES):
        strange = np.tile(np.float32([3.0, 3.0, 0.5]), (20, 1))
        strange[:, axis] = far_m
        living.add_odometry(row * SECOND, pose_at(x))
        living.add_scan(row * SECOND, np.vstack([SCANS[row], strange]), BODY_T_LIDAR[:3, 3])
    for one in (living, clean):
        one.correct(path(straight()))
        assert one.update()
    np.testing.assert_array_equal(living.voxels.points(), clean.voxels.points())
