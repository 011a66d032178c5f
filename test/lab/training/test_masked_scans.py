from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny_worlds import TINY

from umf_ros.embedding.inputs import voxelise
from umf_ros.lab.training.masked_objectives import (
    MaskedBatch,
    MaskedScansObjective,
    hidden_voxels,
    occupancy,
    unfold,
    voxel_ranges,
)
from umf_ros.lab.training.trainer import load_run
from umf_ros.networks.umf import UMF

RATIOS = (0.8, 0.5, 0.25)


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


def objective() -> MaskedScansObjective:
    return MaskedScansObjective(UMF(TINY), load_run(None, method="masked_scans", train="", decoder_width=16))


def grid_of(rng: np.random.Generator) -> torch.Tensor:
    full = torch.from_numpy(rng.random((2, 20, 20, 20, 6, 8)) < 0.05).float()
    return (full * full[..., :1, :]).flatten(-2)


def test_the_encoder_never_sees_a_hidden_voxel(rng: np.random.Generator) -> None:
    model = objective().eval()
    grid = grid_of(rng)
    hidden = occupancy(grid) & torch.from_numpy(rng.random((2, 20, 20, 20, 8)) < 0.6)
    without = (grid.unflatten(-1, (6, 8)) * ~hidden[..., None, :]).flatten(-2)
    loss, logits = model(MaskedBatch(grid, hidden))["total"], model.predict(MaskedBatch(grid, hidden))
    same = model.predict(MaskedBatch(without, torch.zeros_like(hidden)))
    assert torch.equal(logits, same) and logits.shape == (2, 20, 20, 20, 8)
    wanted = torch.nn.functional.binary_cross_entropy(logits.sigmoid(), occupancy(grid).float())
    assert loss.item() == pytest.approx(wanted.item(), rel=1e-3)  # hidden voxels are asked for


def test_stem_down_and_bottom_learn(rng: np.random.Generator) -> None:
    model = objective()
    grid = grid_of(rng)
    model(MaskedBatch(grid, torch.zeros_like(occupancy(grid))))["total"].backward()
    encoder = model.network.voxel_encoder
    for part in (encoder.stem, encoder.down, encoder.bottom, model.decoder):
        assert all(parameter.grad is not None for parameter in part.parameters())
