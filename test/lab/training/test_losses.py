from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_worlds import pose_at

from umf_ros.lab.datasets.sample import Rule, label, places_of
from umf_ros.lab.training.losses import (
    batch_hard_triplet,
    correspondence,
    decorrelation,
    eligible,
    graded,
    multi_similarity,
    neighbourhood_components,
    neighbours,
    super_contrastive,
    wasted_saliency,
)
from umf_ros.networks.local_features import LocalMap, SuperMap

PAIR = torch.tensor([0]), torch.tensor([1])


def test_labels_follow_distance_and_heading():
    poses = np.stack(
        [pose_at(0, 0), pose_at(11, 0), pose_at(30, 0), pose_at(70, 0), pose_at(0, 0, 45), pose_at(0, 0, 180)]
    )
    positive, negative = label(places_of(0, poses), places_of(0, poses[:1]), Rule())
    assert positive[:, 0].tolist() == [True, True, False, False, False, False]
    assert negative[:, 0].tolist() == [False, False, False, True, False, True]
    _, thesis = label(places_of(0, poses), places_of(0, poses[:1]), Rule(negative_deg=30))
    assert thesis[4, 0]
    across = np.stack([pose_at(0, 0, 175), pose_at(0, 0, -175)])  # headings wrap around
    assert label(places_of(0, across), places_of(0, across), Rule())[0].all()


def test_other_worlds_are_other_places():
    here, there = places_of(0, pose_at(0, 0)[None]), places_of(1, pose_at(0, 0)[None])
    positive, negative = label(here, there, Rule())
    assert not positive.any() and negative.all()


def test_triplet_takes_the_hardest_and_none_that_is_far_enough():
    positive = torch.tensor([[False, True, True, False, False]])
    negative = torch.tensor([[False, False, False, True, True]])
    close, calm = [1.0, 0.9, 0.5, 0.8, -1.0], [1.0, 0.99, 0.99, -1.0, -1.0]
    for similarities, excess in ((close, 1.2 - math.sqrt(0.4)), (calm, 0)):
        loss, active = batch_hard_triplet(torch.tensor([similarities]), positive, negative)
        assert loss.item() == pytest.approx(excess, rel=1e-4) and active.item() == (excess > 0)


def local_map(descriptors, saliency=None):
    shape = descriptors.shape[:2]
    saliency = torch.ones(shape) if saliency is None else saliency
    return LocalMap(descriptors, descriptors, saliency, torch.ones(shape, dtype=torch.bool))


def test_correspondence_forgives_neighbours():
    near = neighbours(1, 6)
    blurred = torch.eye(6) + 0.9 * torch.diag(torch.ones(5), 1)
    blurred = torch.nn.functional.normalize(blurred, dim=-1)[None].repeat(2, 1, 1)
    matches = torch.tensor([[[k, k] for k in range(6)]])
    strict = correspondence(local_map(blurred), *PAIR, matches, None)
    assert correspondence(local_map(blurred), *PAIR, matches, near) < strict


def test_salience_goes_to_what_matches():
    torch.manual_seed(0)
    descriptors = torch.eye(6)[None].repeat(2, 1, 1)
    descriptors[1, 4:] = descriptors[1, 4:].flip(0)
    saliency = torch.ones(2, 6, requires_grad=True)
    matches = torch.tensor([[[k, k] for k in range(6)]])
    correspondence(local_map(descriptors, saliency), *PAIR, matches, None).backward()
    assert (saliency.grad[:, :4] < 0).all() and (saliency.grad[:, 4:] > 0).all()


def test_no_correspondences_cost_nothing():
    nothing = torch.full((1, 3, 2), -1)
    assert correspondence(local_map(torch.eye(6)[None].repeat(2, 1, 1)), *PAIR, nothing, None).item() == 0


def test_neighbours_do_not_wrap_around():
    near = neighbours(3, 4)
    assert near[5].nonzero().flatten().tolist() == [0, 1, 2, 4, 5, 6, 8, 9, 10] and not near[3, 4]


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


