"""How the losses of a batch are added up, and what they are compared with."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_worlds import TINY, pose_at

from umf_ros.lab.datasets.sample import Places, Rule, places_of
from umf_ros.lab.datasets.views import Augmentation, ViewMaker
from umf_ros.lab.training.batches import BatchMaker, PairSampler, TrainingBatch
from umf_ros.lab.training.losses import Bank, MetricLoss, attenuate, neighbourhood_components, relate
from umf_ros.lab.training.networks import MetricSettings
from umf_ros.lab.training.trainer import load_run
from umf_ros.networks.umf import UMF

RULE = Rule(positive_m=5)


def places(*metres: float, world: int = 0) -> Places:
    return places_of(world, np.stack([pose_at(x, 0) for x in metres]))


def test_a_bank_forgets_the_oldest():
    bank = Bank(5, 2)
    for step in range(4):
        bank.add(torch.full((2, 2), float(step)), places(10.0 * step, 10.0 * step + 1, world=step))
    assert bank.descriptors[:, 0].tolist() == [1, 2, 2, 3, 3]
    assert bank.places.world.tolist() == [1, 2, 2, 3, 3]
    assert bank.places.position[:, 0].tolist() == [11, 20, 21, 30, 31]
    again = Bank(5, 2)
    again.restore(bank.state())
    assert torch.equal(again.descriptors, bank.descriptors)
    np.testing.assert_array_equal(again.places.position, bank.places.position)


def test_a_bank_keeps_numbers_and_no_gradients():
    bank, descriptors = Bank(4, 2), torch.ones(2, 2, requires_grad=True, dtype=torch.float64)
    bank.add(descriptors, places(0, 1))
    assert not bank.descriptors.requires_grad and bank.descriptors.dtype == torch.float32
    none = Bank(0, 2)
    none.add(descriptors, places(0, 1))
    assert none.descriptors.shape == (0, 2) and len(none.places.world) == 0


def test_relations_to_the_batch_and_to_the_bank():
    found = relate(places(0, 3, 100), places(1, 300), RULE, torch.device("cpu"))
    assert found.positive.tolist() == [
        [False, True, False, True, False],
        [True, False, False, True, False],
        [False, False, False, False, False],
    ]
    assert found.negative[0].tolist() == [False, False, True, False, True]
    assert found.comparable.tolist() == (~np.eye(3, dtype=bool)).tolist()
    assert found.metres[0].tolist() == [0, 3, 100]


def test_attenuation_keeps_the_value_and_a_share_of_the_gradient():
    x = torch.tensor([3.0], requires_grad=True)
    found = attenuate(x, 0.25)
    (found**2).sum().backward()
    assert found.item() == 3 and x.grad.item() == pytest.approx(0.25 * 6)


@pytest.fixture
def batch(world) -> TrainingBatch:
    pairs = PairSampler([world], RULE).draw(4, np.random.default_rng(0))
    return BatchMaker([world], ViewMaker(TINY, Augmentation()), 2, 32).make(pairs, np.random.default_rng(0))


def settings(**chosen: object) -> MetricSettings:
    return load_run(None, train="worlds", **chosen)


YES = torch.ones(8, dtype=torch.bool)


def evaluate(
    batch: TrainingBatch, chosen: MetricSettings, image=YES, cloud=YES, bank: Bank | None = None
) -> tuple[UMF, dict[str, torch.Tensor]]:
    torch.manual_seed(0)
    network = UMF(TINY).eval()
    kept = replace(batch, image_kept=image, cloud_kept=cloud)
    losses, fused = MetricLoss(TINY, chosen, RULE)(network, kept, bank or Bank(0, TINY.descriptor))
    assert fused.shape == (8, TINY.descriptor)
    return network, losses


def test_the_total_is_the_weighted_sum(batch):
    weights = {"weight_image": 0.3, "weight_cloud": 0.7, "weight_graded": 2.0, "weight_local": 0.5, "weight_super": 0.2}
    _, found = evaluate(batch, settings(**weights))
    wanted = found["fused"] + 0.3 * found["image"] + 0.7 * found["cloud"] + 2.0 * found["graded"]
    wanted = wanted + 0.5 * (found["cells"] + found["voxels"] + found["wasted"]) + 0.2 * found["super"]
    assert found["total"].item() == pytest.approx(wanted.item(), rel=1e-5)
    assert all(math.isfinite(value.item()) and value.item() >= 0 for value in found.values())


def test_heads_that_are_not_wanted_are_not_asked(batch):
    _, found = evaluate(batch, settings(weight_super=0))
    assert "super" not in found and "cells" in found
    _, plain = evaluate(replace(batch, local_rows=batch.local_rows[:0]), settings())
    assert set(plain) == {"fused", "image", "cloud", "graded", "total", "active"}


def test_neighbours_are_sought_in_other_passes_and_the_near_ones_first(batch):
    plain = replace(batch, local_rows=batch.local_rows[:0])
    rule = Rule(positive_m=20, negative_m=30, between_passes=True)
    metres = torch.tensor([0, 0, 100, 150, 4, 15, 102, 400.0])
    position = np.stack([metres.numpy(), np.zeros(8)], axis=1)
    passage = np.array([0, 0, 0, 1, 1, 1, 1, 0])
    places = Places(np.zeros(8, int), position, np.zeros(8), passage)
    torch.manual_seed(0)
    network = UMF(TINY).eval()
    chosen = settings(loss="neighbourhood", bank=0)
    moved = replace(plain, places=places, image_kept=YES, cloud_kept=YES)
    found, fused = MetricLoss(TINY, chosen, rule)(network, moved, Bank(0, TINY.descriptor))
    apart = (metres[:, None] - metres).abs()
    other = torch.from_numpy(passage[:, None] != passage)
    right, wrong = (apart < 20) & other, (apart > 30) & other
    wanted = neighbourhood_components(fused @ fused.T, right, wrong)
    assert right.any() and found["fused"].item() == pytest.approx(wanted.item(), rel=1e-5)
    graded = neighbourhood_components(fused @ fused.T, right & (apart < 5), right & (apart >= 5))
    assert graded.item() > 0 and found["graded"].item() == pytest.approx(graded.item(), rel=1e-5)


def test_a_missing_image_has_no_part_in_the_image_loss(batch):
    """Not even by what stands in its place."""
    there = torch.tensor([True] * 6 + [False] * 2)
    other = batch.input.image.clone()
    other[6:] = torch.randn(other[6:].shape)
    plain = replace(batch, input=batch.input._replace(image_present=there), local_rows=batch.local_rows[:0])
    changed = replace(plain, input=plain.input._replace(image=other))
    whole = replace(plain, input=batch.input)
    found = [evaluate(some, settings(), image=there)[1]["image"].item() for some in (plain, changed, whole)]
    assert found[0] == pytest.approx(found[1], rel=1e-6)
    assert abs(found[0] - found[2]) > 1e-4


def test_each_modality_learns_alone_whatever_the_fused_descriptor_loses(batch):
    """Modality dropout is for the fused descriptor; an image's own needs every image, and no scan."""
    plain = replace(batch, local_rows=batch.local_rows[:0])
    half = torch.tensor([True, False] * 4)
    _, whole = evaluate(plain, settings())
    _, dropped = evaluate(plain, settings(), image=half)
    assert whole["image"].item() == dropped["image"].item() and whole["cloud"].item() == dropped["cloud"].item()
    assert whole["fused"].item() != dropped["fused"].item()
    other = replace(plain, input=plain.input._replace(grid=plain.input.grid.roll(1, 0)))
    _, shuffled = evaluate(other, settings())
    assert shuffled["image"].item() == pytest.approx(whole["image"].item(), rel=1e-5)
    assert shuffled["cloud"].item() != whole["cloud"].item()


