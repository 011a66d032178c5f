from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.levelling import upright


def normals(ground: int, walls: int, seed: int = 0) -> np.ndarray:
    """Of level ground and of walls that face everywhere, either sign, a little noisy."""
    rng = np.random.default_rng(seed)
    around = rng.uniform(0, 2 * np.pi, walls)
    up = np.tile([0.0, 0.0, 1.0], (ground, 1))
    all_of_them = np.vstack([up, np.column_stack([np.cos(around), np.sin(around), np.zeros(walls)])])
    noisy = all_of_them * rng.choice([-1, 1], (len(all_of_them), 1)) + rng.normal(0, 0.03, all_of_them.shape)
    return noisy / np.linalg.norm(noisy, axis=1, keepdims=True)


@pytest.mark.parametrize(("ground", "walls"), [(300, 0), (300, 300), (60, 900)])
@pytest.mark.parametrize("tilt_deg", [0.0, 8.0, 25.0])
def test_tilt_is_undone(ground: int, walls: int, tilt_deg: float) -> None:
    tilt = Rotation.from_rotvec(np.radians(tilt_deg) * np.array([0.6, -0.8, 0.0])).as_matrix()
    back = upright(normals(ground, walls) @ tilt.T)
    assert np.degrees(np.arccos(min((back @ tilt)[2, 2], 1.0))) < 1.5


def test_no_heading_is_added() -> None:
    tilt = Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    assert upright(normals(300, 300) @ tilt.T)[1, 0] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("known", [np.empty((0, 3)), np.zeros((500, 3)), normals(3, 500)])
def test_without_ground_the_body_is_taken_as_it_stands(known: np.ndarray) -> None:
    assert upright(known) == pytest.approx(np.eye(3))
