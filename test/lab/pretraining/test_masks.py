from __future__ import annotations

import numpy as np
import pytest
import torch

from umf_ros.embedding.voxels import voxelise
from umf_ros.lab.training.pretraining.cloud import occupancy
from umf_ros.lab.training.pretraining.masks import hidden_voxels, unfold, visible_patches, voxel_ranges

RATIOS = (0.8, 0.5, 0.25)


def test_exactly_the_wanted_share_of_every_image_is_hidden(rng: np.random.Generator) -> None:
    visible = visible_patches(50, (128, 160), 0.6, rng)
    assert visible.shape == (50, 1, 4, 5)
    assert (visible.flatten(1).sum(1) == 8).all()
    assert visible.float().mean(0).min() > 0.2 and visible.float().mean(0).max() < 0.65  # no place is preferred


def test_a_patch_at_least_stays_visible(rng: np.random.Generator) -> None:
    assert visible_patches(3, (64, 64), 0.99, rng).flatten(1).sum(1).tolist() == [1, 1, 1]


def test_unfolding_puts_every_voxel_where_its_points_are() -> None:
    points = np.array([[0.5, -19.5, -5.9], [10.5, 0.5, 0.1], [39.5, 19.5, 5.9]], np.float32)
    scan = voxelise(np.repeat(points, 10, axis=0), None, 16, 16)
    grid = unfold(occupancy(torch.from_numpy(scan.grid)[None]))[0]
    assert torch.nonzero(grid).tolist() == [[0, 0, 0], [10, 20, 20], [39, 39, 39]]


def test_ranges_are_those_of_the_voxels() -> None:
    ranges = unfold(torch.from_numpy(voxel_ranges().copy())[None])[0]
    assert ranges[3, 24, 7] == pytest.approx(np.hypot(3.5, 4.5))
    assert ranges[39, 0, 0] == pytest.approx(np.hypot(39.5, -19.5))


def test_less_is_hidden_in_the_distance(rng: np.random.Generator) -> None:
    occupied = torch.from_numpy(rng.random((3, 20, 20, 20, 8)) < 0.05)
    hidden = hidden_voxels(occupied, RATIOS, rng)
    assert not (hidden & ~occupied).any()
    ranges = torch.from_numpy(voxel_ranges().copy())
    for low, high, ratio in zip((0, 15, 30), (15, 30, 99), RATIOS, strict=True):
        ring = (ranges >= low) & (ranges < high)
        for row in range(3):
            members = int((occupied[row] & ring).sum())
            assert members > 100
            assert int((hidden[row] & ring).sum()) == round(ratio * members)


def test_an_empty_scan_hides_nothing(rng: np.random.Generator) -> None:
    assert not hidden_voxels(torch.zeros(1, 20, 20, 20, 8, dtype=torch.bool), RATIOS, rng).any()


def test_masks_follow_from_the_generator() -> None:
    occupied = torch.ones(1, 20, 20, 20, 8, dtype=torch.bool)
    one, same, other = (hidden_voxels(occupied, RATIOS, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)
