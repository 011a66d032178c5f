"""Attention, its masks, and what it says of where it looked."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from umf_ros.networks.fusion import Attention, Block, received


@pytest.fixture
def mask() -> torch.Tensor:
    return torch.tensor([[True, True, False, True, True], [True, False, False, False, False]])


def test_it_is_the_attention_of_the_textbook(mask):
    """The same weights in torch's own layer give the same tokens and the same maps."""
    ours, textbook = Attention(12, 3), nn.MultiheadAttention(12, 3, batch_first=True)
    textbook.in_proj_weight.data = torch.cat([ours.query.weight, ours.key_value.weight]).data
    textbook.in_proj_bias.data = torch.cat([ours.query.bias, ours.key_value.bias]).data
    textbook.out_proj.load_state_dict(ours.output.state_dict())
    queries, keys = torch.randn(2, 4, 12), torch.randn(2, 5, 12)
    found, maps = ours(queries, keys, mask)
    wanted, wanted_maps = textbook(queries, keys, keys, key_padding_mask=~mask, average_attn_weights=False)
    torch.testing.assert_close(found, wanted)
    torch.testing.assert_close(maps, wanted_maps)


def test_keys_may_come_in_any_order(mask):
    attention, order = Attention(8, 2), torch.tensor([3, 0, 4, 2, 1])
    queries, keys = torch.randn(2, 4, 8), torch.randn(2, 5, 8)
    found, maps = attention(queries, keys, mask)
    shuffled, shuffled_maps = attention(queries, keys[:, order], mask[:, order])
    torch.testing.assert_close(found, shuffled)
    torch.testing.assert_close(maps[..., order], shuffled_maps)


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_masks_hold_in_half_precision(mask, kind):
    attention = Attention(8, 2).to(kind)
    _, maps = attention(torch.randn(2, 4, 8).to(kind), torch.randn(2, 5, 8).to(kind), mask)
    assert torch.isfinite(maps).all()
    assert maps.masked_select(~mask[:, None, None].expand_as(maps)).abs().max() == 0


def test_a_block_starts_as_the_identity_when_its_branches_are_silent():
    block = Block(8, 2, 16, cross=True)
    for layer in (block.attention.output, block.feedforward[-1]):
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)
    tokens = torch.randn(2, 4, 8)
    torch.testing.assert_close(block(tokens, torch.randn(2, 5, 8))[0], tokens)


def test_a_block_treats_its_tokens_alike():
    block, order = Block(8, 2, 16), torch.tensor([2, 0, 3, 1])
    tokens = torch.randn(1, 4, 8)
    torch.testing.assert_close(block(tokens)[0][:, order], block(tokens[:, order])[0])


def test_cross_attention_hears_the_keys_that_exist_and_no_others(mask):
    block, tokens, keys = Block(8, 2, 16, cross=True), torch.randn(2, 4, 8), torch.randn(2, 5, 8)
    plain, maps = block(tokens, keys, mask)
    assert maps.shape == (2, 2, 4, 5)
    noise = keys + 3 * ~mask[..., None]
    torch.testing.assert_close(block(tokens, noise, mask)[0], plain)
    assert (block(tokens, keys + 3 * mask[..., None] * torch.randn(8), mask)[0] - plain).norm() > 1e-3


def test_what_keys_receive_is_the_fair_share_on_average(mask):
    maps = torch.randn(2, 3, 5, 5).masked_fill(~mask[:, None, None], -1e4).softmax(-1)
    found = received(maps, mask, mask)
    assert found.shape == (2, 5) and found.dtype == torch.float32
    torch.testing.assert_close(found.sum(1), mask.sum(1).float())
    assert found[~mask].abs().max() < 1e-6
    torch.testing.assert_close(received(torch.rand(1, 2, 4, 6).softmax(-1)).mean(), torch.tensor(1.0))


def test_queries_that_do_not_exist_have_no_say():
    maps = torch.tensor([[[[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]]])
    two = torch.tensor([[True, True, False]])
    torch.testing.assert_close(received(maps, two, two), torch.tensor([[1.0, 1.0, 0.0]]))
    nobody = torch.zeros(1, 3, dtype=torch.bool)
    assert received(maps, nobody, nobody).abs().max() == 0
