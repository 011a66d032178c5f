"""Fusion of tokens: absent modalities, pooling, and the union of both halves."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny_worlds import TINY, some_input

from umf_ros.networks.fusion import AbsentToken, Fused, Fusion, GeneralisedMean, Tokens

YES, NO = torch.ones(2, dtype=torch.bool), torch.zeros(2, dtype=torch.bool)


def tokens(count: int, existing: int) -> Tokens:
    mask = (torch.arange(count) < existing).expand(2, count)
    return Tokens(torch.randn(2, count, TINY.tokens), mask)


def fuse(
    fusion: Fusion, image: Tokens, cloud: Tokens, image_present: torch.Tensor, cloud_present: torch.Tensor
) -> Fused:
    return fusion.describe(*fusion.pool(image, cloud), image_present, cloud_present)


def test_a_missing_row_becomes_the_learned_token_and_the_others_stay():
    absent, given = AbsentToken(TINY.tokens), tokens(5, 4)
    found = absent(given, torch.tensor([True, False]))
    assert torch.equal(found.values[0], given.values[0]) and torch.equal(found.mask[0], given.mask[0])
    assert found.mask[1].tolist() == [True, False, False, False, False]
    assert torch.equal(found.values[1, 0], absent.token)


@pytest.mark.parametrize(("exponent", "wanted"), [(1.0, 7 / 3), (2.0, (21 / 3) ** 0.5), (3.0, (73 / 3) ** (1 / 3))])
def test_generalised_mean_by_hand(exponent, wanted):
    pool = GeneralisedMean(exponent)
    values = torch.tensor([[[1.0], [2.0], [4.0], [50.0]]])
    assert pool(Tokens(values, torch.tensor([[True, True, True, False]]))).item() == pytest.approx(wanted, rel=1e-5)


def test_a_large_exponent_takes_the_strongest_and_negative_values_count_nothing():
    values = torch.tensor([[[1.0, -3.0], [2.0, -1.0]]])
    everywhere = torch.ones(1, 2, dtype=torch.bool)
    found = GeneralisedMean(8.0)(Tokens(values, everywhere))[0]
    assert 1.8 < found[0] < 2.0
    assert 0 < found[1] < 0.01


def test_the_exponent_learns_even_where_tokens_are_not_positive():
    pool = GeneralisedMean()
    pool(Tokens(torch.tensor([[[-1.0, 0.5], [-2.0, 3.0]]]), torch.ones(1, 2, dtype=torch.bool))).sum().backward()
    assert torch.isfinite(pool.exponent.grad) and pool.exponent.grad != 0


def test_the_order_of_the_tokens_does_not_matter_to_the_descriptor():
    fusion, image, cloud = Fusion(TINY).eval(), tokens(6, 6), tokens(7, 5)
    order = torch.tensor([4, 2, 6, 0, 1, 5, 3])
    shuffled = Tokens(cloud.values[:, order], cloud.mask[:, order])
    one, two = fuse(fusion, image, cloud, YES, YES), fuse(fusion, image, shuffled, YES, YES)
    torch.testing.assert_close(one.descriptor, two.descriptor)
    torch.testing.assert_close(one.weights, two.weights)


def test_padding_does_not_matter_to_the_descriptor():
    fusion, image, cloud = Fusion(TINY).eval(), tokens(6, 6), tokens(7, 5)
    cut = Tokens(cloud.values[:, :5], cloud.mask[:, :5])
    loud = Tokens(cloud.values + 100 * ~cloud.mask[..., None], cloud.mask)
    wanted = fuse(fusion, image, cut, YES, YES).descriptor
    torch.testing.assert_close(fuse(fusion, image, loud, YES, YES).descriptor, wanted)


def test_the_descriptor_is_its_halves_by_their_weights():
    found = fuse(Fusion(TINY).eval(), tokens(6, 6), tokens(7, 7), YES, YES)
    half = TINY.descriptor // 2
    torch.testing.assert_close(found.descriptor[:, :half], found.image * found.weights[:, :1].sqrt())
    torch.testing.assert_close(found.descriptor[:, half:], found.cloud * found.weights[:, 1:].sqrt())
    # so that the similarity of two whole frames is a weighted mean of the similarities of their halves
    torch.testing.assert_close(found.descriptor.norm(dim=1), torch.ones(2))


@pytest.mark.parametrize(
    ("image", "cloud", "wanted"), [(YES, NO, [1.0, 0.0]), (NO, YES, [0.0, 1.0])], ids=["image", "cloud"]
)
def test_a_single_modality_carries_all_the_weight(image, cloud, wanted):
    found = fuse(Fusion(TINY).eval(), tokens(6, 6), tokens(7, 7), image, cloud)
    torch.testing.assert_close(found.weights, torch.tensor([wanted, wanted]))


def test_gradients_stay_finite_with_a_missing_modality():
    fusion = Fusion(TINY)
    fuse(fusion, tokens(6, 6), tokens(7, 1), torch.tensor([True, False]), torch.tensor([False, True])).descriptor[
        :, 3
    ].sum().backward()
    assert all(torch.isfinite(value.grad).all() for value in fusion.parameters() if value.grad is not None)


def test_frames_of_a_batch_do_not_meet(network):
    both = some_input(count=3)
    alone = type(both)(*(values[1:2] for values in both))
    torch.testing.assert_close(network(both).descriptor[1:2], network(alone).descriptor, atol=1e-5, rtol=1e-4)


def test_what_is_masked_changes_nothing_in_any_layer():
    fusion = Fusion(replace(TINY, layers=3)).eval()
    image, cloud = tokens(6, 6), tokens(7, 5)
    noisy = Tokens(cloud.values.clone(), cloud.mask)
    noisy.values[:, 5:] = 9.0
    found, same = fuse(fusion, image, cloud, YES, YES), fuse(fusion, image, noisy, YES, YES)
    torch.testing.assert_close(found.descriptor, same.descriptor)
