"""Loops of two closures and the odometry between; how wrong stated covariances are, found from such loops."""

from __future__ import annotations

import numpy as np
import pytest
from graph_worlds import SETTINGS, closing, drive, feed_odometry, lap_pairs, rows_of, two_laps

from umf_ros.core.geometry import Array, expmap
from umf_ros.lab.simulation.pose_graphs import GraphWorld, rover_loops, with_wrong_closures
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.consistency import (
    LOOP,
    Loops,
    NoiseScale,
    NoiseScaleEstimator,
    loops_between,
    squared_mahalanobis,
)


def covariances(rng: np.random.Generator, count: int, turn_rad: float, metres: float) -> Array:
    """Spread-out covariances about the given standard deviations."""
    roots = np.eye(6) + 0.3 * rng.normal(size=(count, 6, 6))
    lower = np.array([turn_rad] * 3 + [metres] * 3)[:, None] * roots * rng.uniform(0.5, 2.0, (count, 1, 1))
    return lower @ np.swapaxes(lower, -1, -2)


def as_loops(residuals: Array, odometry: Array, closures: Array) -> Loops:
    found = np.zeros(len(residuals), LOOP)
    found["residual"], found["odometry"], found["closures"] = residuals, odometry, closures
    return found


def loops(count: int, odometry: float, closures: float, seed: int = 0) -> Loops:
    """Loops whose true deviations are the stated ones times the factors."""
    rng = np.random.default_rng(seed)
    walk, ends = covariances(rng, count, 0.01, 0.15), covariances(rng, count, 0.01, 0.07)
    lower = np.linalg.cholesky(odometry**2 * walk + closures**2 * ends)
    return as_loops((lower @ rng.normal(size=(count, 6, 1)))[..., 0], walk, ends)


def take(estimator: NoiseScaleEstimator, found: Loops, first_place: int = 0) -> None:
    """Ten loops of each place."""
    for start in range(0, len(found), 10):
        estimator.add(found[start : start + 10], found[start : start + 10], first_place + start)


def scale_of(found: Loops) -> NoiseScale:
    estimator = NoiseScaleEstimator()
    take(estimator, found)
    return estimator.scale


def wrong(count: int, metres: float) -> Loops:
    right = loops(count, 1.0, 1.0, seed=9)
    rng = np.random.default_rng(10)
    return as_loops(rng.normal(0, [0.3] * 3 + [metres] * 3, (count, 6)), right["odometry"], right["closures"])


def loop(world: GraphWorld, one: int = 0, other: int = 1) -> Loops:
    closures = rows_of(world)
    return loops_between(closures[[one]], closures[[other]])


def test_exact_closures_on_exact_odometry_close() -> None:
    found = loop(closing(two_laps(noise=0), lap_pairs(10, 30)))
    np.testing.assert_allclose(found["residual"], 0, atol=1e-12)


@pytest.mark.parametrize("shift", [(3.0, 0, 0), (0, -2.0, 0), (1.0, 2.0, 2.0)])
def test_a_loop_misses_by_as_much_as_its_closure_is_wrong(shift: tuple[float, float, float]) -> None:
    world = closing(closing(two_laps(noise=0), lap_pairs(10)), lap_pairs(30), shift)
    found = loop(world)
    assert np.linalg.norm(found["residual"][0, 3:]) == pytest.approx(np.linalg.norm(shift))
    np.testing.assert_allclose(found["residual"][0, :3], 0, atol=1e-12)


def test_one_shift_of_the_world_closes_all_its_loops() -> None:
    found = loop(closing(two_laps(noise=0), lap_pairs(10, 30), (5.0, 3.0, 0)))
    np.testing.assert_allclose(found["residual"], 0, atol=1e-12)


@pytest.mark.parametrize("pairs", [[(10, 110), (35, 135)], [(35, 135), (10, 110)], [(10, 135), (35, 110)]])
def test_covariances_explain_the_misses_of_many_drives(pairs: list[tuple[int, int]]) -> None:
    rng, distances = np.random.default_rng(0), []
    lower = np.sqrt(np.diag(closing(two_laps(), pairs).closures[0].covariance))
    for seed in range(40):
        world = closing(two_laps(seed), pairs)
        for row, closure in enumerate(world.closures):
            noise = expmap((lower * rng.normal(size=6))[None])[0]
            world.closures[row] = closure._replace(pose=closure.pose @ noise)
        found = loop(world)
        distances += squared_mahalanobis(
            found["residual"], NoiseScale().covariances(found["odometry"], found["closures"])
        ).tolist()
    # a chi-square of six degrees of freedom: mean 6, and the mean of 40 has a deviation of 0.55
    assert 4.3 < np.mean(distances) < 7.7


def test_a_scale_widens_its_own_share_only() -> None:
    found = loop(closing(two_laps(), lap_pairs(10, 30)))
    walked, ends = found["odometry"], found["closures"]
    np.testing.assert_allclose(NoiseScale(odometry=3.0).covariances(walked, ends), 9 * walked + ends)
    np.testing.assert_allclose(NoiseScale(closures=2.0).covariances(walked, ends), walked + 4 * ends)


