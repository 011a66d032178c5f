"""Where pulses go: each pattern against what its sensor's data sheet would say."""

from __future__ import annotations

import numpy as np
import pytest

from umf_ros.lab.simulation.domains.scanners import SCANNERS, dome, eye, rosette, spinning


def azimuth_deg(pattern):
    return np.degrees(np.arctan2(pattern.directions[:, 1], pattern.directions[:, 0]))


def elevation_deg(pattern):
    return np.degrees(np.arcsin(pattern.directions[:, 2]))


@pytest.mark.parametrize("name", SCANNERS)
def test_pulses_are_unit_vectors_in_the_order_of_their_times(name):
    pattern = SCANNERS[name].pattern(0.3)
    assert np.linalg.norm(pattern.directions, axis=1) == pytest.approx(1, abs=1e-5)
    assert (np.diff(pattern.moments) >= 0).all()
    assert pattern.moments[0] >= 0
    assert 0.95 < pattern.moments[-1] <= 1
    around = np.histogram(azimuth_deg(pattern), np.arange(-180, 181, 10))[0]
    assert (around > 0).all() == SCANNERS[name].all_round


def test_spinning_passes_the_front_in_the_middle_of_the_turn_from_left_to_right():
    pattern = spinning((-10.0, 0.0, 10.0), 360, 0.0)
    front = np.abs(azimuth_deg(pattern)) < 2
    assert pattern.moments[front] == pytest.approx(0.5, abs=0.01)
    left = np.abs(azimuth_deg(pattern) - 90) < 2
    assert pattern.moments[left] == pytest.approx(0.25, abs=0.01)
    assert np.unique(elevation_deg(pattern).round(3)) == pytest.approx([-10, 0, 10], abs=1e-3)


def test_eye_is_the_cube_seen_from_a_forward_left_up_frame():
    pattern = eye(0.0)
    assert np.abs(azimuth_deg(pattern)).max() == pytest.approx(35, abs=0.5)
    assert np.abs(elevation_deg(pattern)).max() == pytest.approx(15, abs=0.5)


def test_rosette_fills_its_cone_and_never_draws_the_same_twice():
    pattern, again = rosette(70.0, 20_000, 0.2), rosette(70.0, 20_000, 0.25)
    away = np.degrees(np.arccos(pattern.directions[:, 0]))
    assert away.max() == pytest.approx(35, abs=0.1)
    assert away.min() < 0.1
    assert not np.allclose(pattern.directions, again.directions, atol=0.05)


def test_dome_stays_between_its_elevations():
    pattern = dome(-7.0, 52.0, 30_000, 0.6)
    assert elevation_deg(pattern).min() == pytest.approx(-7, abs=0.2)
    assert elevation_deg(pattern).max() == pytest.approx(52, abs=0.2)