# against plain loops


@pytest.fixture
def relations() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Similarities, positives and negatives; one anchor without a positive, one without a negative."""
    generator = torch.Generator().manual_seed(0)
    similarity = torch.rand(6, 9, generator=generator) * 2 - 1
    kind = torch.randint(0, 3, (6, 9), generator=generator)
    positive, negative = kind == 1, kind == 2
    positive[4], negative[5] = False, False
    return similarity, positive, negative


def test_multi_similarity_is_a_loop_over_anchors(relations):
    similarity, positive, negative = relations
    total = 0.0
    for row in range(6):
        pulls = sum(math.exp(-2.0 * (s - 0.5)) for s in similarity[row][positive[row]].tolist())
        pushes = sum(math.exp(30.0 * (s - 0.5)) for s in similarity[row][negative[row]].tolist())
        total += math.log1p(pulls) / 2.0 + math.log1p(pushes) / 30.0
    assert multi_similarity(*relations).item() == pytest.approx(total / 6, rel=1e-5)


def test_triplets_are_a_loop_over_anchors(relations):
    similarity, positive, negative = relations
    excesses = []
    for row in range(6):
        if positive[row].any() and negative[row].any():
            far = max(math.sqrt(2 - 2 * s) for s in similarity[row][positive[row]].tolist())
            near = min(math.sqrt(2 - 2 * s) for s in similarity[row][negative[row]].tolist())
            excesses.append(far - near + 0.2)
    active = [excess for excess in excesses if excess > 0]
    loss, share = batch_hard_triplet(*relations)
    assert len(excesses) == 4 and loss.item() == pytest.approx(sum(active) / len(active), rel=1e-5)
    assert share.item() == pytest.approx(len(active) / 4)


def test_neighbourhood_components_are_a_loop_over_queries(relations):
    similarity, wanted, unwanted = relations
    penalties = []
    for row in range(6):
        right = sum(math.exp(20 * s) for s in similarity[row][wanted[row]].tolist())
        wrong = sum(math.exp(20 * s) for s in similarity[row][unwanted[row]].tolist())
        if right and wrong:
            penalties.append(-math.log(right / (right + wrong)))
    assert len(penalties) == 4
    assert neighbourhood_components(*relations).item() == pytest.approx(np.mean(penalties), rel=1e-5)


def test_queries_without_a_rival_and_batches_without_a_triplet_teach_nothing():
    nothing, everything = torch.zeros(3, 3, dtype=torch.bool), torch.ones(3, 3, dtype=torch.bool)
    similarity = torch.eye(3, requires_grad=True)
    loss = neighbourhood_components(similarity, nothing, everything)
    triplets, share = batch_hard_triplet(similarity, nothing, nothing)
    (loss + triplets).backward()
    assert loss.item() == triplets.item() == share.item() == 0 and not similarity.grad.any()
    assert multi_similarity(similarity, nothing, nothing).item() == 0


def test_grading_is_a_loop_over_ordered_pairs():
    generator = torch.Generator().manual_seed(1)
    similarity, metres = torch.rand(4, 4, generator=generator), 40 * torch.rand(4, 4, generator=generator)
    metres[2, 3] = math.inf
    comparable = metres.isfinite() & ~torch.eye(4, dtype=torch.bool)
    penalties = []
    for row in range(4):
        for near in range(4):
            for far in range(4):
                if comparable[row, near] and comparable[row, far] and metres[row, near] + 6 < metres[row, far]:
                    wrong = float(similarity[row, far] - similarity[row, near])
                    penalties.append(math.log1p(math.exp(20 * wrong + 1)) / 20)
    assert len(penalties) > 5
    assert graded(similarity, metres, comparable).item() == pytest.approx(np.mean(penalties), rel=1e-5)


def random_map(seed: int = 0) -> LocalMap:
    generator = torch.Generator().manual_seed(seed)
    descriptors = torch.nn.functional.normalize(torch.randn(2, 5, 4, generator=generator), dim=-1)
    mask = torch.tensor([[True] * 5, [True, True, True, True, False]])
    return LocalMap(descriptors, descriptors, 2 * torch.rand(2, 5, generator=generator), mask)


def test_correspondence_is_a_loop_over_matches():
    local, matches = random_map(), [(0, 2), (3, 3), (4, 0)]
    scores = local.descriptors[0] @ local.descriptors[1].T / 0.07

    def likelihood(row: torch.Tensor, mask: torch.Tensor, target: int) -> float:
        return float(row[target] - torch.logsumexp(row[mask], 0))

    loss = weight = 0.0
    for one, two in matches:
        there = likelihood(scores[one], local.mask[1], two)
        back = likelihood(scores[:, two], local.mask[0], one)
        worth = [float(s / (1 + s) + 0.1) for s in (local.saliency[0, one], local.saliency[1, two])]
        loss -= (there + back) / 2 * worth[0] * worth[1]
        weight += worth[0] * worth[1]
    table = torch.tensor([[*matches, (-1, -1)]])
    found = correspondence(local, *PAIR, table, None)
    assert found.item() == pytest.approx(loss / weight, rel=1e-5)


def test_what_is_masked_is_never_the_wrong_answer():
    local = random_map()
    loud = replace(local, descriptors=local.descriptors.clone())
    loud.descriptors[1, 4] = local.descriptors[0, 0]  # a perfect match that does not exist
    table = torch.tensor([[[0, 2]]])
    one, two = (correspondence(found, *PAIR, table, None) for found in (local, loud))
    assert one.item() == pytest.approx(two.item(), rel=1e-5)


def test_super_features_that_are_alike_cost_nothing_beside_none_or_far_ones():
    same, negative = torch.eye(4).repeat(3, 1, 1), torch.eye(3) > 2
    for other, sign, cost in ((False, 1, 0), (True, 1, 1.1), (True, -1, 0)):
        negative[0, 2], same[2] = other, sign * torch.eye(4)
        supers = SuperMap(same, torch.ones(3, 4), torch.rand(3, 4, 5))
        assert super_contrastive(supers, *PAIR, negative).item() == pytest.approx(cost)


def random_supers(seed: int) -> SuperMap:
    generator = torch.Generator().manual_seed(seed)
    descriptors = torch.nn.functional.normalize(torch.randn(4, 5, 3, generator=generator), dim=-1)
    descriptors[1] = torch.nn.functional.normalize(descriptors[0] + 0.1, dim=-1)
    return SuperMap(descriptors, torch.ones(4, 5), torch.rand(4, 5, 6, generator=generator))


def test_super_features_are_compared_id_by_id():
    supers, negative = random_supers(3), torch.zeros(4, 4, dtype=torch.bool)
    negative[0, 2] = negative[0, 3] = True
    ids = [row for row, chosen in enumerate(eligible(supers.descriptors[0], supers.descriptors[1]).tolist()) if chosen]
    assert len(ids) >= 2
    squared = lambda a, b, k: float((supers.descriptors[a, k] - supers.descriptors[b, k]).square().sum())  # noqa: E731
    pulled = sum(squared(0, 1, k) for k in ids)
    pushed = sum(max(1.1 - squared(0, other, k), 0) for other in (2, 3) for k in ids) / 2
    found = super_contrastive(supers, *PAIR, negative)
    assert found.item() == pytest.approx((pulled + pushed) / len(ids), rel=1e-4)


def test_decorrelation_is_the_mean_over_pairs_of_maps():
    supers = random_supers(4)
    maps = torch.nn.functional.normalize(supers.attention, dim=-1)
    pairs = [float(maps[row, a] @ maps[row, b]) for row in range(4) for a in range(5) for b in range(5) if a != b]
    assert decorrelation(supers).item() == pytest.approx(np.mean(pairs), rel=1e-5)
