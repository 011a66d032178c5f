from __future__ import annotations

import torch
from tiny_worlds import TINY

from umf_ros.networks.encoders import parent_and_child, take
from umf_ros.networks.fusion import cell_positions, received, sine_encoding
from umf_ros.networks.local_features import ImageLocal, IterativeAttention


def test_every_cell_has_its_own_code():
    for positions in (cell_positions(6, 8), cell_positions(10, 10, 10)):
        codes = sine_encoding(positions, 64)
        distance = torch.cdist(codes, codes) + 10 * torch.eye(len(codes))
        assert distance.min() > 0.05


def test_near_cells_have_nearer_codes():
    codes = sine_encoding(torch.tensor([[0.1, 0.5], [0.15, 0.5], [0.9, 0.5]]), 64)
    assert (codes[0] - codes[1]).norm() < (codes[0] - codes[2]).norm()


def test_even_attention_is_the_fair_share():
    even = torch.full((1, 2, 4, 5), 0.2)
    torch.testing.assert_close(received(even), torch.ones(1, 5))
    masked = torch.tensor([[[[0.5, 0.5, 0.0], [1.0, 0.0, 0.0], [0.3, 0.3, 0.4]]]])
    two = torch.tensor([[True, True, False]])
    torch.testing.assert_close(received(masked, two, two)[0, :2], torch.tensor([1.5, 0.5]))


def test_voxels_find_their_parents():
    x, y, z = 13, 27, 38
    parent, child = parent_and_child(torch.tensor([(x * 40 + y) * 40 + z]))
    assert parent.item() == (6 * 20 + 13) * 20 + 19
    assert child.item() == 1 * 4 + 1 * 2 + 0


def test_take_reads_the_named_cells():
    cells = torch.arange(2 * 3 * 8.0).view(2, 3, 2, 2, 2)
    found = take(cells, torch.tensor([[0, 7], [3, 3]]))
    assert found.shape == (2, 2, 3)
    torch.testing.assert_close(found[0, 1], cells[0, :, 1, 1, 1])
    torch.testing.assert_close(found[1, 0], cells[1, :, 0, 1, 1])


def test_windows_are_put_back_where_they_came_from():
    head = ImageLocal(TINY).eval()
    plain = torch.zeros(1, 16, 16, 24)
    marked = plain.clone()
    marked[0, :, 5, 17] = 5
    change = (head(marked).tokens - head(plain).tokens).norm(dim=-1)[0]
    assert change.argmax().item() == 5 * 24 + 17


def test_saliency_is_a_share_of_the_attention():
    found = ImageLocal(TINY).eval()(torch.randn(2, 16, 16, 24))
    torch.testing.assert_close(found.saliency.mean(1), torch.ones(2), atol=1e-4, rtol=0)


def test_templates_share_out_the_features_that_exist():
    lit = IterativeAttention(inputs=8, count=4, outputs=6, iterations=3)
    mask = torch.tensor([[True] * 7 + [False] * 3])
    tokens = torch.randn(1, 10, 8)
    found = lit(tokens, mask)
    assert found.attention[..., 7:].abs().max() == 0
    torch.testing.assert_close(found.attention.sum(-1), torch.ones(1, 4), atol=1e-3, rtol=0)
    tokens[:, 7:] = 100
    torch.testing.assert_close(found.descriptors, lit(tokens, mask).descriptors)
    torch.testing.assert_close(found.descriptors.norm(dim=-1), torch.ones(1, 4))
