from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tiny_worlds import pose_at

from umf_ros.lab.datasets.labels import Rule, label, places_of
from umf_ros.lab.training.local_losses import (
    correspondence,
    decorrelation,
    eligible,
    neighbours,
    super_contrastive,
    wasted_saliency,
)
from umf_ros.lab.training.losses import batch_hard_triplet, graded, multi_similarity
from umf_ros.networks.local_features import LocalMap
from umf_ros.networks.superfeatures import SuperMap


def test_labels_follow_distance_and_heading():
    poses = np.stack(
        [pose_at(0, 0), pose_at(11, 0), pose_at(30, 0), pose_at(70, 0), pose_at(0, 0, 45), pose_at(0, 0, 180)]
    )
    positive, negative = label(places_of(0, poses), places_of(0, poses[:1]), Rule())
    assert positive[:, 0].tolist() == [True, True, False, False, False, False]
    assert negative[:, 0].tolist() == [False, False, False, True, False, True]
    _, thesis = label(places_of(0, poses), places_of(0, poses[:1]), Rule(negative_deg=30))
    assert thesis[4, 0]


def test_headings_wrap_around():
    poses = np.stack([pose_at(0, 0, 175), pose_at(0, 0, -175)])
    positive, _ = label(places_of(0, poses), places_of(0, poses), Rule())
    assert positive.all()


def test_other_worlds_are_other_places():
    here, there = places_of(0, pose_at(0, 0)[None]), places_of(1, pose_at(0, 0)[None])
    positive, negative = label(here, there, Rule())
    assert not positive.any()
    assert negative.all()


def test_multi_similarity_by_hand():
    similarity = torch.tensor([[0.9, 0.3]])
    positive, negative = torch.tensor([[True, False]]), torch.tensor([[False, True]])
    wanted = math.log1p(math.exp(-2 * 0.4)) / 2 + math.log1p(math.exp(30 * -0.2)) / 30
    assert multi_similarity(similarity, positive, negative).item() == pytest.approx(wanted, rel=1e-5)


def test_multi_similarity_pulls_and_pushes():
    similarity = torch.tensor([[0.5, 0.5, 0.5]], requires_grad=True)
    multi_similarity(similarity, torch.tensor([[True, False, False]]), torch.tensor([[False, True, False]])).backward()
    assert similarity.grad[0, 0] < 0 < similarity.grad[0, 1]
    assert similarity.grad[0, 2] == 0


def test_triplet_takes_the_hardest():
    similarity = torch.tensor([[1.0, 0.9, 0.5, 0.8, -1.0]])
    positive = torch.tensor([[False, True, True, False, False]])
    negative = torch.tensor([[False, False, False, True, True]])
    loss, active = batch_hard_triplet(similarity, positive, negative)
    assert loss.item() == pytest.approx(1.0 - math.sqrt(0.4) + 0.2, rel=1e-4)
    assert active.item() == 1
    calm, none = batch_hard_triplet(torch.tensor([[1.0, 0.99, 0.99, -1.0, -1.0]]), positive, negative)
    assert calm.item() == none.item() == 0


def test_graded_wants_the_nearest_most_alike():
    metres = torch.tensor([[0.0, 5.0, 30.0]])
    comparable = torch.tensor([[False, True, True]])
    good = graded(torch.tensor([[1.0, 0.9, 0.2]]), metres, comparable)
    bad = graded(torch.tensor([[1.0, 0.2, 0.9]]), metres, comparable)
    assert good < 0.01 < 0.5 < bad
    assert graded(torch.tensor([[1.0, 0.2, 0.9]]), torch.tensor([[0.0, 5.0, 9.0]]), comparable) == 0


def local_map(descriptors, saliency=None):
    shape = descriptors.shape[:2]
    saliency = torch.ones(shape) if saliency is None else saliency
    return LocalMap(descriptors, descriptors, saliency, torch.ones(shape, dtype=torch.bool))