def test_the_longer_the_way_between_the_less_a_loop_says() -> None:
    world = closing(two_laps(), lap_pairs(10, 12, 60))
    near, far = loop(world, 0, 1), loop(world, 0, 2)
    assert np.trace(far["odometry"][0]) > 10 * np.trace(near["odometry"][0])
    np.testing.assert_allclose(np.trace(far["closures"][0, :3, :3]), np.trace(near["closures"][0, :3, :3]))


@pytest.mark.parametrize(("odometry", "closures"), [(3.0, 1.0), (5.0, 1.0), (1.0, 4.0), (0.4, 1.0), (3.0, 3.0)])
def test_factors_are_found(odometry: float, closures: float) -> None:
    scale = scale_of(loops(300, odometry, closures))
    assert (scale.odometry, scale.closures) == pytest.approx((odometry, closures), rel=0.3)


def test_well_stated_noise_is_left_exactly_alone() -> None:
    assert all(scale_of(loops(200, 1.0, 1.0, seed)) == NoiseScale() for seed in range(5))


@pytest.mark.parametrize("factor", [1.3, 0.75])
def test_a_slight_misstatement_is_not_worth_a_change(factor: float) -> None:
    assert scale_of(loops(300, factor, 1.0)).odometry == 1.0


@pytest.mark.parametrize("metres", [4.0, 40.0])
def test_wrong_closures_are_seen_through(metres: float) -> None:
    estimator = NoiseScaleEstimator()
    take(estimator, loops(150, 3.0, 1.0))
    take(estimator, wrong(150, metres), first_place=1000)
    assert estimator.scale.odometry == pytest.approx(3.0, rel=0.3)
    assert estimator.scale.closures == 1.0


def test_the_order_of_loops_does_not_matter() -> None:
    together, apart = NoiseScaleEstimator(), NoiseScaleEstimator()
    found = loops(60, 3.0, 1.0)
    together.add(found, found, 0)
    for row in reversed(range(60)):
        apart.add(found[row : row + 1], found[row : row + 1], 0)
    assert together.scale == apart.scale and apart.loops == 60


def test_few_loops_change_nothing() -> None:
    estimator = NoiseScaleEstimator()
    take(estimator, loops(9, 10.0, 1.0))
    assert estimator.scale == NoiseScale()
    estimator.add(np.empty(0, LOOP), np.empty(0, LOOP), 0)
    assert estimator.loops == 9


def test_one_place_does_not_make_all_closures_worse() -> None:
    """Two wrong groups that overlap miss each other by little there: it looks like the noise of closures."""
    one, found = NoiseScaleEstimator(), loops(200, 1.0, 4.0)
    one.add(found, found, 7)
    assert one.scale.closures == 1.0
    assert scale_of(found).closures == pytest.approx(4.0, rel=0.3)


def test_odometry_is_not_believed_to_be_much_better_than_it_says() -> None:
    assert scale_of(loops(300, 0.05, 1.0)) == NoiseScale(odometry=0.3)


def test_the_axis_that_drifts_decides() -> None:
    """Gravity keeps roll and pitch of a rover ten times as well as stated, but not the heading."""
    estimator, found = NoiseScaleEstimator(), loops(300, 0.1, 1.0)
    heading = loops(300, 1.0, 1.0, seed=1)["residual"][:, 2]
    latest = as_loops(found["residual"], found["odometry"], found["closures"])
    found["residual"][:, 2] = heading
    for row in range(0, 300, 3):
        estimator.add(latest[row : row + 3], found[row : row + 3], row)
    assert estimator.scale.odometry == 1.0


def test_other_units_keep_the_ratio_of_odometry_and_closures() -> None:
    scale = scale_of(loops(300, 0.02, 0.02))
    assert scale.odometry == pytest.approx(0.02, rel=0.3)
    assert scale.closures == scale.odometry


@pytest.mark.parametrize("stated", [1 / 3, 1.0, 3.0])
def test_the_scale_of_a_graph_is_found_among_wrong_closures(stated: float) -> None:
    world = with_wrong_closures(rover_loops(500, 15), 0.5, "random", 1)
    scale = drive(world, stated=stated).scale
    assert scale.odometry == pytest.approx(1 / stated, rel=0.4)
    assert scale.closures == 1.0


def test_a_graph_that_rejects_nothing_believes_what_it_is_told() -> None:
    world = rover_loops(500, 15)
    assert drive(world, SETTINGS.model_copy(update={"reject_outliers": False}), stated=3.0).scale == NoiseScale()


def test_a_few_closures_move_no_scale_of_a_graph() -> None:
    world = rover_loops(300, 12)
    graph = PoseGraph(SETTINGS)
    feed_odometry(graph, world, range(300), stated=3.0)
    for row in range(3):
        graph.add_closure(world.message(row))
    assert graph.scale == NoiseScale()
