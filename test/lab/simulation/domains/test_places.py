"""Every kind of place: drivable, its own for each seed, the same again for the same."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from scipy.ndimage import maximum_filter1d
from scipy.spatial.transform import Rotation

from umf_ros.lab.simulation.domains.outdoors import Landscape
from umf_ros.lab.simulation.domains.solids import cast_into
from umf_ros.lab.simulation.domains.survey import PLACES

LIKE_ROWS = ("warehouse", "greenhouse")
FLAT = ("snow", "lander")
BUILT = ("corridor", "rooms", "street", "orchard", "woods", "quarry", "tunnel", "smooth_tunnel", *LIKE_ROWS, *FLAT)
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


@pytest.mark.parametrize("kind", ["street", "corridor", "rooms", "orchard", "woods", *LIKE_ROWS])
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


def heights(place, x, y, visit=0, top=50.0):
    """Height of the highest surface under `top` at places (N,)."""
    eyes = np.column_stack([x, y, np.full(len(x), top)])
    return top - cast_into(place.scene(visit), eyes, np.tile(np.float32([0, 0, -1]), (len(x), 1))).distance


def grid(half, step):
    x, y = np.meshgrid(*[np.arange(-half, half, step)] * 2)
    return x.ravel(), y.ravel()


@pytest.mark.parametrize("kind", FLAT)
def test_a_plain_is_almost_flat_with_scattered_rocks(kind):
    place = PLACES[kind].build(10_000)
    x, y = grid(40, 0.25)
    ground = place.height(x, y)
    assert np.ptp(ground) < 1.2
    tall = heights(place, x, y) - ground > 0.1
    assert 20 < tall.sum() < 0.02 * len(x)


def test_a_lander_stands_beside_the_trail_and_only_crates_move():
    place = PLACES["lander"].build(10_000)
    x, y = grid(32, 0.1)
    before, after = heights(place, x, y), heights(place, x, y, visit=1)
    tallest = np.array([x[before.argmax()], y[before.argmax()]])
    assert 2.9 < before.max() < 5.0
    assert 4 < np.linalg.norm(place.trail - tallest, axis=1).min() < 12
    stage = np.hypot(*(np.stack([x, y], 1) - tallest).T) < 1.0
    assert after[stage] == pytest.approx(before[stage], abs=1e-3)
    moved = np.abs(after - before) > 0.05
    assert 0 < moved.mean() < 0.005
    assert np.abs(after - before)[moved].max() < 1.5


def along_the_trail(place, count=12):
    """Distances (count, 300) all around points of the trail, directions relative to the trail's own."""
    views = []
    for index in np.linspace(0, len(place.trail) - 30, count).astype(int):
        x, y = place.trail[index]
        turn = Rotation.from_euler("z", np.arctan2(y, x)).as_matrix().astype(np.float32)
        eyes = np.tile([x, y, 0.8], (300, 1))
        views.append(cast_into(place.scene(0), eyes, np.ascontiguousarray(ALL_AROUND @ turn.T)).distance)
    return np.array(views)


def test_a_tunnel_without_features_looks_the_same_all_along_and_one_with_features_does_not():
    for seed in range(10_000, 10_003):
        smooth, featured = (along_the_trail(PLACES[kind].build(seed)) for kind in ("smooth_tunnel", "tunnel"))
        assert np.isfinite(smooth).all()  # no open end
        assert np.median(np.ptp(smooth, axis=0)) < 0.005
        # the trail is a polygon of 0.1 m, so that grazing rays differ by more
        assert np.quantile(np.ptp(smooth / smooth.mean(axis=0), axis=0), 0.99) < 0.02
        assert np.median(np.ptp(featured, axis=0)) > 0.03


@pytest.mark.parametrize(("kind", "apart", "top"), [("warehouse", 3, 1.45), ("greenhouse", 5, 2.6)])
def test_rows_resemble_each_other_but_for_some_slots_of_which_some_are_swapped(kind, apart, top):
    place = PLACES[kind].build(10_000)
    pitch = 2 * place.trail[:, 1].max() / apart
    x, across = np.arange(-9.5, 9.5, 0.05), np.arange(-0.3, 0.31, 0.1)
    profile = []
    for visit in range(2):
        rows = []
        for row in np.arange(apart + 2) - (apart + 1) / 2:
            at_x, at_y = np.meshgrid(x, row * pitch + across)
            rows.append(heights(place, at_x.ravel(), at_y.ravel(), visit, top).reshape(at_x.shape).max(axis=0))
        profile.append(maximum_filter1d(rows, 9))  # leaves sway
    first, again = np.array(profile)
    neighbours = np.corrcoef(first)[np.triu_indices(len(first), 1)]
    assert 0.3 < neighbours.mean() < 0.97
    changed = (np.abs(again - first) > 0.15).mean()
    assert 0.01 < changed < 0.4
