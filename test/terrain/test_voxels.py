import numpy as np
from ground import WALL, placed

from umf_ros.core.geometry import Array
from umf_ros.terrain.voxels import VoxelMap

CRATE = (6.0, 3.0, 0.4, 0.8)
STEPS = np.arange(0.0, 12.0, 0.5)


def near(points: Array, x: float, y: float, radius: float = 0.6, above_m: float = 0.25) -> Array:
    """The points above the ground near a place."""
    return points[(np.hypot(points[:, 0] - x, points[:, 1] - y) < radius) & (points[:, 2] > above_m)]


def test_a_crate_is_gone_once_the_rover_has_passed_without_it() -> None:
    voxels = VoxelMap(0.2)
    voxels.add([placed(x, [*WALL, CRATE]) for x in STEPS])
    assert len(near(voxels.points(), 6.0, 3.0)) > 10
    voxels.add([placed(x, WALL) for x in STEPS])
    assert len(near(voxels.points(), 6.0, 3.0)) == 0


def test_people_who_walk_leave_nothing_also_in_front_of_the_sky() -> None:
    voxels = VoxelMap(0.2)
    for x in STEPS:
        voxels.add([placed(x, [*WALL, (x + 4.0, -2.0 - 0.1 * x, 0.25, 1.8)])])
    voxels.add([placed(x, WALL) for x in STEPS[::-1]])
    left = voxels.points()
    assert ((left[:, 1] < -1.0) & (left[:, 2] > 0.25)).sum() == 0


def test_nothing_static_is_lost() -> None:
    voxels = VoxelMap(0.2)
    voxels.add([placed(x, [*WALL, CRATE]) for x in [*STEPS, *STEPS[::-1]]])
    assert len(voxels.points()) == len(voxels)


def test_what_came_last_stays() -> None:
    voxels = VoxelMap(0.2)
    voxels.add([placed(x, WALL) for x in STEPS])
    voxels.add([placed(x, [*WALL, CRATE]) for x in STEPS])
    assert len(near(voxels.points(), 6.0, 3.0)) > 10


def test_scans_one_by_one_give_the_same_as_all_at_once() -> None:
    scans = [placed(x, [*WALL, CRATE]) for x in STEPS] + [placed(x, WALL) for x in STEPS]
    once, growing = VoxelMap(0.2), VoxelMap(0.2)
    once.add(scans)
    for one in scans:
        growing.add([one])
    assert len(once) == len(growing)
    # a voxel at the margin of a test may differ: its mean point grows
    assert abs(len(once.points()) - len(growing.points())) <= 0.002 * len(once)


def test_points_of_the_map_are_told_from_those_that_were_left_out() -> None:
    voxels = VoxelMap(0.2)
    voxels.add([placed(x, [*WALL, CRATE]) for x in STEPS])
    crate, wall = near(voxels.points(), 6.0, 3.0), near(voxels.points(), 6.0, 6.0)
    voxels.add([placed(x, WALL) for x in STEPS])
    assert not voxels.are_static(crate).any() and voxels.are_static(wall).all()
    assert voxels.are_static(np.array([[100.0, 0.0, 0.0]])).all()


def test_a_map_without_scans_is_empty() -> None:
    voxels = VoxelMap(0.2)
    voxels.add([])
    voxels.add([(np.empty((0, 3), np.float32), np.eye(4), np.eye(4))])
    assert len(voxels) == 0 and voxels.points().shape == (0, 3)
    assert voxels.are_static(np.zeros((1, 3))).all()
