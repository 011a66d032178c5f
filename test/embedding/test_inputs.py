"""From images and scans to tensors: what is cut, filled and said to be missing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from tiny_worlds import TINY, some_scan

from umf_ros.embedding.inputs import (
    CELLS,
    MIN_POINTS,
    ORIGIN_M,
    VOXEL_M,
    blank_input,
    is_blank,
    pack,
    prepare_image,
    prepare_scan,
    shrink,
    standardise,
    voxelise,
)
from umf_ros.embedding.umf import cell_regions, ground_regions, select_salient
from umf_ros.lab.training.batches import trimmed


def voxels_of(points: np.ndarray) -> dict[tuple[int, int, int], list[int]]:
    """Rows of the points in every voxel, one point at a time."""
    members: dict[tuple[int, int, int], list[int]] = {}
    for row, point in enumerate(points):
        cell = np.floor((point - ORIGIN_M) / VOXEL_M)
        if np.isfinite(cell).all() and (cell >= 0).all() and (cell < CELLS).all():
            members.setdefault((int(cell[0]), int(cell[1]), int(cell[2])), []).append(row)
    return members


def unfolded(grid: np.ndarray) -> np.ndarray:
    """(40, 40, 40, 6) features of a folded grid."""
    parts = grid.reshape(20, 20, 20, 6, 2, 2, 2)
    return parts.transpose(0, 4, 1, 5, 2, 6, 3).reshape(CELLS, CELLS, CELLS, 6)


@pytest.fixture(scope="module")
def scan() -> tuple[np.ndarray, np.ndarray]:
    """A scan with outliers, a hole and a bright side."""
    rng = np.random.default_rng(4)
    points = np.concatenate([some_scan(2, 1500), rng.uniform((-5, -30, -9), (60, 30, 9), (400, 3))]).astype(np.float32)
    points[::97] = np.nan
    return points, (100 + 300 * (points[:, 1] > 0) + rng.random(len(points))).astype(np.float32)


def test_voxels_are_those_of_a_loop_over_the_points(scan):
    points, intensity = scan
    members = voxels_of(points)
    found = voxelise(points, intensity, 1000, 4000)
    rows = [row for inside in members.values() for row in inside]
    level = np.log1p(intensity)
    level = (level - level[rows].mean()) / (level[rows].std() + 0.1)
    wanted = np.zeros((CELLS, CELLS, CELLS, 6))
    for cell, inside in members.items():
        middle = points[inside].mean(axis=0)
        offset = (middle - ORIGIN_M) / VOXEL_M - np.array(cell) - 0.5
        wanted[cell] = [1, *offset, middle[2] / 6, level[inside].mean()]
    np.testing.assert_allclose(unfolded(found.grid), wanted, atol=2e-4)
    flat = sorted((x * CELLS + y) * CELLS + z for x, y, z in members)
    assert found.fine_index[found.fine_mask].tolist() == flat
    for row in range(0, len(flat), 50):
        inside = members[flat[row] // 1600, flat[row] // 40 % 40, flat[row] % 40]
        np.testing.assert_allclose(found.centroids[row], points[inside].mean(axis=0), atol=1e-3)
    assert not found.fine_index[~found.fine_mask].any() and not found.centroids[~found.fine_mask].any()


def test_coarse_cells_are_those_of_the_fine_ones(scan):
    members = voxels_of(scan[0])
    counts: dict[int, int] = {}
    for (x, y, z), inside in members.items():
        cell = (x // 4 * 10 + y // 4) * 10 + z // 4
        counts[cell] = counts.get(cell, 0) + len(inside)
    everything = voxelise(*scan, 1000, 4000)
    assert everything.coarse_index[everything.coarse_mask].tolist() == sorted(counts)
    few = voxelise(*scan, 12, 4000)
    fullest = sorted(counts, key=lambda cell: (-counts[cell], cell))[:12]
    assert few.coarse_index.tolist() == sorted(fullest) and few.coarse_mask.all()


@pytest.mark.parametrize(("count", "there"), [(MIN_POINTS - 1, False), (MIN_POINTS, True)])
def test_a_handful_of_points_is_no_scan(count, there):
    assert voxelise(some_scan(0, count), None, 40, 96).fine_mask.any() == there


@pytest.mark.parametrize("corner", [(0.0, -20.0, -6.0), (39.999, 19.999, 5.999)])
def test_the_borders_of_the_box_belong_to_it_below_and_not_above(corner):
    points = np.tile(np.array(corner, np.float32), (MIN_POINTS, 1))
    assert voxelise(points, None, 8, 8).fine_mask.sum() == 1
    assert voxelise(points + VOXEL_M * CELLS, None, 8, 8).fine_mask.sum() == 0


def test_a_scan_of_one_brightness_has_no_bright_side():
    grid = unfolded(voxelise(some_scan(1), np.full(2000, 700, np.float32), 40, 96).grid)
    assert np.abs(grid[..., 5]).max() < 1e-5
    np.testing.assert_allclose(unfolded(voxelise(some_scan(1), None, 40, 96).grid), grid, atol=1e-5)


def test_a_batch_says_what_is_missing():
    scans = [prepare_scan(some_scan(0), None, TINY), prepare_scan(None, None, TINY)]
    batch = pack([None, np.ones(TINY.image_size, np.float32)], scans, TINY)
    assert batch.image.shape == (2, 1, *TINY.image_size)
    assert batch.image_present.tolist() == [False, True]
    assert not batch.image[0].any() and batch.image[1].all()
    assert batch.coarse_mask.any(1).tolist() == batch.fine_mask.any(1).tolist() == [True, False]
    assert batch.grid.shape == (2, 20, 20, 20, 48) and not batch.grid[1].any()
    assert batch.fine_index.dtype == np.int64


@pytest.mark.parametrize("counts", [(30, 60), (0, 0)], ids=["short", "empty"])
def test_only_padding_is_trimmed(counts):
    scans = [prepare_scan(some_scan(row, count), None, TINY) for row, count in enumerate(counts)]
    whole = pack([None, None], scans, TINY)
    short = trimmed(whole)
    assert whole.fine_index.shape == (2, TINY.fine_voxels)
    longest = max(1, int(whole.fine_mask.sum(1).max()))
    assert short.fine_index.shape == short.fine_mask.shape == (2, longest)
    assert np.array_equal(whole.fine_index[:, :longest], short.fine_index)
    assert short.coarse_mask.sum() == whole.coarse_mask.sum()


def test_a_blank_input_has_the_shapes_of_any_other():
    full = pack([np.ones(TINY.image_size, np.float32)], [prepare_scan(None, None, TINY)], TINY)
    for empty, other in zip(blank_input(TINY), full, strict=True):
        assert empty.shape == other.shape and empty.dtype == other.dtype and not empty.any()


@pytest.mark.parametrize("shape", [(128, 192), (512, 688), (37, 53)])
def test_shrinking_keeps_the_light_and_the_places(shape):
    image = np.zeros(shape, np.uint8)
    image[: shape[0] // 2] = 120
    small = shrink(image, (64, 96))
    assert small.shape == (64, 96) and small.dtype == np.uint8
    assert small.mean() == pytest.approx(image.mean(), abs=2)
    assert small[:30].min() == 120 and small[34:].max() == 0


def test_standard_images_have_no_brightness_of_their_own():
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (64, 96)).astype(np.uint8), (0, 0), 3)
    found = prepare_image(image, TINY)
    assert found.shape == TINY.image_size and found.dtype == np.float32
    assert abs(found.mean()) < 1e-5 and 0.2 < found.std() < 1
    assert not standardise(np.full((8, 8), 77, np.uint8)).any()  # and not NaN
    assert prepare_image(None, TINY) is None


@pytest.mark.parametrize(("noise", "blank"), [(0.5, True), (1.5, True), (6.0, False)])
def test_a_covered_lens_is_told_from_a_dim_scene_by_its_contrast(noise, blank):
    rng = np.random.default_rng(0)
    image = np.clip(12 + noise * rng.standard_normal((64, 96)), 0, 255).astype(np.uint8)
    assert is_blank(image) == blank


def test_key_points_are_dealt_out_region_by_region():
    rng = np.random.default_rng(3)
    saliency, region = rng.random(300).astype(np.float32).round(2), rng.integers(0, 12, 300)
    dealt: list[int] = []
    queues = [
        sorted(np.flatnonzero((region == k) & (saliency >= 0.3)), key=lambda i: (-saliency[i], i)) for k in range(12)
    ]
    while len(dealt) < 40:
        layer = [queue.pop(0) for queue in queues if queue]
        dealt += sorted(layer, key=lambda i: (-saliency[i], i))
    found = select_salient(saliency, region, 0.3, 40)
    assert found.tolist() == sorted(dealt[:40], key=lambda i: (-saliency[i], i))


def test_regions_are_squares():
    regions = cell_regions(10, 14).reshape(10, 14)
    for value in np.unique(regions):
        rows, columns = np.nonzero(regions == value)
        assert np.ptp(rows) < 4 and np.ptp(columns) < 4
    points = np.array([[-0.1, 0.1, 0], [0.1, 0.1, 9], [-3.9, 3.9, 0], [0.1, -0.1, 0]], np.float32)
    first, second, third, fourth = ground_regions(points)
    assert first == third != second and fourth not in (first, second)
