"""Loops of two closures and the odometry between: what they miss closing by, and what explains it."""

from __future__ import annotations

import numpy as np
import pytest
from graph_worlds import SETTINGS, chain_of, closing, lap_pairs, tracked, two_laps

from umf_ros.lab.simulation.pose_graphs import World
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.ends import ClosureEnds, Cycles, Scale, cycles
from umf_ros.pose_graph.odometry import OdometryChain


def ends_of(world: World) -> ClosureEnds:
    ends, chain = ClosureEnds(), chain_of(world)
    for closure in tracked(world):
        ends.append([chain], closure)
    return ends


def loop(world: World, one: int = 0, other: int = 1) -> Cycles:
    return cycles(ends_of(world), np.array([one]), np.array([other]))


def test_exact_closures_on_exact_odometry_close() -> None:
    found = loop(closing(two_laps(noise=0), lap_pairs(10, 30)))
    np.testing.assert_allclose(found.residuals, 0, atol=1e-12)


@pytest.mark.parametrize("shift", [(3.0, 0, 0), (0, -2.0, 0), (1.0, 2.0, 2.0)])
def test_a_loop_misses_by_as_much_as_its_closure_is_wrong(shift: tuple[float, float, float]) -> None:
    world = closing(closing(two_laps(noise=0), lap_pairs(10)), lap_pairs(30), shift)
    found = loop(world)
    assert np.linalg.norm(found.residuals[0, 3:]) == pytest.approx(np.linalg.norm(shift))
    np.testing.assert_allclose(found.residuals[0, :3], 0, atol=1e-12)


def test_one_shift_of_the_world_closes_all_its_loops() -> None:
    found = loop(closing(two_laps(noise=0), lap_pairs(10, 30), (5.0, 3.0, 0)))
    np.testing.assert_allclose(found.residuals, 0, atol=1e-12)


@pytest.mark.parametrize("pairs", [[(10, 110), (35, 135)], [(35, 135), (10, 110)], [(10, 135), (35, 110)]])
def test_covariances_explain_the_misses_of_many_drives(pairs: list[tuple[int, int]]) -> None:
    rng, distances = np.random.default_rng(0), []
    lower = np.sqrt(np.diag(closing(two_laps(), pairs).closures[0].covariance))
    for seed in range(40):
        world = closing(two_laps(seed), pairs)
        for row, closure in enumerate(world.closures):
            noise = lie.exp((lower * rng.normal(size=6))[None])[0]
            world.closures[row] = closure._replace(pose=closure.pose @ noise)
        found = loop(world)
        distances += lie.mahalanobis(found.residuals, found.covariances(Scale())).tolist()
    # a chi-square of six degrees of freedom: mean 6, and the mean of 40 has a deviation of 0.55
    assert 4.3 < np.mean(distances) < 7.7


def test_a_scale_widens_its_own_share_only() -> None:
    found = loop(closing(two_laps(), lap_pairs(10, 30)))
    np.testing.assert_allclose(found.covariances(Scale(odometry=3.0)), 9 * found.odometry_noise + found.closure_noise)
    np.testing.assert_allclose(found.covariances(Scale(closures=2.0)), found.odometry_noise + 4 * found.closure_noise)


def test_the_longer_the_way_between_the_less_a_loop_says() -> None:
    world = closing(two_laps(), lap_pairs(10, 12, 60))
    near, far = loop(world, 0, 1), loop(world, 0, 2)
    assert np.trace(far.odometry_noise[0]) > 10 * np.trace(near.odometry_noise[0])
    np.testing.assert_allclose(np.trace(far.closure_noise[0, :3, :3]), np.trace(near.closure_noise[0, :3, :3]))


def test_distances_along_the_path_are_those_driven() -> None:
    match, query = ends_of(closing(two_laps(noise=0), [(10, 110), (30, 150)])).apart(0)
    # a metre is driven and 3.6 degrees are turned per pose
    step = 1 + 0.5 * 2 * np.pi / 100
    np.testing.assert_allclose(match, [0, 20 * step], rtol=1e-3)
    np.testing.assert_allclose(query, [0, 40 * step], rtol=1e-3)


def test_ends_in_different_sessions_are_infinitely_far() -> None:
    ends, chains = ClosureEnds(), [chain_of(two_laps()), chain_of(two_laps(1))]
    closures = tracked(closing(two_laps(), lap_pairs(10, 12)))
    closures[1].query = 1
    for closure in closures:
        ends.append(chains, closure)
    match, query = ends.apart(0)
    assert np.isfinite(match).all() and query[0] == 0 and query[1] == np.inf


def test_renewing_follows_odometry_that_came_late() -> None:
    world = closing(two_laps(), lap_pairs(10, 30))
    chain = OdometryChain(SETTINGS.model_copy(update={"max_gap_s": 100.0}))
    late = set(range(15, 25))
    for k in sorted(set(range(200)) - late):
        chain.add(k * 10**9, world.odometry[k])
    chain.update()
    ends = ClosureEnds()
    for closure in tracked(world):
        ends.append([chain], closure)
    before = ends.apart(0)[0][1]
    for k in late:
        chain.add(k * 10**9, world.odometry[k])
    assert chain.update()
    ends.renew([chain])
    # the chord across the gap was shorter than the way
    assert ends.apart(0)[0][1] > before + 0.05
