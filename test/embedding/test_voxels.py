from __future__ import annotations

import numpy as np
import pytest
from tiny_worlds import some_scan

from umf_ros.embedding.inputs import CELLS, ORIGIN_M, VOXEL_M, _brightness, is_blank, shrink, standardise, voxelise
from umf_ros.embedding.umf import cell_regions, ground_regions, select_salient


def cluster(x: float, y: float, z: float, count: int = 30) -> np.ndarray:
    return np.tile(np.array([[x, y, z]], np.float32), (count, 1))


def features_of(scan, x: int, y: int, z: int) -> np.ndarray:
    """The six features of voxel (x, y, z) of the 40^3 grid, unfolded."""
    cell = scan.grid[x // 2, y // 2, z // 2].reshape(6, 8)
    return cell[:, x % 2 * 4 + y % 2 * 2 + z % 2]


def test_a_point_lands_in_its_voxel():
    scan = voxelise(cluster(10.25, -3.5, 1.0), np.full(30, 100.0, np.float32), 8, 8)
    occupancy, dx, dy, dz, height, intensity = features_of(scan, 10, 16, 23)
    assert occupancy == 1
    assert (dx, dy) == pytest.approx((-0.25, 0.0), abs=1e-5)
    assert dz == pytest.approx((1.0 + 6) / 0.3 - 23.5, abs=1e-4)
    assert height == pytest.approx(1 / 6, abs=1e-5)
    assert intensity == pytest.approx(0, abs=1e-4)
    assert scan.fine_index[scan.fine_mask].tolist() == [(10 * 40 + 16) * 40 + 23]
    assert scan.coarse_index[scan.coarse_mask].tolist() == [(2 * 10 + 4) * 10 + 5]
    np.testing.assert_allclose(scan.centroids[0], [10.25, -3.5, 1.0], atol=1e-4)
    assert np.count_nonzero(scan.grid) == np.count_nonzero(features_of(scan, 10, 16, 23))


@pytest.mark.parametrize("outside", [(-0.1, 0, 0), (40, 0, 0), (5, 20.0, 0), (5, -20.1, 0), (5, 0, 6), (5, 0, -6.1)])
def test_the_box_is_metric(outside):
    """The reference's grid of one metre keeps one voxel of a real scan."""
    assert not voxelise(cluster(*outside), None, 8, 8).fine_mask.any()


def test_most_of_a_scan_of_the_real_range_is_kept():
    assert voxelise(some_scan(0), None, 160, 512).fine_mask.sum() == 512


def test_the_fullest_cells_are_kept_and_ties_go_by_index():
    points = np.concatenate(
        [cluster(1.5, 0.5, 0), cluster(9.5, 0.5, 0, 40), cluster(5.5, 0.5, 0), cluster(17.5, 0.5, 0)]
    )
    scan = voxelise(points, None, 2, 2)
    assert (scan.fine_index // 1600).tolist() == [1, 9]
    assert (scan.coarse_index // 100).tolist() == [0, 2]


def test_the_order_of_the_points_does_not_matter():
    points = some_scan(3)
    one, two = voxelise(points, None, 60, 300), voxelise(points[::-1], None, 60, 300)
    np.testing.assert_array_equal(one.fine_index, two.fine_index)
    np.testing.assert_allclose(one.grid, two.grid, atol=1e-4)


@pytest.mark.parametrize(
    "points", [np.empty((0, 3)), np.full((50, 3), np.nan), cluster(5, 0, 0, 5)], ids=["none", "nan", "few"]
)
def test_nothing_to_see(points):
    scan = voxelise(points.astype(np.float32), None, 8, 8)
    assert not scan.fine_mask.any()
    assert not scan.coarse_mask.any()
    assert not scan.grid.any()


def test_the_unit_of_the_intensity_does_not_matter():
    points, level = some_scan(1), np.random.default_rng(0).uniform(100, 4000, 2000).astype(np.float32)
    one, two = voxelise(points, level, 60, 300), voxelise(points, level * 100, 60, 300)
    np.testing.assert_allclose(one.grid, two.grid, atol=0.05)
    assert np.isfinite(voxelise(points, np.full(2000, np.nan, np.float32), 60, 300).grid).all()


@pytest.mark.parametrize("scale", [1.0, 255.0, 4095.0])
def test_the_same_scan_of_sensors_of_other_scales_is_the_same(scale):
    points, level = some_scan(1), np.random.default_rng(0).uniform(0, 1, 2000).astype(np.float32)
    of_the_cube = voxelise(points, level * 4095, 60, 300)
    np.testing.assert_allclose(voxelise(points, level * np.float32(scale), 60, 300).grid, of_the_cube.grid, atol=1e-5)


def test_intensities_that_vary_as_none_did_in_training_fade():
    """Half of the returns at zero, as KITTI's sensor tells it: the grid is that of a scan without intensity."""
    points, rng = some_scan(1), np.random.default_rng(0)
    coarse = np.where(rng.random(2000) < 0.5, 0, rng.uniform(0.2, 0.6, 2000)).astype(np.float32)
    without = voxelise(points, None, 60, 300).grid
    np.testing.assert_array_equal(voxelise(points, coarse, 60, 300).grid, without)
    assert np.abs(voxelise(points, coarse + np.float32(0.1), 60, 300).grid - without).max() > 0.5


def test_intensities_of_the_cube_are_taken_as_they_are():
    """The input the network was trained on, bit for bit."""
    points, level = some_scan(1), np.random.default_rng(0).uniform(16, 900, 2000).astype(np.float32)
    inside = (np.abs((points - ORIGIN_M) / VOXEL_M / CELLS - 0.5) < 0.5).all(axis=1)
    logs = np.log1p(level[inside])
    np.testing.assert_array_equal(_brightness(level, inside), np.clip((logs - logs.mean()) / (logs.std() + 0.1), -3, 3))


def test_exposure_does_not_matter():
    image = np.random.default_rng(0).integers(20, 120, (48, 64)).astype(np.uint8)
    np.testing.assert_allclose(standardise(image), standardise(image * 2), atol=0.35)
    assert abs(standardise(image).mean()) < 1e-5


def test_blank_images():
    assert is_blank(np.zeros((48, 64), np.uint8))
    assert is_blank(np.full((48, 64), 200, np.uint8))
    assert not is_blank(np.tile(np.arange(64, dtype=np.uint8), (48, 1)))


def test_the_whole_view_is_shrunk():
    image = np.zeros((512, 688), np.uint8)
    image[:, 344:] = 200
    small = shrink(image, (96, 128))
    assert small.shape == (96, 128)
    assert small[:, :64].max() == 0
    assert small[:, 64:].min() == 200


def test_key_points_are_spread_and_sorted():
    saliency = np.array([9, 8, 7, 6, 1, 0.01], np.float32)
    region = np.array([0, 0, 0, 0, 1, 2])
    assert select_salient(saliency, region, 0.5, 3).tolist() == [0, 1, 4]
    assert select_salient(saliency, region, 0.5, 10).tolist() == [0, 1, 2, 3, 4]
    assert select_salient(saliency, region, 100, 3).tolist() == []


def test_regions_cover_the_view():
    regions = cell_regions(8, 12)
    assert len(set(regions.tolist())) == 6
    assert regions[0] == regions[3] != regions[4]
    assert len(set(ground_regions(np.array([[1, 1, 0], [3, 3, 5], [5, 1, 0], [1, -1, 0]], np.float32)).tolist())) == 3
