"""Closures with the odometry at their endpoints, as arrays."""

from __future__ import annotations

import numpy as np
from graph_worlds import chain_of, closing, lap_pairs, placed, rows_of, two_laps

from umf_ros.pose_graph.closures import as_closures
from umf_ros.pose_graph.consistency import paths_between


def test_distances_along_the_path_are_those_driven() -> None:
    closures = rows_of(closing(two_laps(noise=0), [(10, 110), (30, 150)]))
    match, query = paths_between(closures, closures[:1])
    # a metre is driven and 3.6 degrees are turned per pose
    step = 1 + 0.5 * 2 * np.pi / 100
    np.testing.assert_allclose(match, [0, 20 * step], rtol=1e-3)
    np.testing.assert_allclose(query, [0, 40 * step], rtol=1e-3)


def test_endpoints_in_different_sessions_are_infinitely_far() -> None:
    chains = [chain_of(two_laps()), chain_of(two_laps(1), session=1)]
    first, second = placed(closing(two_laps(), lap_pairs(10, 12)))
    other = as_closures(second._replace(query=1), 1, chains)
    match, query = paths_between(other, as_closures(first, 0, chains))
    assert np.isfinite(match).all() and query[0] == np.inf
