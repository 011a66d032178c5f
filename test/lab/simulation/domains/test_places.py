"""Every kind of place: drivable, its own for each seed, the same again for the same."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.lab.simulation.domains.outdoors import Landscape
from umf_ros.lab.simulation.domains.solids import cast_into
from umf_ros.lab.simulation.domains.survey import PLACES

BUILT = ("corridor", "rooms", "street", "orchard", "woods", "quarry")
ALL_AROUND = np.float32(Rotation.random(300, np.random.default_rng(5)).as_matrix()[:, 0])


@pytest.fixture(scope="module", params=BUILT)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def place(kind):
    return PLACES[kind].build(10_000)


def view(place, visit=0, height=1.0):
    """Distances all around one point of the trail."""
    x, y = place.trail[40]
    eye = np.array([x, y, float(np.atleast_1d(place.height([x], [y]))[0]) + height])
    return cast_into(place.scene(visit), np.tile(eye, (300, 1)), ALL_AROUND).distance


def test_the_trail_is_closed_and_free_to_both_sides(place):
    trail = place.trail
    assert np.linalg.norm(trail[0] - trail[-1]) < 0.25
    along = np.roll(trail, -1, axis=0) - np.roll(trail, 1, axis=0)
    aside = np.stack([-along[:, 1], along[:, 0]], 1) / np.linalg.norm(along, axis=1, keepdims=True)
    for offset in (-place.lateral_m, 0.0, place.lateral_m):
        path = trail + offset * aside
        eyes = np.column_stack([path, place.height(path[:, 0], path[:, 1]) + 1.0]).astype(np.float32)
        for visit in range(2):
            gap = place.scene(visit).rays.compute_distance(o3d.core.Tensor.from_numpy(eyes)).numpy()
            assert gap.min() > 0.1


def test_a_seed_gives_one_place_and_another_seed_another(kind, place):
    again, other = PLACES[kind].build(10_000), PLACES[kind].build(10_001)
    assert view(again) == pytest.approx(view(place))
    assert other.trail.shape != place.trail.shape or not np.allclose(other.trail, place.trail)


@pytest.mark.parametrize("kind", ["street", "corridor", "rooms", "orchard", "woods"])
def test_some_things_move_between_visits_and_most_stay(kind):
    moved = []
    for seed in range(4):
        place = PLACES[kind].build(seed)
        before, after = view(place, 0), view(place, 1)
        both = np.isfinite(before) & np.isfinite(after)
        moved.append(np.mean(np.abs(before[both] - after[both]) > 0.2))
    assert max(moved) > 0
    assert np.mean(moved) < 0.5


def test_the_rovers_own_world_is_a_place_too(drive):
    place = Landscape(drive.world)
    x, y = place.trail[0]
    hit = cast_into(place.scene(0), np.array([[x, y, 90.0]]), np.float32([[0, 0, -1]]))
    assert 90 - hit.distance[0] == pytest.approx(float(place.height(x, y)), abs=0.3)
    assert hit.reflectance[0] == pytest.approx(drive.world.traits.albedo, rel=1.0)
    assert hit.reflectance[0] > 0
