"""The compiled kernels against their definitions, on scans of a simulated room and on random points."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from oracle import scans as oracle
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, invert, make_pose, transform
from umf_ros.scan import _kernels as kernels

CELL_M, RANGE_M = 0.25, 40.0
RULES = (2.0, 0.3, 0.03, 0.8, CELL_M, 0.3)


def room(seed: int, count: int = 20_000) -> Array:
    """Floor, four walls and some boxes, seen from near the middle; (N, 3) m with 1 cm of noise."""
    rng = np.random.default_rng(seed)
    size = np.array([rng.uniform(8, 14), rng.uniform(5, 9), 3.0])
    parts = [
        np.column_stack([rng.uniform(-size[0], size[0], count), rng.uniform(-size[1], size[1], count), np.zeros(count)])
    ]
    for axis in (0, 1):
        for side in (-1, 1):
            wall = np.column_stack(
                [rng.uniform(-size[0], size[0], count), rng.uniform(-size[1], size[1], count), rng.uniform(0, 3, count)]
            )
            wall[:, axis] = side * size[axis]
            parts.append(wall)
    for _ in range(6):
        parts.append(rng.uniform(-0.4, 0.4, (800, 3)) + np.append(rng.uniform(-5, 5, 2), 0.5))
    return np.concatenate(parts) + rng.normal(0, 0.01, (5 * count + 4800, 3)) - [0.3, 0.2, 1.0]


def thinned(points: Array) -> Array:
    single = np.ascontiguousarray(points, np.float32)
    return kernels.cell_means(single, single, CELL_M, RANGE_M).astype(float)


@pytest.fixture(scope="module")
def scan() -> Array:
    return thinned(room(1))


POSE = make_pose(Rotation.from_euler("zyx", [0.2, 0.02, -0.01]).as_matrix(), [0.4, -0.2, 0.05])


@pytest.mark.parametrize("count", [1, 2, 9])
def test_points_are_moved_by_the_motion_of_their_time(count: int) -> None:
    rng = np.random.default_rng(count)
    points = rng.normal(0, 20, (5000, 3)).astype(np.float32)
    moments = np.sort(rng.uniform(0, 1e8, count))
    motions = rng.normal(0, 0.3, (count, 6))
    motions[0, :3] = 0.0
    times = np.concatenate([rng.uniform(-1e7, 1.1e8, 5000 - count), moments])
    found = kernels.deskew(points, times, moments, motions)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, oracle.deskew(points, times, moments, motions), atol=2e-5)
    with pytest.raises(ValueError, match="a time for every point"):
        kernels.deskew(points, times[1:], moments, motions)
    with pytest.raises(ValueError, match="at least one"):
        kernels.deskew(points, times, moments[:0], motions[:0])


def test_cells_have_the_means_of_their_points() -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(0, 20, (30_000, 3)).astype(np.float32)
    values = np.column_stack([points, rng.uniform(-1, 1, len(points))]).astype(np.float32)
    found = kernels.cell_means(points, values, CELL_M, RANGE_M)
    np.testing.assert_array_equal(found, oracle.cell_means(points, values, CELL_M, RANGE_M))
    assert kernels.cell_means(points[:0], values[:0], CELL_M, RANGE_M).shape == (0, 4)


@pytest.mark.parametrize("size", [1, 15, 16, 17, 333, 4000])
def test_neighbours_are_the_nearest(size: int) -> None:
    rng = np.random.default_rng(size)
    points, queries = rng.normal(0, 5, (size, 3)), rng.normal(0, 6, (200, 3))
    tree = kernels.KdTree(points)
    index, squared = oracle.neighbours(points, queries, 7)
    nearest, nearest_squared = tree.nearest(queries)
    np.testing.assert_array_equal(nearest, index[:, 0])
    np.testing.assert_allclose(nearest_squared, squared[:, 0], rtol=1e-4, atol=1e-5)
    found, found_squared = tree.neighbours(queries, 7)
    known = min(size, 7)
    np.testing.assert_array_equal(found[:, :known], index)
    np.testing.assert_allclose(found_squared[:, :known], squared, rtol=1e-4, atol=1e-5)
    assert np.isinf(found_squared[:, known:]).all() and (found[:, known:] == found[:, [known - 1]]).all()


def test_equal_and_far_points_are_found() -> None:
    tree = kernels.KdTree(np.zeros((100, 3)))
    assert tree.nearest(np.array([[1e5, 0.0, 0.0]]))[1] == pytest.approx(1e10)
    found = tree.neighbours(np.zeros((1, 3)), 32)[0][0]
    assert sorted(found) == sorted(set(found))


def test_normals_are_those_of_the_neighbours(scan: Array) -> None:
    found, expected = kernels.KdTree(scan).normals(scan, 10), oracle.normals(scan, 10)
    along = np.einsum("ij,ij->i", found, expected)
    assert np.quantile(along, 0.001) > 1 - 1e-6 and np.mean(along > 0.999) > 0.999
    assert not kernels.KdTree(scan[:4]).normals(scan[:4], 10).any()


@pytest.mark.parametrize("rings, known", [(1, False), (2, True)])
def test_a_single_ring_has_no_normals(rings: int, known: bool) -> None:
    """On a wall 5 m away, with noise; the next ring is .35 m above."""
    along, above = np.meshgrid(np.arange(-2, 2, 0.25), 0.35 * np.arange(rings))
    wall = np.column_stack([np.full(along.size, 5.0), along.ravel(), above.ravel()])
    wall += np.random.default_rng(0).normal(0, 0.01, wall.shape)
    normals = kernels.KdTree(wall).normals(wall, 10, 0.1)
    assert normals.any() == known
    assert not known or np.median(-normals[:, 0]) > 0.95


def test_planes_go_through_neighbourhoods(scan: Array) -> None:
    some = np.ascontiguousarray(scan[::5])
    centres, ways, reach, spread = kernels.KdTree(some).planes(8)
    expected = oracle.planes(some, 8)
    np.testing.assert_allclose(centres, expected[0], atol=1e-5)
    np.testing.assert_allclose(reach, expected[2], atol=1e-5)
    np.testing.assert_allclose(spread, expected[3], atol=1e-4)
    distinct = expected[3][:, 1] > 1.05 * expected[3][:, 0]
    assert (np.abs(np.einsum("ij,ij->i", ways, expected[1]))[distinct] > 0.999).all()


@pytest.mark.parametrize("reach_m", [1.0, 0.4])
@pytest.mark.parametrize("seed", range(4))
def test_scans_are_aligned_as_small_gicp_aligns_them(seed: int, reach_m: float) -> None:
    match, query = thinned(room(seed)), thinned(transform(invert(POSE), room(seed)))[::3].copy()
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix()
    guess = np.ascontiguousarray(POSE @ make_pose(turn, rng.normal(0, 0.15, 3)))
    tree, own = kernels.KdTree(match), kernels.KdTree(query).normals(query, 10)
    found = kernels.align(tree, tree.normals(match, 10), query, own, guess, reach_m, 8, 1e-3, np.radians(0.1))
    expected = oracle.align(match, query, guess, reach_m, 8)
    np.testing.assert_allclose(found, expected, atol=1e-3)
    if reach_m == 1.0:
        assert np.linalg.norm((invert(POSE) @ found)[:3, 3]) < 0.05


def test_nothing_to_align_leaves_the_guess(scan: Array) -> None:
    tree, far = kernels.KdTree(scan), scan[:50] + 500.0
    found = kernels.align(tree, tree.normals(scan, 10), far, np.zeros_like(far), POSE, 1.0, 8, 1e-3, 1e-3)
    np.testing.assert_array_equal(found, POSE)


@pytest.fixture(scope="module")
def merged(scan: Array) -> tuple[list[Array], Array]:
    """Two scans about their sensors, and `lidars_T_body`."""
    lidars_T_body = np.stack([invert(make_pose(np.eye(3), [0.1, 0, 0.3])), invert(POSE)])
    return [transform(lidars_T_body[0], scan), transform(lidars_T_body[1], thinned(room(1)[::2]))], lidars_T_body


def test_rays_tell_of_points_what_range_images_do(merged: tuple[list[Array], Array]) -> None:
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.normal(0, 6, (20_000, 3)), rng.normal(0, 0.3, (200, 3)), room(1)[::50]])
    for scans, poses in ((merged[0][:1], merged[1][:1]), merged):
        space = kernels.FreeSpace([kernels.RangeImage(one, *RULES) for one in scans], poses)
        found, expected = space.look_at(points), oracle.look_at(scans, poses, points)
        assert (found != expected).mean() < 1e-3  # angles in single precision
        assert set(np.unique(expected)) == {0, 1, 2}


def test_misfits_are_those_of_points_and_planes(scan: Array, merged: tuple[list[Array], Array]) -> None:
    scans, poses = merged
    space = kernels.FreeSpace([kernels.RangeImage(one, *RULES) for one in scans], poses)
    points = np.ascontiguousarray(thinned(room(1)[1::2])[::20])
    reach = np.random.default_rng(4).uniform(0.05, 0.4, len(points))
    tried = np.stack([np.eye(4), POSE, make_pose(np.eye(3), [2.0, 0, 0])])
    tree = kernels.KdTree(scan)
    by_points = space.point_misfits(tree, points, reach, tried, 3.0)
    centres, ways, radii, spread = tree.planes(8)
    planar = spread[:, 0] < 0.04
    by_planes = space.plane_misfits(tree, centres, ways, radii, planar, points, tried, 0.04, 0.8)
    for pose, of_points, of_planes in zip(tried, by_points, by_planes, strict=True):
        moved = transform(pose, points)
        (index, squared), sights = tree.nearest(moved), space.look_at(moved)
        np.testing.assert_array_equal(index, oracle.neighbours(scan, moved, 1)[0][:, 0])
        within_m = float(np.sqrt(np.median(squared)))
        is_near = squared < np.float32(within_m**2)
        near, away = tree.nearest(moved, within_m)
        np.testing.assert_array_equal(near, np.where(is_near, index, 0))
        np.testing.assert_array_equal(away, np.where(is_near, squared, np.inf))
        np.testing.assert_allclose(of_points, oracle.point_misfits(sights, np.sqrt(squared), reach, 3.0), atol=1e-3)
        fitted = centres, ways, np.minimum(radii, 0.8), planar
        np.testing.assert_allclose(of_planes, oracle.plane_misfits(sights, moved, scan, fitted, 0.04), atol=1e-3)
        assert np.isnan(of_points).any() and np.isfinite(of_planes).any()


def test_wrong_shapes_are_refused(scan: Array) -> None:
    tree = kernels.KdTree(scan)
    with pytest.raises(TypeError):
        tree.nearest(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="a normal for every point of the tree"):
        kernels.align(tree, scan[:5].copy(), scan, scan, np.eye(4), 1.0, 8, 1e-3, 1e-3)
    with pytest.raises(ValueError, match="1 to 32 neighbours"):
        tree.neighbours(scan, 33)
    with pytest.raises(ValueError, match="the tree has no points"):
        kernels.KdTree(np.empty((0, 3))).nearest(scan)
    with pytest.raises(ValueError, match="a pose for every image"):
        kernels.FreeSpace([], np.eye(4)[None])


def test_nan_and_infinite_points_end_nothing(scan: Array) -> None:
    strange = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [-np.inf, np.nan, 1e300]])
    space = kernels.FreeSpace([kernels.RangeImage(scan, *RULES)], np.eye(4)[None])
    tree = kernels.KdTree(scan)
    assert len(space.look_at(strange)) == 3 and (tree.nearest(strange)[0] < len(scan)).all()
    every = np.concatenate([scan, strange])
    assert len(kernels.KdTree(every).normals(every, 10)) == len(every)
    kernels.RangeImage(strange, *RULES)
    kernels.cell_means(np.float32([[np.nan, 0, 0], [np.inf, 0, 0]]), np.ones((2, 1), np.float32), CELL_M, RANGE_M)


def test_other_threads_run_meanwhile(scan: Array) -> None:
    tree, queries = kernels.KdTree(scan), np.repeat(scan, 400, axis=0)
    ticks, done = [], threading.Event()

    def tick() -> None:
        while not done.wait(0.001):
            ticks.append(time.monotonic())

    before = sys.getswitchinterval()
    sys.setswitchinterval(60.0)  # no switch but where the lock is released
    try:
        other = threading.Thread(target=tick)
        other.start()
        start = time.monotonic()
        tree.nearest(queries)
        end = time.monotonic()
    finally:
        sys.setswitchinterval(before)
        done.set()
        other.join()
    assert sum(start < one < end for one in ticks) > 3


def test_a_package_that_was_not_built_says_so(tmp_path: Path) -> None:
    package = Path(kernels.__file__).parents[1]
    shutil.copytree(
        package, tmp_path / "umf_ros", ignore=shutil.ignore_patterns("*.so", "lab", "baselines", "__pycache__")
    )
    command = [sys.executable, "-c", "import umf_ros.verification"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "UmfError" in done.stderr.splitlines()[-1]
    assert "umf_ros/scan/_kernels, is missing or of another Python: run `make install`" in done.stderr
