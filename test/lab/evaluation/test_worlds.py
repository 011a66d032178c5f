from __future__ import annotations

import numpy as np
import pytest

from umf_ros.core.geometry import wrap_angle
from umf_ros.lab.evaluation.worlds import FIRST, FIRST_SEEDS, FULL, OPPOSITE, QUICK, REVISIT, SAME_LIGHT, work
from umf_ros.lab.evaluation.worlds import test_worlds as make_worlds
from umf_ros.lab.simulation.world import TEST, TRAINING, VALIDATION


def test_the_four_worlds_differ_and_are_nobody_elses() -> None:
    worlds = make_worlds(FIRST_SEEDS["test"], QUICK)
    assert len({world.family for world in worlds}) == 4
    assert all(world.seed in TEST and world.seed not in TRAINING for world in worlds)
    assert FIRST_SEEDS["validation"] in VALIDATION


def test_the_passes_are_hard_in_the_way_they_say() -> None:
    world = make_worlds(FIRST_SEEDS["validation"], FULL)[0]
    first, revisit, same_light, opposite = (world.passes[i] for i in (FIRST, REVISIT, SAME_LIGHT, OPPOSITE))
    assert (revisit.sun.azimuth_deg - first.sun.azimuth_deg) % 360 == pytest.approx(70)
    assert same_light.sun == first.sun
    # the same path as the revisit, every other sample of it
    assert np.array_equal(same_light.path, revisit.path[::2])
    away = np.linalg.norm(revisit.path[:, None] - first.path[None], axis=2).min(axis=1)
    assert 2.5 < away.max() < 4.6
    nearest = np.linalg.norm(opposite.path[:, None] - first.path[None], axis=2).argmin(axis=1)
    turn = np.abs(wrap_angle(opposite.yaw - first.yaw[nearest]))
    assert np.degrees(turn).min() > 150
    assert len(first.path) == pytest.approx(2 * len(revisit.path), abs=1)
    quick = make_worlds(FIRST_SEEDS["validation"], QUICK)[0]
    assert work(quick) < 0.5 * work(world)
