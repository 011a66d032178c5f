"""Local heads: who attends to whom, and what padding may not change."""

from __future__ import annotations

import pytest
import torch
from tiny_worlds import TINY
from torch import nn

from umf_ros.networks.fusion import Block
from umf_ros.networks.local_features import WINDOW, CloudLocal, ImageLocal, IterativeAttention

ROWS, COLUMNS = TINY.image_size[0] // 4, TINY.image_size[1] // 4


def silence(block: Block) -> None:
    """Make a block the identity."""
    for layer in (block.attention.output, block.feedforward[-1]):
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)


def touched(head: ImageLocal, row: int, column: int) -> torch.Tensor:
    """(ROWS, COLUMNS) bool: cells whose tokens change with one cell of the map."""
    plain = torch.randn(1, TINY.local, ROWS, COLUMNS)
    marked = plain.clone()
    marked[..., row, column] += torch.randn(TINY.local)
    change = (head(marked).tokens - head(plain).tokens).norm(dim=-1)
    return change.view(ROWS, COLUMNS) > 1e-6


@pytest.mark.parametrize(("row", "column"), [(0, 0), (9, 21)])
def test_the_first_layer_attends_within_windows(row, column):
    head = ImageLocal(TINY).eval()
    silence(head.far)
    inside = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    top, left = row // WINDOW * WINDOW, column // WINDOW * WINDOW
    inside[top : top + WINDOW, left : left + WINDOW] = True
    assert torch.equal(touched(head, row, column), inside)


@pytest.mark.parametrize(("row", "column"), [(0, 0), (9, 21)])
def test_the_second_layer_attends_to_equal_places_of_all_windows(row, column):
    head = ImageLocal(TINY).eval()
    silence(head.near)
    same = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    same[row % WINDOW :: WINDOW, column % WINDOW :: WINDOW] = True
    assert torch.equal(touched(head, row, column), same)


def test_together_they_see_everything():
    assert touched(ImageLocal(TINY).eval(), 5, 17).all()


def test_cells_that_look_alike_are_told_apart_by_their_place():
    descriptors = ImageLocal(TINY).eval()(torch.ones(1, TINY.local, ROWS, COLUMNS)).descriptors[0]
    torch.testing.assert_close(descriptors.norm(dim=-1), torch.ones(ROWS * COLUMNS))
    assert torch.pdist(descriptors[:: WINDOW + 1]).min() > 1e-4


def voxels(count: int, existing: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    fine, positions = torch.randn(1, count, TINY.local), torch.randn(1, count, TINY.local)
    return fine, positions, (torch.arange(count) < existing)[None]


def test_padded_voxels_change_nothing_and_receive_nothing():
    head, (fine, positions, mask) = CloudLocal(TINY).eval(), voxels(9, 6)
    padded, cut = head(fine, positions, mask), head(fine[:, :6], positions[:, :6], mask[:, :6])
    torch.testing.assert_close(padded.descriptors[:, :6], cut.descriptors)
    torch.testing.assert_close(padded.saliency[:, :6], cut.saliency)
    assert padded.saliency[:, 6:].abs().max() == 0
    assert padded.saliency[:, :6].mean().item() == pytest.approx(1, abs=1e-4)
    loud = head(fine + 50 * ~mask[..., None], positions, mask)
    torch.testing.assert_close(loud.descriptors[:, :6], padded.descriptors[:, :6])


def test_voxels_may_come_in_any_order():
    head, (fine, positions, mask) = CloudLocal(TINY).eval(), voxels(8, 8)
    order = torch.randperm(8)
    one, two = head(fine, positions, mask), head(fine[:, order], positions[:, order], mask)
    torch.testing.assert_close(one.descriptors[:, order], two.descriptors)
    torch.testing.assert_close(one.saliency[:, order], two.saliency)


def test_what_all_attend_to_is_salient():
    """A cell whose key fits every query takes the attention that the others lose."""
    head = ImageLocal(TINY).eval()
    for block in (head.near, head.far):
        nn.init.zeros_(block.attention.query.weight)
        nn.init.constant_(block.attention.query.bias, 2.0)
        block.attention.key_value.weight.data[: TINY.local] = torch.eye(TINY.local)
        nn.init.zeros_(block.norm.weight)
        block.norm.weight.data[0] = 1.0
    fine = 0.01 * torch.randn(1, TINY.local, ROWS, COLUMNS) - head.positions.permute(2, 0, 1)
    fine[0, 0, 6, 13] += 9
    assert head(fine).saliency.argmax().item() == 6 * COLUMNS + 13


def lit(iterations: int = 3) -> IterativeAttention:
    torch.manual_seed(1)
    return IterativeAttention(inputs=8, count=4, outputs=6, iterations=iterations).eval()


def test_super_features_do_not_depend_on_the_order_of_the_features():
    tokens, everywhere, order = torch.randn(2, 10, 8), torch.ones(2, 10, dtype=torch.bool), torch.randperm(10)
    one, two = lit()(tokens, everywhere), lit()(tokens[:, order], everywhere)
    torch.testing.assert_close(one.descriptors, two.descriptors)
    torch.testing.assert_close(one.attention[..., order], two.attention)


def test_super_features_keep_their_numbers():
    """The row is the ID: the same template looks for the same thing in every frame, whatever else is there."""
    torch.manual_seed(2)
    module, here = lit(), torch.randn(1, 12, 8)
    again, elsewhere = here + 0.05 * torch.randn(1, 12, 8), torch.randn(1, 12, 8)
    everywhere = torch.ones(1, 12, dtype=torch.bool)
    one, same, other = (module(tokens, everywhere).descriptors[0] for tokens in (here, again, elsewhere))
    assert (one * same).sum(1).min() > (one * other).sum(1).max()
    assert (one @ same.T).argmax(1).tolist() == [0, 1, 2, 3]


def test_further_rounds_refine_the_super_features():
    tokens, everywhere = torch.randn(1, 10, 8), torch.ones(1, 10, dtype=torch.bool)
    once, twice, thrice = (lit(rounds)(tokens, everywhere).descriptors for rounds in (1, 2, 3))
    assert (once - twice).norm() > 1e-3 and (twice - thrice).norm() > 1e-3


def test_strength_is_the_length_before_the_normalisation():
    module = lit()
    tokens, everywhere = torch.randn(1, 10, 8), torch.ones(1, 10, dtype=torch.bool)
    before = module(tokens, everywhere)
    for parameter in module.output.parameters():
        parameter.data *= 3
    after = module(tokens, everywhere)
    torch.testing.assert_close(after.strength, 3 * before.strength)
    torch.testing.assert_close(after.descriptors, before.descriptors)


def test_a_frame_without_features_has_super_features_that_are_numbers():
    found = lit()(torch.randn(1, 5, 8), torch.zeros(1, 5, dtype=torch.bool))
    assert torch.isfinite(found.descriptors).all() and found.attention.abs().max() == 0
