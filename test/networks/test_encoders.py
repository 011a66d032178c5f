"""The two encoders: their sizes, and that what is seen somewhere is found there."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny_worlds import TINY, some_input

from umf_ros.baselines.place_network import count_parameters
from umf_ros.networks.encoders import Backbone, FeaturePyramid, ImageEncoder, ResidualBlock, VoxelEncoder

NAMES = ("resnet18", "resnet34", "resnet50")


@pytest.mark.parametrize(("name", "published"), [("resnet18", 11_689_512), ("resnet34", 21_797_672)])
def test_the_resnets_have_the_published_parameters(name, published):
    """Less the classifier (512 x 1000 and its bias), and two of the three colours of the stem (2 x 64 x 7 x 7)."""
    assert count_parameters(Backbone(name, 64)) == published - 513_000 - 6_272


def test_the_bottleneck_resnet_has_the_published_parameters():
    assert count_parameters(Backbone("resnet50", 64)) == 25_557_032 - 2_049_000 - 6_272


@pytest.mark.parametrize("name", NAMES)
def test_stages_halve_the_resolution(name):
    backbone = Backbone(name, 8).eval()
    maps = backbone(torch.randn(2, 1, 64, 96))
    wide = 4 if name == "resnet50" else 1
    assert [tuple(found.shape) for found in maps] == [
        (2, 8 * wide, 16, 24),
        (2, 16 * wide, 8, 12),
        (2, 32 * wide, 4, 6),
        (2, 64 * wide, 2, 3),
    ]
    assert backbone.channels == [found.shape[1] for found in maps]


@pytest.mark.parametrize("bottleneck", [False, True])
def test_a_residual_block_whose_branch_is_silent_keeps_what_is_positive(bottleneck):
    block = ResidualBlock(16, 4 if bottleneck else 16, 1, bottleneck).eval()
    torch.nn.init.zeros_(block.layers[-1][1].weight)
    x = torch.randn(1, 16, 6, 6)
    torch.testing.assert_close(block(x), x.clamp(min=0))
    assert ResidualBlock(16, 8, 2, bottleneck)(x).shape == (1, 32 if bottleneck else 8, 3, 3)


def test_the_pyramid_adds_coarse_context_to_fine_places():
    """With ones for every weight a single deep cell spreads over its sixteen fine ones, and stays in its corner."""
    pyramid = FeaturePyramid([1, 1, 1, 1], 1, 1, 1).eval()
    for name, parameter in pyramid.named_parameters():
        torch.nn.init.constant_(parameter, 1.0 if name.startswith("laterals") and name.endswith("weight") else 0.0)
    for head in (pyramid.coarse, pyramid.fine):
        head.weight.data[0, 0, 1, 1] = 1
    maps = [torch.zeros(1, 1, 32 // 2**level, 48 // 2**level) for level in range(4)]
    maps[3][0, 0, 0, 5] = 1
    maps[0][0, 0, 31, 0] = 5
    coarse, fine = pyramid(maps)
    assert coarse.shape == (1, 1, 8, 12) and fine.shape == (1, 1, 32, 48)
    row, column = divmod(int(coarse.argmax()), 12)
    assert row in (0, 1) and column in (10, 11)
    assert fine[0, 0, 31, 0] == 5 and fine[0, 0, 2, 43] > 0.5
    assert fine[0, 0, :16, :24].max() == 0


@pytest.mark.parametrize(("row", "column"), [(20, 28), (44, 28), (20, 68), (44, 68)])
@pytest.mark.parametrize("name", ["resnet18", "resnet50"])
def test_both_maps_show_a_spot_where_it_is(name, row, column):
    encoder = ImageEncoder(replace(TINY, backbone=name)).eval()
    plain = torch.zeros(1, 1, 64, 96)
    marked = plain.clone()
    marked[..., row - 4 : row + 4, column - 4 : column + 4] = 5
    for before, after, stride in zip(encoder(plain), encoder(marked), (16, 4), strict=True):
        change = (after - before).detach().norm(dim=1)[0] ** 4  # an untrained encoder spreads a little everywhere
        weight = change / change.sum()
        rows, columns = (torch.arange(side) * stride + stride / 2 for side in change.shape)
        assert float((weight.sum(1) * rows).sum()) == pytest.approx(row, abs=14)
        assert float((weight.sum(0) * columns).sum()) == pytest.approx(column, abs=14)


@pytest.fixture
def encoder() -> VoxelEncoder:
    return VoxelEncoder(TINY).eval()


def test_voxels_are_described_one_by_one(encoder):
    """Other requested features and their order change nothing."""
    batch = some_input()
    coarse, fine = encoder(batch.grid, batch.coarse_index, batch.fine_index)
    assert coarse.shape == (2, TINY.coarse_voxels, TINY.tokens) and fine.shape == (2, TINY.fine_voxels, TINY.local)
    some = torch.tensor([7, 3, 11])
    few_coarse, few_fine = encoder(batch.grid, batch.coarse_index[:, some], batch.fine_index[:, some])
    torch.testing.assert_close(few_coarse, coarse[:, some])
    torch.testing.assert_close(few_fine, fine[:, some])


def test_children_of_one_cell_differ_by_place_and_by_measurement(encoder):
    empty = torch.zeros(1, 20, 20, 20, 48)
    children = torch.tensor([[(4 * 40 + 6) * 40 + 8, (4 * 40 + 6) * 40 + 9, (5 * 40 + 7) * 40 + 9]])
    none = torch.zeros(1, 1, dtype=torch.long)
    _, fine = encoder(empty, none, children)
    assert torch.pdist(fine[0]).min() > 1e-3  # the same context, another place in it
    marked = empty.clone()
    marked[0, 2, 3, 4, 8 * torch.arange(6) + 1] = 1.0  # the second child's six features
    change = (encoder(marked, none, children)[1] - fine)[0].norm(dim=1)
    assert change[1] > 1.5 * max(change[0], change[2])


def test_a_rock_changes_the_coarse_tokens_around_it_most(encoder):
    plain = torch.zeros(1, 20, 20, 20, 48)
    marked = plain.clone()
    marked[0, 4:6, 12:14, 8:10] = 2.0
    every = torch.arange(1000)[None]
    none = torch.zeros(1, 1, dtype=torch.long)
    change = (encoder(marked, every, none)[0] - encoder(plain, every, none)[0])[0].norm(dim=1)
    cell = int(change.argmax())
    found = torch.tensor([cell // 100, cell // 10 % 10, cell % 10])
    assert (found - torch.tensor([2, 6, 4])).abs().max() <= 1
