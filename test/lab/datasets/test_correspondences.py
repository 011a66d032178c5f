"""Views, and what corresponds in them."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_worlds import CAMERA, TINY, flat_sample, plain_view, pose_at

from umf_ros.core.geometry import transform
from umf_ros.lab.datasets.views import Augmentation, ViewMaker, cell_points, match_cells, match_voxels, view_points

COLUMNS = TINY.image_size[1] // 4


def test_cells_below_the_horizon_lie_on_the_ground():
    points = cell_points(plain_view(pose_at(0, 0)))
    known = np.isfinite(points[:, 2])
    assert 0.3 < known.mean() < 0.55
    assert np.abs(points[known, 2]).max() < 0.05


def test_a_view_matches_itself():
    view = plain_view(pose_at(0, 0))
    cells, voxels = match_cells(view, view), match_voxels(view, view)
    assert len(cells) > 100
    assert (cells[:, 0] == cells[:, 1]).all()
    assert (voxels[:, 0] == voxels[:, 1]).all()
    assert len(voxels) == view.scan.fine_mask.sum()


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("varied", [False, True])
def test_matching_cells_see_the_same_ground(mirror, varied):
    maker = ViewMaker(TINY, Augmentation() if varied else None)
    rng = np.random.default_rng(3)
    one = maker.varied(flat_sample(pose_at(0, 0)), rng, mirror)
    two = maker.varied(flat_sample(pose_at(-2, 1.5, 8)), rng, mirror)
    matches = match_cells(one, two)
    assert len(matches) > 30
    first = transform(one.sample.world_T_body, cell_points(one))[matches[:, 0]]
    second = transform(two.sample.world_T_body, cell_points(two))[matches[:, 1]]
    distance = np.linalg.norm(first - two.sample.world_T_body[:3, 3], axis=1)
    apart = np.linalg.norm(first - second, axis=1)
    # a cell is 29 pixels wide here, and long on grazing ground
    assert np.nanmedian(apart / distance) < 0.12


@pytest.mark.parametrize("mirror", [False, True])
def test_matching_voxels_coincide_in_the_world(mirror):
    maker = ViewMaker(TINY, Augmentation())
    rng = np.random.default_rng(4)
    one = maker.varied(flat_sample(pose_at(0, 0)), rng, mirror)
    two = maker.varied(flat_sample(pose_at(-3, 1, 10)), rng, mirror)
    matches = match_voxels(one, two)
    assert len(matches) > 10
    first = transform(one.sample.world_T_body, view_points(one)[matches[:, 0]].astype(float))
    second = transform(two.sample.world_T_body, view_points(two)[matches[:, 1]].astype(float))
    assert np.linalg.norm(first - second, axis=1).max() < 0.8


def test_what_is_hidden_does_not_match():
    here = plain_view(pose_at(0, 0))
    wall = flat_sample(pose_at(0, 0))
    wall = ViewMaker(TINY).plain(
        type(wall)(**{n: getattr(wall, n) for n in wall.__slots__} | {"depth": np.ones((56, 56))})
    )
    assert len(match_cells(here, here)) > 100
    assert len(match_cells(here, wall)) < 20


def test_views_of_opposite_directions_share_nothing():
    assert len(match_cells(plain_view(pose_at(0, 0)), plain_view(pose_at(0, 0, 180)))) == 0


def test_a_mirrored_view_is_the_mirrored_sample():
    sample = flat_sample(pose_at(0, 0))
    maker = ViewMaker(TINY)
    plain, mirrored = maker.plain(sample), maker.varied(sample, np.random.default_rng(0), mirror=True)
    np.testing.assert_allclose(mirrored.image, plain.image[:, ::-1], atol=1e-6)
    left = mirrored.input_T_pixel @ [0, 0, 1]
    assert left[0] == pytest.approx(TINY.image_size[1] - 1 - (0.5 * 96 / CAMERA.width - 0.5))
    np.testing.assert_allclose(
        np.sort(mirrored.scan.centroids[mirrored.scan.fine_mask, 2]),
        np.sort(plain.scan.centroids[plain.scan.fine_mask, 2]),
        atol=0.05,
    )


def test_a_dark_image_and_no_scan_are_missing():
    sample = flat_sample(pose_at(0, 0))
    values = {name: getattr(sample, name) for name in sample.__slots__}
    dark = ViewMaker(TINY).plain(type(sample)(**values | {"image": np.zeros((224, 224), np.uint8), "points": None}))
    assert not dark.image_present
    assert not dark.scan.fine_mask.any()
    assert len(match_cells(dark, dark)) == 0
    assert len(match_voxels(dark, dark)) == 0