def test_correspondence_rewards_the_right_match():
    eye = torch.eye(6)[None].repeat(2, 1, 1)
    first, second = torch.tensor([0]), torch.tensor([1])
    right = torch.tensor([[[0, 0], [3, 3], [-1, -1]]])
    wrong = torch.tensor([[[0, 1], [3, 2], [-1, -1]]])
    good = correspondence(local_map(eye), first, second, right, None)
    bad = correspondence(local_map(eye), first, second, wrong, None)
    assert good < 0.01
    assert bad > 10


def test_correspondence_forgives_neighbours():
    near = neighbours(1, 6)
    blurred = torch.eye(6) + 0.9 * torch.diag(torch.ones(5), 1)
    blurred = torch.nn.functional.normalize(blurred, dim=-1)[None].repeat(2, 1, 1)
    matches = torch.tensor([[[k, k] for k in range(6)]])
    pair = torch.tensor([0]), torch.tensor([1])
    strict = correspondence(local_map(blurred), *pair, matches, None)
    assert correspondence(local_map(blurred), *pair, matches, near) < strict


def test_salience_goes_to_what_matches():
    torch.manual_seed(0)
    descriptors = torch.eye(6)[None].repeat(2, 1, 1)
    descriptors[1, 4:] = descriptors[1, 4:].flip(0)
    saliency = torch.ones(2, 6, requires_grad=True)
    matches = torch.tensor([[[k, k] for k in range(6)]])
    correspondence(local_map(descriptors, saliency), torch.tensor([0]), torch.tensor([1]), matches, None).backward()
    assert (saliency.grad[:, :4] < 0).all()
    assert (saliency.grad[:, 4:] > 0).all()


def test_no_correspondences_cost_nothing():
    nothing = torch.full((1, 3, 2), -1)
    loss = correspondence(
        local_map(torch.eye(6)[None].repeat(2, 1, 1)), torch.tensor([0]), torch.tensor([1]), nothing, None
    )
    assert loss.item() == 0


def test_neighbours_do_not_wrap_around():
    near = neighbours(3, 4)
    assert near[5].nonzero().flatten().tolist() == [0, 1, 2, 4, 5, 6, 8, 9, 10]
    assert not near[3, 4]


def test_saliency_on_the_sky_is_wasted():
    useful = torch.tensor([[True, False]])
    assert wasted_saliency(torch.tensor([[3.0, 1.0]]), useful).item() == pytest.approx(0.25)


def test_eligible_super_features():
    """The ratio test compares distances, not an index, and the smaller must be the match."""
    base = torch.eye(4)
    assert eligible(base, base).all()
    swapped = base[[1, 0, 2, 3]]
    assert eligible(base, swapped).tolist() == [False, False, True, True]
    doubtful = base.clone()
    doubtful[0] = torch.nn.functional.normalize(base[0] + 0.95 * base[1], dim=0)
    assert eligible(base, doubtful).tolist() == [False, True, True, True]
    assert eligible(base, doubtful, ratio=1.0)[0]


def super_map(descriptors, attention=None):
    attention = torch.rand(*descriptors.shape[:2], 5) if attention is None else attention
    return SuperMap(descriptors, torch.ones(descriptors.shape[:2]), attention)


def test_super_contrastive():
    same = torch.eye(4)[None].repeat(3, 1, 1)
    different = torch.zeros(3, 3, dtype=torch.bool)
    pair = torch.tensor([0]), torch.tensor([1])
    assert super_contrastive(super_map(same), *pair, different).item() == 0
    different[0, 2] = True
    assert super_contrastive(super_map(same), *pair, different).item() == pytest.approx(1.1)
    same[2] = -same[2]
    assert super_contrastive(super_map(same), *pair, different).item() == 0


def test_decorrelation_wants_different_places():
    apart = torch.eye(3, 5)[None]
    together = torch.ones(1, 3, 5)
    assert decorrelation(super_map(torch.rand(1, 3, 4), apart)).item() == pytest.approx(0, abs=1e-6)
    assert decorrelation(super_map(torch.rand(1, 3, 4), together)).item() == pytest.approx(1)
