"""Endpoints of closures as arrays."""

from __future__ import annotations

import numpy as np
from graph_worlds import SETTINGS, chain_of, closing, lap_pairs, placed, two_laps

from umf_ros.lab.simulation.pose_graphs import GraphWorld
from umf_ros.pose_graph.closures import ClosureArrays
from umf_ros.pose_graph.odometry import OdometryChain


def arrays_of(world: GraphWorld) -> ClosureArrays:
    arrays, chain = ClosureArrays(), chain_of(world)
    for closure in placed(world):
        arrays.append([chain], closure)
    return arrays


def test_distances_along_the_path_are_those_driven() -> None:
    arrays = arrays_of(closing(two_laps(noise=0), [(10, 110), (30, 150)]))
    match, query = arrays.match.distances(0), arrays.query.distances(0)
    # a metre is driven and 3.6 degrees are turned per pose
    step = 1 + 0.5 * 2 * np.pi / 100
    np.testing.assert_allclose(match, [0, 20 * step], rtol=1e-3)
    np.testing.assert_allclose(query, [0, 40 * step], rtol=1e-3)


def test_endpoints_in_different_sessions_are_infinitely_far() -> None:
    arrays, chains = ClosureArrays(), [chain_of(two_laps()), chain_of(two_laps(1))]
    closures = placed(closing(two_laps(), lap_pairs(10, 12)))
    closures[1] = closures[1]._replace(query=1)
    for closure in closures:
        arrays.append(chains, closure)
    match, query = arrays.match.distances(0), arrays.query.distances(0)
    assert np.isfinite(match).all() and query[0] == 0 and query[1] == np.inf


def test_renewing_follows_odometry_that_came_late() -> None:
    world = closing(two_laps(), lap_pairs(10, 30))
    chain = OdometryChain(SETTINGS.model_copy(update={"max_gap_s": 100.0}))
    late = set(range(15, 25))
    for k in sorted(set(range(200)) - late):
        chain.add(k * 10**9, world.odometry[k])
    chain.update()
    arrays = ClosureArrays()
    for closure in placed(world):
        arrays.append([chain], closure)
    before = arrays.match.distances(0)[1]
    for k in late:
        chain.add(k * 10**9, world.odometry[k])
    assert chain.update()
    arrays.renew([chain])
    # the chord across the gap was shorter than the way
    assert arrays.match.distances(0)[1] > before + 0.05
