from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny_worlds import TINY, some_input

from umf_ros.lab.training.batches import trimmed
from umf_ros.networks.config import NetworkConfig
from umf_ros.networks.umf import UMF, channels_last


def test_shapes_and_norms(network):
    found = network(some_input(TINY), super_features=True)
    assert found.descriptor.shape == (2, 16)
    assert found.image.descriptors.shape == (2, 16 * 24, 8)
    assert found.cloud.descriptors.shape == (2, 96, 8)
    assert found.super_image.descriptors.shape == (2, 6, 8)
    assert found.super_cloud.attention.shape == (2, 5, 96)
    for vectors in (found.descriptor, found.image.descriptors, found.super_image.descriptors):
        torch.testing.assert_close(vectors.norm(dim=-1), torch.ones(vectors.shape[:-1]))


def test_a_landmark_moved_sideways_changes_the_descriptor(network):
    """The reference averages the image's columns and cannot see this."""
    batch = some_input(TINY)
    left, right = torch.zeros_like(batch.image), torch.zeros_like(batch.image)
    left[..., 24:40, 16:32] = 3
    right[..., 24:40, 64:80] = 3
    moved = (network(batch._replace(image=left)).descriptor - network(batch._replace(image=right)).descriptor).norm()
    assert moved > 1e-3


def test_a_rock_moved_sideways_changes_the_descriptor(network):
    batch = some_input(TINY)
    mirrored = batch._replace(grid=batch.grid.flip(2))
    assert (network(batch).descriptor - network(mirrored).descriptor).norm() > 1e-4


@pytest.mark.parametrize(("backbone", "blocks"), [("resnet18", 0), ("resnet34", 2), ("resnet50", 1)])
def test_every_parameter_learns(backbone, blocks):
    """The reference's optimiser forgets its heads."""
    network = UMF(replace(TINY, backbone=backbone, voxel_blocks=blocks)).train()
    batch = some_input(TINY, 3)
    features = network.encode(batch)
    fused = network.fuse(features, torch.tensor([True, True, False]), torch.tensor([True, False, True])).descriptor
    image, cloud = network.describe_local(features, batch)
    supers = network.super_image(image.tokens, image.mask), network.super_cloud(cloud.tokens, cloud.mask)
    parts = [fused, image.descriptors, cloud.descriptors, *(found.descriptors for found in supers)]
    generator = torch.Generator().manual_seed(0)
    sum((part * torch.randn(part.shape, generator=generator)).sum() for part in parts).backward()
    idle = [name for name, value in network.named_parameters() if value.grad is None or not value.grad.abs().any()]
    # a bias before a softmax over keys is the one thing attention cannot feel
    assert [name for name in idle if not name.endswith("key_value.bias")] == []


def test_trimmed_padding_changes_nothing(network):
    full, short = network(some_input(TINY)), network(trimmed(some_input(TINY)))
    torch.testing.assert_close(full.descriptor, short.descriptor, atol=1e-5, rtol=1e-4)


def test_a_missing_modality_counts_nothing(network):
    features = network.encode(some_input(TINY))
    yes, no = torch.ones(2, dtype=torch.bool), torch.zeros(2, dtype=torch.bool)
    whole, seen, felt = (
        network.fuse(features, yes, yes),
        network.fuse(features, yes, no),
        network.fuse(features, no, yes),
    )
    assert seen.descriptor[:, 8:].abs().max() < 1e-5
    assert felt.descriptor[:, :8].abs().max() < 1e-5
    torch.testing.assert_close(whole.weights.sum(-1), torch.ones(2))
    torch.testing.assert_close(seen.weights, torch.tensor([[1.0, 0.0], [1.0, 0.0]]))
    # similarity to a whole frame is that of the half both have, times its share there
    half = (seen.image @ whole.image.T) * whole.weights[:, 0].sqrt()
    torch.testing.assert_close(seen.descriptor @ whole.descriptor.T, half, atol=1e-5, rtol=1e-4)


def test_each_modality_is_told_of_the_other(network):
    features = network.encode(some_input(TINY))
    yes, no = torch.ones(2, dtype=torch.bool), torch.zeros(2, dtype=torch.bool)
    together, alone = network.fuse(features, yes, yes), network.fuse(features, yes, no)
    assert (together.image - alone.image).norm() > 1e-4


def test_the_content_of_a_missing_modality_does_not_matter(network):
    batch = some_input(TINY)
    dark = batch._replace(image_present=torch.zeros(2, dtype=torch.bool))
    other = dark._replace(image=torch.randn(dark.image.shape))
    torch.testing.assert_close(network(dark).descriptor, network(other).descriptor)


def test_nothing_at_all_is_still_a_number(network):
    batch = some_input(TINY)
    empty = batch._replace(
        image_present=torch.zeros(2, dtype=torch.bool),
        grid=torch.zeros_like(batch.grid),
        coarse_mask=torch.zeros_like(batch.coarse_mask),
        fine_mask=torch.zeros_like(batch.fine_mask),
    )
    found = network(empty, super_features=True)
    assert torch.isfinite(found.descriptor).all()
    assert not found.cloud.saliency.any()
    assert torch.isfinite(found.super_cloud.descriptors).all()


def test_memory_order_of_the_weights_changes_nothing(network):
    batch = some_input(TINY)
    before = network(batch).descriptor
    channels_last(network)
    torch.testing.assert_close(before, network(batch).descriptor, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("wrong", [{"image_size": (100, 128)}, {"tokens": 30, "heads": 4}])
def test_impossible_sizes_are_refused(wrong):
    with pytest.raises(ValueError, match="multiple"):
        NetworkConfig(**wrong)


def test_the_heads_do_not_depend_on_the_input_size(network):
    """Weights trained at one image size serve another."""
    larger = UMF(replace(TINY, image_size=(96, 128))).eval()
    larger.load_state_dict(network.state_dict())
    found = larger(some_input(larger.config), super_features=True)
    assert found.image.descriptors.shape == (2, 24 * 32, 8)
    assert found.descriptor.shape == (2, 16) and found.super_image.descriptors.shape == (2, 6, 8)


def test_half_precision_says_nearly_the_same(network):
    batch = some_input(TINY)
    whole = network(batch)
    with torch.autocast("cpu", torch.bfloat16):
        half = network(batch)
    assert (whole.descriptor * half.descriptor).sum(1).min() > 0.99
    assert half.descriptor.dtype == half.image.descriptors.dtype == torch.float32


def test_super_features_are_only_made_when_asked_for(network):
    found = network(some_input(TINY))
    assert found.super_image is None and found.super_cloud is None


def test_cells_are_told_apart_by_their_place_where_nothing_else_differs(network):
    batch = some_input(TINY, 1)
    empty = batch._replace(grid=torch.zeros_like(batch.grid), image=torch.zeros_like(batch.image))
    features = network.encode(empty)
    assert torch.equal(features.cloud.mask, batch.coarse_mask) and features.image.mask.all()
    assert torch.pdist(features.image.values[0].detach()).min() > 0.05
    assert torch.pdist(features.cloud.values[0, batch.coarse_mask[0]].detach()).min() > 0.05
