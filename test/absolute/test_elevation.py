"""Elevation models from grids and GeoTIFF files, and their heights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from umf_ros.absolute.elevation import ElevationModel, load_elevation
from umf_ros.core.errors import ConfigError

ORIGIN = np.array([37.72, 15.0, 2550.0])


def plane(points: np.ndarray) -> np.ndarray:
    return 10 + 0.1 * points[:, 0] - 0.05 * points[:, 1]


def grid(cell: float) -> np.ndarray:
    """A plane over 0 to 200 m, rows northwards."""
    x = np.arange(0, 200, cell)
    return plane(np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)).reshape(len(x), len(x))


def check(model: ElevationModel, tolerance_m: float = 1e-6) -> None:
    points = np.random.default_rng(1).uniform(10, 180, (40, 2))
    heights, slopes, known = model.at(points)
    assert known.all() and np.allclose(heights, plane(points), atol=tolerance_m)
    assert np.allclose(slopes, [0.1, -0.05], atol=1e-3)
    assert not model.at(np.array([[-5.0, 50.0], [50.0, 400.0]]))[2].any()


def test_ascii_grid_by_centres_can_be_shifted(tmp_path: Path) -> None:
    head = "ncols 50\nnrows 50\nxllcenter 0\nyllcenter 0\ncellsize 4\nnodata_value -9999"
    np.savetxt(tmp_path / "model.asc", grid(4.0)[::-1], header=head, comments="")
    model = load_elevation(tmp_path / "model.asc", 0.3, None)
    check(model)
    moved = model.shifted(np.array([20.0, 10.0]))
    assert moved.at(np.array([[70.0, 60.0]]))[0] == pytest.approx(model.at(np.array([[50.0, 50.0]]))[0])


def test_ascii_grid(tmp_path: Path) -> None:
    rows = "\n".join(" ".join(f"{value:.6f}" for value in row) for row in grid(4.0)[::-1])
    head = "ncols 50\nnrows 50\nxllcorner -2\nyllcorner -2\ncellsize 4\nNODATA_value -9999\n"
    (tmp_path / "model.asc").write_text(head + rows.replace(f"{grid(4.0)[25, 25]:.6f}", "-9999"), encoding="ascii")
    model = load_elevation(tmp_path / "model.asc", 0.3, None)
    assert not model.at(np.array([[100.0, 100.0]]))[2].any()
    assert model.at(np.array([[20.0, 30.0]]))[0] == pytest.approx(plane(np.array([[20.0, 30.0]])), abs=1e-5)


def test_geotiff_in_utm(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    from rasterio.warp import transform

    east, north = transform("EPSG:4326", "EPSG:32633", [ORIGIN[1]], [ORIGIN[0]])
    placed = rasterio.transform.from_origin(east[0] - 2, north[0] + 198, 4, 4)
    profile = {"driver": "GTiff", "height": 50, "width": 50, "count": 1, "dtype": "float64", "transform": placed}
    with rasterio.open(tmp_path / "model.tif", "w", crs="EPSG:32633", **profile) as file:
        file.write(grid(4.0)[::-1], 1)
    # on the central meridian a metre of UTM is 0.9996 of one
    check(load_elevation(tmp_path / "model.tif", 0.3, ORIGIN), tolerance_m=0.02)
    with pytest.raises(ConfigError, match=r"pose_graph.origin is missing"):
        load_elevation(tmp_path / "model.tif", 0.3, None)


@pytest.mark.parametrize("name", ["missing.asc", "missing.tif", "text.asc"])
def test_a_file_that_is_no_model_is_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "text.asc").write_text("hello", encoding="ascii")
    with pytest.raises(ConfigError, match="elevation model") as error:
        load_elevation(tmp_path / name, 0.3, None)
    assert "\n" not in str(error.value)


def test_a_small_file_of_many_heights_is_refused(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    layout = {"driver": "GTiff", "dtype": "float32", "sparse_ok": True, "tiled": True}
    layout["transform"] = rasterio.transform.from_origin(0, 0, 1, 1)
    layouts = {
        "side.tif": {"width": 10_000, "height": 10_000, "count": 1},
        "block.tif": {"width": 4096, "height": 4096, "count": 20, "blockxsize": 4096, "blockysize": 4096},
    }
    for name, more in layouts.items():
        with rasterio.open(tmp_path / name, "w", **layout, **more):
            pass
    (tmp_path / "side.asc").write_text(
        "ncols 99999\nnrows 99999\nxllcorner 0\nyllcorner 0\ncellsize 1\nnodata_value 0\n1"
    )
    for name in (*layouts, "side.asc"):
        with pytest.raises(ConfigError, match="too large to be read") as caught:
            load_elevation(tmp_path / name, 0.3, None)
        assert "\n" not in str(caught.value)


def test_heights_of_another_datum_count_by_their_differences() -> None:
    model = ElevationModel(grid(4.0), np.array([[0.25, 0, 0], [0, 0.25, 0]]), 4.0, 0.3)
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, :2, 3] = np.random.default_rng(2).uniform(10, 180, (20, 2))
    poses[:, 2, 3] = plane(poses[:, :2, 3]) + 42.0
    poses[3, 2, 3] += 5.0
    assert np.allclose(model.misfits(poses, False)[0][:3], 42.0)
    missed, sigmas, known = model.misfits(poses, True)
    assert known.all() and np.flatnonzero(np.abs(missed) > 5 * sigmas).tolist() == [3]
    assert [make is None for make in model.planes(poses, True, 3.5)].count(True) == 1
