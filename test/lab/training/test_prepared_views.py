"""Views are prepared once, and the kept ones are the views as they were made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from umf_ros.baselines.place_network import VOXELS, ImageTrunk, PreparedView, measured, stack
from umf_ros.core.errors import OutputError
from umf_ros.core.geometry import transform
from umf_ros.core.levelling import level
from umf_ros.embedding.inputs import shrink, standardise, voxelise
from umf_ros.lab.datasets.sample import Sample
from umf_ros.lab.datasets.simulated import SimulatedWorld, WorldFolder
from umf_ros.lab.datasets.views import View, ViewMaker
from umf_ros.lab.training.batches import Draw
from umf_ros.lab.training.prepared_views import PreparedViews

ALL = frozenset({"image", "voxels", "points"})


@pytest.fixture
def world(folder: Path) -> SimulatedWorld:
    return WorldFolder(folder).refresh()[0]


def trunk() -> ImageTrunk:
    torch.manual_seed(0)
    return ImageTrunk().eval()


def some_rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_plain_views_are_what_an_embedder_sees(world: SimulatedWorld, tmp_path: Path) -> None:
    eyes = trunk()
    found = PreparedViews(ALL, eyes, 2, 0, tmp_path).plain(world, [3, 5])
    sample = world.sample(3)
    upright = transform(level(sample.points), sample.points).astype(np.float32)
    scan = voxelise(upright, sample.intensity, 1, VOXELS)
    wanted = stack([PreparedView(None, scan, None)], None)
    count = int(wanted.mask.sum())
    assert torch.equal(found.cells[0, :count], wanted.cells[0]) and int(found.mask[0].sum()) == count
    torch.testing.assert_close(found.voxels[0, :count], measured(scan)[:count], rtol=1e-3, atol=1e-3)
    assert found.image_present.all() and found.cloud_present.all()
    near = np.linalg.norm(upright[:, None] - found.points[0].numpy()[None], axis=2).min(axis=0)
    assert near.max() < 1e-3
    with torch.no_grad():
        seen = eyes.early(torch.from_numpy(standardise(shrink(sample.image, (160, 224))))[None, None])
    torch.testing.assert_close(found.maps[:1], seen, rtol=2e-3, atol=2e-2)


def test_what_was_prepared_is_not_prepared_again(
    world: SimulatedWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draws = [Draw(0, index, mirror) for index in (1, 4) for mirror in (False, True)]
    first = PreparedViews(ALL, trunk(), 2, 0, tmp_path).batch([world], draws, some_rng())
    monkeypatch.setattr(SimulatedWorld, "sample", lambda *_: pytest.fail("it was read again"))
    again = PreparedViews(ALL, trunk(), 2, 0, tmp_path).batch([world], draws, some_rng())
    assert all(torch.equal(one, two) for one, two in zip(first.input, again.input, strict=True))
    scans_alone = PreparedViews(frozenset({"voxels"}), None, 2, 0, tmp_path).batch([world], draws, some_rng())
    assert torch.equal(scans_alone.input.voxels, first.input.voxels)  # kept by another method
    assert not scans_alone.input.image_present.any()


def test_variants_differ_and_mirrored_ones_are_mirrored(world: SimulatedWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    mirrored = []
    varied = ViewMaker.varied

    def noted(self: ViewMaker, sample: Sample, rng: np.random.Generator, mirror: bool = False) -> View:
        mirrored.append(mirror)
        return varied(self, sample, rng, mirror)

    monkeypatch.setattr(ViewMaker, "varied", noted)
    views, rng = PreparedViews(ALL, trunk(), 3, 0, None), np.random.default_rng(1)
    for mirror in (False, True):
        batches = [views.batch([world], [Draw(0, 2, mirror)], rng).input for _ in range(16)]
        for part in ("maps", "voxels", "points"):
            assert len({tuple(getattr(batch, part).flatten()[:5000:7].tolist()) for batch in batches}) == 3
    assert mirrored == [False] * 9 + [True] * 9  # three variants of three senses


def test_what_a_sample_lacks_is_absent(world: SimulatedWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = SimulatedWorld.sample

    def blind(self: SimulatedWorld, index: int) -> Sample:
        sample = whole(self, index)
        return replace(sample, image=None) if index else replace(sample, points=None, intensity=None)

    monkeypatch.setattr(SimulatedWorld, "sample", blind)
    found = PreparedViews(ALL, trunk(), 1, 0, None).plain(world, [0, 1])
    assert found.image_present.tolist() == [True, False] and found.cloud_present.tolist() == [False, True]
    assert not found.maps[1].any() and not found.mask[0].any() and not found.points[0].any()


def test_a_folder_that_cannot_be_written_is_one_clear_line(world: SimulatedWorld, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot keep prepared views"):
        PreparedViews(ALL, trunk(), 1, 0, tmp_path / "file" / "views").plain(world, [0])
