"""Where pulses go: each pattern against what its sensor's data sheet would say."""

from __future__ import annotations

import numpy as np
import pytest

from umf_ros.lab.simulation.domains.scanners import SCANNERS, dome, eye, rosette, rotating_line, spinning


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


def test_mid360_sees_all_around_from_7_below_to_52_above_and_never_draws_the_same_twice():
    scanner = SCANNERS["mid360"]
    pattern, again = scanner.pattern(0.2), scanner.pattern(0.7)
    assert len(pattern.moments) == 20_000
    assert scanner.period_s == 0.1
    assert scanner.timed
    cells, _, _ = np.histogram2d(
        azimuth_deg(pattern), elevation_deg(pattern), [np.arange(-180, 181, 10), np.linspace(-7, 52, 11)]
    )
    assert cells.min() > 5
    assert np.abs(elevation_deg(pattern) - 22.5).max() == pytest.approx(29.5, abs=0.1)
    assert not np.allclose(pattern.directions, again.directions, atol=0.05)


def test_the_fast_sensor_turns_twenty_times_a_second_with_32_beams():
    scanner = SCANNERS["spin32_20hz"]
    assert scanner.period_s == 0.05
    beams = np.unique(elevation_deg(scanner.pattern(0.0)).round(2))
    assert len(beams) == 32
    assert (beams.min(), beams.max()) == pytest.approx((-16, 15), abs=0.01)


def test_a_rotating_line_covers_the_sphere_in_planes_that_contain_its_axis():
    pattern = rotating_line(270.0, 60, 541, 0.3)
    directions = pattern.directions.reshape(60, 541, 3).astype(float)
    along_axis = np.degrees(np.arcsin(directions[..., 1].clip(-1, 1)))
    assert np.abs(along_axis).max() == pytest.approx(90, abs=0.3)
    middle = directions[:, 270]  # of each line: once around the axis
    assert middle[:, 1] == pytest.approx(0, abs=1e-6)
    turned = np.unwrap(np.arctan2(middle[:, 2], middle[:, 0]))
    assert turned[0] - turned[-1] == pytest.approx(2 * np.pi * 59 / 60, abs=1e-3)
    assert np.degrees(np.arccos(np.einsum("ni,ni->n", directions[:, 0], middle))) == pytest.approx(135, abs=3)
    everywhere = np.random.default_rng(1).standard_normal((200, 3))
    everywhere /= np.linalg.norm(everywhere, axis=1, keepdims=True)
    nearest = (everywhere @ pattern.directions.T).max(axis=1)
    assert np.degrees(np.arccos(nearest.min())) < 4


def test_the_rotating_scanner_takes_one_to_two_seconds_for_its_turn():
    scanner = SCANNERS["rotating2d"]
    assert 1 <= scanner.period_s <= 2
    assert scanner.timed
