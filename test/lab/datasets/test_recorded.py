from __future__ import annotations

import numpy as np
import pytest

from umf_ros.lab.datasets.simulated import course, detours, path_length


def test_a_rover_heads_where_it_drives() -> None:
    angle = np.linspace(0, 2 * np.pi, 200)
    circle = 20 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    rotations = course(circle)
    heading = np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
    assert heading[5:-5] == pytest.approx(angle[5:-5] + np.pi / 2, abs=0.01)
    assert np.allclose(rotations[:, 2], [0, 0, 1])


def test_noise_of_centimetres_hardly_turns_it() -> None:
    rng = np.random.default_rng(0)
    line = np.stack([np.arange(0, 30, 0.1), np.zeros(300), np.zeros(300)], axis=1)
    rotations = course(line[::10] + 0.02 * rng.standard_normal((30, 3)))
    assert np.degrees(np.abs(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))).max() < 5


def test_a_standing_rover_has_a_heading_all_the_same() -> None:
    assert np.isfinite(course(np.zeros((4, 3)))).all()


def test_a_drive_is_a_pass_later_after_a_detour() -> None:
    path = np.stack([np.arange(0, 130, 30.0), np.zeros(5), np.zeros(5)], axis=1)
    assert path_length(path)[-1] == 120
    assert detours(path).tolist() == [0, 0.5, 1, 1.5, 2]
