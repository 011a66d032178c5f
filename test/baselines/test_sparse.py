"""Sparse convolutions against dense ones."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from umf_ros.baselines.minkloc import Around, Down, Level, SparseGem, Up

SIZE, CHANNELS = 8, 3


@pytest.fixture
def level() -> Level:
    torch.manual_seed(0)
    flat = torch.randperm(2 * SIZE**3)[:120].sort().values
    cells = torch.stack([flat // SIZE**3, flat // SIZE**2 % SIZE, flat // SIZE % SIZE, flat % SIZE], 1)
    return Level(cells, SIZE, 2)


def dense(features: torch.Tensor, level: Level) -> torch.Tensor:
    grid = torch.zeros(level.batch, features.shape[1], *[level.size] * 3)
    frame, x, y, z = level.cells.T
    grid[frame, :, x, y, z] = features
    return grid


def at(grid: torch.Tensor, level: Level) -> torch.Tensor:
    frame, x, y, z = level.cells.T
    return grid[frame, :, x, y, z]


@pytest.mark.parametrize("kernel", [3, 5])
def test_a_convolution_does_what_a_dense_one_does_where_something_is(level: Level, kernel: int) -> None:
    features, layer = torch.randn(120, CHANNELS), Around(CHANNELS, 4, kernel)
    weight = layer.linear.weight.view(4, kernel, kernel, kernel, CHANNELS).permute(0, 4, 1, 2, 3)
    wanted = at(F.conv3d(dense(features, level), weight, padding=kernel // 2), level)
    torch.testing.assert_close(layer(features, level), wanted)


def test_down_and_up_are_convolutions_of_stride_two(level: Level) -> None:
    features, down, up = torch.randn(120, CHANNELS), Down(CHANNELS, 4), Up(4, 5)
    weight = down.linear.weight.view(4, 2, 2, 2, CHANNELS).permute(0, 4, 1, 2, 3)
    smaller = down(features, level)
    torch.testing.assert_close(smaller, at(F.conv3d(dense(features, level), weight, stride=2), level.half))
    back = up.linear.weight.view(2, 2, 2, 5, 4).permute(4, 3, 0, 1, 2)
    torch.testing.assert_close(
        up(smaller, level), at(F.conv_transpose3d(dense(smaller, level.half), back, stride=2), level)
    )


def test_the_generalised_mean_lies_between_mean_and_maximum(level: Level) -> None:
    features = torch.rand(120, CHANNELS) + 0.1
    found = SparseGem(3.0)(features, level)
    for frame in range(2):
        own = features[level.cells[:, 0] == frame]
        torch.testing.assert_close(found[frame], own.pow(3).mean(0).pow(1 / 3))
    empty = SparseGem()(features[:0], Level(level.cells[:0], SIZE, 2))
    assert torch.equal(empty, torch.zeros(2, CHANNELS))
