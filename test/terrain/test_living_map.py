import numpy as np
from ground import BODY_T_LIDAR, WALL, pose_at, scan

from umf_ros.core.config import TerrainSettings
from umf_ros.core.geometry import Array, make_pose
from umf_ros.core.trajectory import Trajectory
from umf_ros.terrain.living_map import LivingMap

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
    np.testing.assert_allclose(living._poses, there[:17], atol=1e-9)


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