def test_an_image_is_not_pulled_towards_a_scan(batch):
    """Anchors keep their image alone, their partners the scan alone: no pair has anything in common."""
    plain = replace(batch, local_rows=batch.local_rows[:0])
    anchors = torch.tensor([True] * 4 + [False] * 4)
    _, found = evaluate(plain, settings(loss="triplet"), image=anchors, cloud=~anchors)
    assert found["fused"].item() == 0


def test_a_frame_with_nothing_in_common_has_no_rank_by_distance(batch):
    """The first frame keeps its image alone, all others the scan alone: where it was taken orders nothing."""
    plain = replace(batch, local_rows=batch.local_rows[:0])
    moved = batch.places.position + np.array([[25.0, 0]] + [[0, 0]] * 7)
    elsewhere = replace(plain, places=replace(batch.places, position=moved))
    lonely = torch.tensor([True] + [False] * 7)
    found = [evaluate(some, settings(), lonely, ~lonely)[1]["graded"].item() for some in (plain, elsewhere)]
    assert found[0] == found[1] > 0
    whole = [evaluate(some, settings())[1]["graded"].item() for some in (plain, elsewhere)]
    assert whole[0] != whole[1]


def test_a_bank_of_lookalikes_raises_the_loss(batch):
    """Descriptors of other worlds that look like the anchors must be pushed away."""
    plain = replace(batch, local_rows=batch.local_rows[:0])
    network, without = evaluate(plain, settings())
    descriptors = network(batch.input).descriptor
    elsewhere = replace(batch.places, world=batch.places.world + 100)
    bank = Bank(100, TINY.descriptor)
    bank.add(descriptors, elsewhere)
    _, found = evaluate(plain, settings(), bank=bank)
    assert found["fused"].item() > without["fused"].item()
    assert found["image"].item() == pytest.approx(without["image"].item())  # the halves have no bank


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_local_losses_reach_the_encoders_as_far_as_they_may(batch, share):
    network, found = evaluate(batch, settings(local_gradient=share))
    (found["cells"] + found["voxels"]).backward()
    for encoder in (network.image_encoder, network.voxel_encoder):
        reached = [value.grad is not None and bool(value.grad.any()) for value in encoder.parameters()]
        assert any(reached) == (share > 0)
    assert network.image_local.descriptor.weight.grad.any() and network.cloud_local.descriptor.weight.grad.any()


def test_triplets_tell_how_many_are_active(batch):
    _, found = evaluate(batch, settings(loss="triplet"))
    assert 0 <= found["active"].item() <= 1
    _, always = evaluate(batch, settings(loss="multi_similarity"))
    assert always["active"].item() == 1
