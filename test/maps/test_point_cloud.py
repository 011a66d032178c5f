from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from umf_ros.lab.scan_files import parse_pcd, parse_ply
from umf_ros.maps.outputs import CLOUD, thickness, thin, write_points
from umf_ros.runs.scene import HeightMap


def ground(offset_m: float, noise_m: float = 0.01) -> NDArray[np.void]:
    """A rolling ground that two sessions saw, the second one lifted."""
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 8, (2, 6000, 2))
    z = 0.3 * np.sin(xy[..., 0]) + noise_m * rng.standard_normal(xy.shape[:2]) + np.array([[0.0], [offset_m]])
    cloud = np.empty(12_000, CLOUD)
    cloud["point"], cloud["session"] = (
        np.concatenate([xy, z[..., None]], axis=-1).reshape(-1, 3),
        np.repeat([0, 1], 6000),
    )
    return cloud


def test_misaligned_sessions_make_thick_surfaces() -> None:
    together, apart = thickness(ground(0.0)), thickness(ground(0.3))
    assert together < 0.06 < 0.12 < apart


def test_a_single_session_has_no_thickness() -> None:
    alone = ground(0.0)
    alone["session"] = 0
    assert np.isnan(thickness(alone)) and np.isnan(thickness(alone[:0]))


def test_thinning_leaves_one_point_a_voxel() -> None:
    cloud = ground(0.0)
    thinned = thin(cloud, 0.5)
    cells = np.floor(thinned["point"] / 0.5).astype(int)
    assert len(np.unique(cells, axis=0)) == len(thinned) < 800
    assert len(np.unique(np.floor(cloud["point"] / 0.5).astype(int), axis=0)) == len(thinned)
    assert len(thin(cloud[:0])) == 0


def test_files_are_read_back_as_they_were(tmp_path: Path) -> None:
    cloud = ground(0.0)
    write_points(tmp_path / "a.ply", cloud)
    write_points(tmp_path / "a.pcd", cloud)
    for columns in (parse_ply((tmp_path / "a.ply").read_bytes()), parse_pcd((tmp_path / "a.pcd").read_bytes())):
        found = np.stack([columns[name] for name in "xyz"], axis=1)
        np.testing.assert_array_equal(found, cloud["point"])
        np.testing.assert_array_equal(columns["session"], cloud["session"])


def test_the_picture_shows_the_ground() -> None:
    heights = HeightMap(np.array([[0.0, 0.0], [10.0, 4.0]]))
    assert heights.draw() is None
    heights.add(ground(0.0)["point"].astype(float))
    drawn = heights.draw()
    assert drawn is not None and drawn[0].shape[2] == 4 and drawn[1][0] < drawn[1][1]
    heights.add(np.array([[1e6, 0, 0.0]]))  # far outside: left out
    again = heights.draw()
    assert again is not None and np.array_equal(again[0], drawn[0]) and again[1] == drawn[1]
