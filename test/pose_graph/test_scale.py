"""How wrong stated covariances are, found from loops drawn with known noise."""

from __future__ import annotations

import numpy as np
import pytest
from graph_worlds import SETTINGS, drive, feed_odometry

from umf_ros.geometry import Array
from umf_ros.lab.simulation.pose_graphs import rover_loops, with_wrong_closures
from umf_ros.pose_graph.ends import Cycles, Scale
from umf_ros.pose_graph.graph import PoseGraph
from umf_ros.pose_graph.scale import ScaleEstimator


def covariances(rng: np.random.Generator, count: int, turn_rad: float, metres: float) -> Array:
    """Spread-out covariances about the given standard deviations."""
    roots = np.eye(6) + 0.3 * rng.normal(size=(count, 6, 6))
    lower = np.array([turn_rad] * 3 + [metres] * 3)[:, None] * roots * rng.uniform(0.5, 2.0, (count, 1, 1))
    return lower @ np.swapaxes(lower, -1, -2)


def loops(count: int, odometry: float, closures: float, seed: int = 0) -> Cycles:
    """Loops whose true deviations are the stated ones times the factors."""
    rng = np.random.default_rng(seed)
    walk, ends = covariances(rng, count, 0.01, 0.15), covariances(rng, count, 0.01, 0.07)
    lower = np.linalg.cholesky(odometry**2 * walk + closures**2 * ends)
    return Cycles((lower @ rng.normal(size=(count, 6, 1)))[..., 0], walk, ends)


def take(estimator: ScaleEstimator, cycles: Cycles, first_place: int = 0) -> None:
    """Ten loops of each place."""
    for start in range(0, len(cycles.residuals), 10):
        keep = slice(start, start + 10)
        part = Cycles(cycles.residuals[keep], cycles.odometry_noise[keep], cycles.closure_noise[keep])
        estimator.add(part, first_place + start)


def wrong(count: int, metres: float) -> Cycles:
    cycles = loops(count, 1.0, 1.0, seed=9)
    rng = np.random.default_rng(10)
    return Cycles(rng.normal(0, [0.3] * 3 + [metres] * 3, (count, 6)), cycles.odometry_noise, cycles.closure_noise)


@pytest.mark.parametrize(("odometry", "closures"), [(3.0, 1.0), (5.0, 1.0), (1.0, 4.0), (0.4, 1.0), (3.0, 3.0)])
def test_factors_are_found(odometry: float, closures: float) -> None:
    estimator = ScaleEstimator()
    take(estimator, loops(300, odometry, closures))
    assert estimator.scale.odometry == pytest.approx(odometry, rel=0.3)
    assert estimator.scale.closures == pytest.approx(closures, rel=0.3)


def test_well_stated_noise_is_left_exactly_alone() -> None:
    for seed in range(5):
        estimator = ScaleEstimator()
        take(estimator, loops(200, 1.0, 1.0, seed))
        assert estimator.scale == Scale()


@pytest.mark.parametrize("factor", [1.3, 0.75])
def test_a_slight_misstatement_is_not_worth_a_change(factor: float) -> None:
    estimator = ScaleEstimator()
    take(estimator, loops(300, factor, 1.0))
    assert estimator.scale.odometry == 1.0


@pytest.mark.parametrize("metres", [4.0, 40.0])
def test_wrong_closures_are_seen_through(metres: float) -> None:
    estimator = ScaleEstimator()
    take(estimator, loops(150, 3.0, 1.0))
    take(estimator, wrong(150, metres), first_place=1000)
    assert estimator.scale.odometry == pytest.approx(3.0, rel=0.3)
    assert estimator.scale.closures == 1.0


def test_the_order_of_loops_does_not_matter() -> None:
    together, apart = ScaleEstimator(), ScaleEstimator()
    cycles = loops(60, 3.0, 1.0)
    together.add(cycles, 0)
    for row in reversed(range(60)):
        keep = slice(row, row + 1)
        apart.add(Cycles(cycles.residuals[keep], cycles.odometry_noise[keep], cycles.closure_noise[keep]), 0)
    assert together.scale == apart.scale and apart.loops == 60


def test_few_loops_change_nothing() -> None:
    estimator = ScaleEstimator()
    take(estimator, loops(9, 10.0, 1.0))
    assert estimator.scale == Scale()
    estimator.add(Cycles(np.empty((0, 6)), np.empty((0, 6, 6)), np.empty((0, 6, 6))), 0)
    assert estimator.loops == 9


def test_one_place_does_not_make_all_closures_worse() -> None:
    """Two wrong groups that overlap miss each other by little there: it looks like the noise of closures."""
    one, many = ScaleEstimator(), ScaleEstimator()
    one.add(loops(200, 1.0, 4.0), 7)
    take(many, loops(200, 1.0, 4.0))
    assert one.scale.closures == 1.0
    assert many.scale.closures == pytest.approx(4.0, rel=0.3)


def test_odometry_is_not_believed_to_be_much_better_than_it_says() -> None:
    estimator = ScaleEstimator()
    take(estimator, loops(300, 0.05, 1.0))
    assert estimator.scale == Scale(odometry=0.3)


def test_other_units_keep_the_ratio_of_odometry_and_closures() -> None:
    estimator = ScaleEstimator()
    take(estimator, loops(300, 0.02, 0.02))
    scale = estimator.scale
    assert scale.odometry == pytest.approx(0.02, rel=0.3)
    assert scale.closures == scale.odometry


@pytest.mark.parametrize("stated", [1 / 3, 1.0, 3.0])
def test_the_scale_of_a_graph_is_found_among_wrong_closures(stated: float) -> None:
    world = with_wrong_closures(rover_loops(500, 15), 0.5, "random", 1)
    scale = drive(world, stated=stated).scale
    assert scale.odometry == pytest.approx(1 / stated, rel=0.4)
    assert scale.closures == 1.0


def test_a_graph_that_may_not_estimate_believes_what_it_is_told() -> None:
    world = rover_loops(500, 15)
    assert drive(world, SETTINGS.model_copy(update={"estimate_scale": False}), stated=3.0).scale == Scale()


def test_a_few_closures_move_no_scale_of_a_graph() -> None:
    world = rover_loops(300, 12)
    graph = PoseGraph(SETTINGS)
    feed_odometry(graph, world, range(300), stated=3.0)
    for row in range(3):
        graph.add_closure(world.message(row))
    assert graph.scale == Scale()
