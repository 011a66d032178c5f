"""Pairs of a batch."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from tiny_worlds import TINY, pose_at

from umf_ros.core.errors import ConfigError
from umf_ros.lab.datasets.sample import Places, Rule, Sample, distances, label, places_of
from umf_ros.lab.datasets.views import Augmentation, ViewMaker, cell_points, match_cells
from umf_ros.lab.training.batches import BatchMaker, Draw, PairSampler, places_drawn

RULE = Rule(positive_m=5)


@dataclass
class Drive:
    """Poses of a drive whose samples are never read."""

    world_T_body: np.ndarray
    pass_index: np.ndarray
    setting: str = "hard"
    name: str = "drive"
    place: str = field(default="drive")

    def __len__(self) -> int:
        return len(self.world_T_body)

    def sample(self, index: int) -> Sample:
        raise AssertionError(f"drawing needs poses alone, not sample {index}")


def straight(length: int, passes: int = 2, yaw_deg: float = 0.0, **facts: str) -> Drive:
    """Passes along the same line in steps of 10 m; later ones are turned."""
    poses = [pose_at(10.0 * i, 0.5 * k, yaw_deg * k) for k in range(passes) for i in range(length)]
    return Drive(np.stack(poses), np.repeat(np.arange(passes), length), **facts)


def draws(sampler: PairSampler, batches: int, pairs: int = 8) -> list[tuple[Draw, Draw]]:
    rng = np.random.default_rng(0)
    return [pair for _ in range(batches) for pair in sampler.draw(pairs, rng)]


def test_hard_worlds_are_drawn_twice_as_often():
    sampler = PairSampler([straight(20, setting="hard"), straight(20, setting="easy")], RULE)
    share = np.mean([anchor.sequence == 0 for anchor, _ in draws(sampler, 300)])
    assert share == pytest.approx(2 / 3, abs=0.05)


def test_worlds_without_revisits_are_left_out():
    sampler = PairSampler([straight(20, passes=1), straight(20), straight(20, yaw_deg=90)], RULE)
    assert {anchor.sequence for anchor, _ in draws(sampler, 20)} == {1}


@pytest.mark.parametrize("drives", [[], [straight(20, passes=1)], [straight(20, yaw_deg=180)]])
def test_worlds_none_of_which_has_a_revisit_are_refused(drives):
    with pytest.raises(ConfigError, match="visited twice"):
        PairSampler(drives, RULE)


def test_half_of_a_batch_is_of_one_world_and_much_of_it_of_one_stretch():
    drives = [straight(100) for _ in range(6)]
    sampler, rng = PairSampler(drives, RULE), np.random.default_rng(0)
    for _ in range(20):
        pairs = sampler.draw(16, rng)
        world, count = Counter(anchor.sequence for anchor, _ in pairs[:8]).most_common(1)[0]
        assert count == 8
        first = np.array([drives[world].world_T_body[anchor.index, 0, 3] for anchor, _ in pairs[:4]])
        assert np.ptp(first) <= 160  # within 80 m of one place
        assert len({anchor.mirror for anchor, _ in pairs[:8]}) == 1


def test_a_whole_world_gives_all_pairs_from_all_over_it():
    drives = [straight(100) for _ in range(3)]
    sampler, rng = PairSampler(drives, Rule(positive_m=5, between_passes=True), whole=True), np.random.default_rng(0)
    seen = set()
    for _ in range(20):
        pairs = sampler.draw(60, rng)
        assert len({(draw.sequence, draw.mirror) for pair in pairs for draw in pair}) == 1
        assert len({anchor.index for anchor, _ in pairs}) == 60
        along = [drives[0].world_T_body[anchor.index, 0, 3] for anchor, _ in pairs]
        assert np.ptp(along) > 800 and np.bincount(np.array(along, int) // 250, minlength=4).min() > 5
        seen.add(pairs[0][0].sequence)
    assert seen == {0, 1, 2}


def test_a_world_with_a_single_revisit_is_drawn_over_and_over():
    lonely = straight(2)
    lonely.world_T_body[1, 0, 3] = 500.0  # only the other place is seen twice
    pairs = PairSampler([lonely], RULE).draw(8, np.random.default_rng(0))
    assert {anchor.index for anchor, _ in pairs} == {0, 2} and len(pairs) == 8


def test_the_way_just_driven_is_no_revisit():
    """The passes of a drive without beginning or end are fractions."""
    drive = straight(4)
    drive.pass_index = np.arange(8) * 0.26
    assert {(anchor.index, found.index) for anchor, found in draws(PairSampler([drive], RULE), 20)} == {
        pair for row in range(4) for pair in ((row, row + 4), (row + 4, row))
    }
    drive.pass_index = np.arange(8) * 0.24
    with pytest.raises(ConfigError, match="visited twice"):
        PairSampler([drive], RULE)


def test_every_positive_is_drawn_some_time():
    sampler = PairSampler([straight(3, passes=4)], RULE)
    partners = {pair[1].index for pair in draws(sampler, 60) if pair[0].index == 0}
    assert partners == {3, 6, 9}


@pytest.mark.parametrize("chance", [0.0, 1.0])
def test_mirrored_as_often_as_wanted(chance):
    found = draws(PairSampler([straight(20)], RULE, mirror=chance), 5)
    assert {draw.mirror for pair in found for draw in pair} == {bool(chance)}


def test_a_mirrored_world_keeps_its_distances_and_turns_its_headings():
    drive = Drive(np.stack([pose_at(1, 2, 10), pose_at(4, -2, 50)]), np.array([0, 3]))
    plain, mirrored = (places_drawn([Draw(0, 0, flip), Draw(0, 1, flip)], [drive]) for flip in (False, True))
    np.testing.assert_allclose(distances(plain, plain), distances(mirrored, mirrored))
    np.testing.assert_allclose(mirrored.heading, -plain.heading)
    assert plain.passage.tolist() == [0, 3]
    assert np.isinf(distances(plain, mirrored)[0]).all()


@pytest.mark.parametrize(
    ("metres", "degrees", "positive", "negative"),
    [
        (11.9, 0, True, False),
        (12.1, 0, False, False),
        (0, 29, True, False),
        (0, 31, False, False),
        (0, 61, False, True),
        (59.9, 0, False, False),
        (60.1, 0, False, True),
        (5, -175, False, True),
    ],
)
def test_what_counts_as_the_same_place(metres, degrees, positive, negative):
    here, there = places_of(0, pose_at(0, 0, 170)[None]), places_of(0, pose_at(0, metres, 170 + degrees)[None])
    found = label(here, there, Rule())
    assert (bool(found[0][0, 0]), bool(found[1][0, 0])) == (positive, negative)


def test_pairs_of_one_pass_are_neutral_where_passes_are_compared():
    poses = np.stack([pose_at(x, 0) for x in (0, 1, 2, 500, 501)])
    places = places_of(0, poses, np.array([0, 0, 1, 0, 1]))
    positive, negative = label(places, places, Rule(between_passes=True))
    assert positive[0].tolist() == [False, False, True, False, False]
    assert negative[0].tolist() == [False, False, False, False, True]
    elsewhere = places_of(1, poses[:1])
    assert label(places, elsewhere, Rule(between_passes=True))[1].all()  # another world is another pass


def test_distances_are_those_of_every_pair():
    rng = np.random.default_rng(0)
    a, b = (
        Places(rng.integers(2, size=n), rng.normal(size=(n, 2)), rng.uniform(-4, 4, n), np.zeros(n, int))
        for n in (5, 7)
    )
    metres, turn = distances(a, b)
    for i in range(5):
        for j in range(7):
            same = a.world[i] == b.world[j]
            assert metres[i, j] == (pytest.approx(np.hypot(*(a.position[i] - b.position[j]))) if same else np.inf)
            difference = a.heading[i] - b.heading[j]
            assert turn[i, j] == pytest.approx(abs(np.arctan2(np.sin(difference), np.cos(difference))))


def test_a_batch_is_anchors_then_partners(world):
    pairs = PairSampler([world], RULE).draw(6, np.random.default_rng(2))
    batch = BatchMaker([world], ViewMaker(TINY, Augmentation()), 3, 20).make(pairs, np.random.default_rng(2))
    assert batch.input.image.shape[0] == len(batch.places.world) == 12
    positive, _ = label(batch.places, batch.places, RULE)
    assert positive[np.arange(6), np.arange(6) + 6].all()
    assert batch.local_rows.tolist() == [0, 2, 5, 6, 8, 11]
    assert batch.cells.shape == batch.voxels.shape == (3, 20, 2)
    assert batch.useful_cells.shape == (6, 16 * 24)


def test_correspondences_of_a_batch_are_true_and_their_lack_is_marked(world):
    """Unvaried views can be made again, and compared with what the batch says of them."""
    pairs = [(Draw(0, 2, False), Draw(0, 14, False)), (Draw(0, 5, False), Draw(0, 17, False))]
    still = Augmentation(erase=0, drop_points=0, image_roll_deg=0, image_scale=0, image_shift=0)
    maker = ViewMaker(TINY, still)
    batch = BatchMaker([world], maker, 2, 1000).make(pairs, np.random.default_rng(0))
    one, two = (ViewMaker(TINY).plain(world.sample(index)) for index in (2, 14))
    wanted = {tuple(match) for match in match_cells(one, two).tolist()}
    found = {tuple(match) for match in batch.cells[0].tolist()}
    assert found - {(-1, -1)} == wanted and len(wanted) > 50 and (-1, -1) in found
    known = torch.from_numpy(np.isfinite(cell_points(one)[:, 2]))
    assert torch.equal(batch.useful_cells[0], known)
    assert batch.voxels[0].max() < TINY.fine_voxels
    assert (batch.voxels[0] >= 0).all(1).sum() > 5


def test_batches_without_local_pairs_have_none(world):
    pairs = PairSampler([world], RULE).draw(2, np.random.default_rng(2))
    batch = BatchMaker([world], ViewMaker(TINY, Augmentation()), 0, 20).make(pairs, np.random.default_rng(2))
    assert len(batch.local_rows) == 0 and batch.input.image.shape[0] == 4
