"""Files of the ground, read back by the libraries that users read them with."""

import json
from pathlib import Path

import cv2
import geojson
import numpy as np
import rasterio
import yaml
from rasterio.warp import transform as to_crs

from umf_ros.absolute.elevation import load_elevation
from umf_ros.core.config import TerrainSettings
from umf_ros.core.geometry import Array, from_enu, make_pose, to_enu
from umf_ros.core.trajectory import write_geojson
from umf_ros.terrain.grid import FREE, OBSTACLE, UNKNOWN, make_grid, write_grid, write_terrain

SETTINGS = TerrainSettings()
ORIGIN = np.array([37.75, 14.99, 1800.0])


def hill(points: int = 40_000) -> Array:
    """A wedge from x = 10 to 22 m that is too steep from 18 m on; a corner without points."""
    xy = np.random.default_rng(1).uniform([10, -4], [22, 6], (points, 2))
    xy = xy[(xy[:, 0] > 12) | (xy[:, 1] > -2)]
    return np.column_stack([xy, 0.1 * xy[:, 0] + 0.9 * np.maximum(xy[:, 0] - 18, 0)])


def test_navigation_reads_the_grid_as_it_was(tmp_path: Path) -> None:
    tiles = make_grid(hill(), SETTINGS)
    assert write_grid(tmp_path, tiles, SETTINGS.max_cells) == "map.yaml, map.pgm"
    grid = tiles.overview(SETTINGS.max_cells)
    about = yaml.safe_load((tmp_path / "map.yaml").read_text())
    image = cv2.imread(str(tmp_path / about["image"]), cv2.IMREAD_UNCHANGED)
    # the rule of Nav2's map_server in the mode trinary
    occupied = (255 - image.astype(float)) / 255
    read = np.where(occupied > about["occupied_thresh"], 100, np.where(occupied < about["free_thresh"], 0, -1))[::-1]
    assert about["mode"] == "trinary" and about["negate"] == 0 and about["resolution"] == grid.cell_m
    np.testing.assert_allclose(about["origin"], [*grid.lower, 0.0], atol=1e-6)
    for value in (FREE, OBSTACLE):
        np.testing.assert_array_equal(read == value, grid.cells == value)
        assert (read == value).any()
    assert (read[grid.cells == UNKNOWN] == -1).all() and (grid.cells == UNKNOWN).any()


def test_heights_are_where_they_are_on_earth(tmp_path: Path) -> None:
    turn = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [100.0, 50.0, 3.0])
    assert write_terrain(tmp_path, hill(), SETTINGS, (turn, ORIGIN)) == "map.yaml, map.pgm, elevation.tif"
    place = turn @ [14.1, 2.1, 1.41, 1.0]  # on the wedge
    latitude, longitude, height = from_enu(place[None, :3], ORIGIN)[0]
    with rasterio.open(tmp_path / "elevation.tif") as file:
        x, y = to_crs("EPSG:4326", file.crs, [longitude], [latitude])
        (read,) = next(file.sample([(x[0], y[0])]))
        assert np.isnan(next(file.sample([(x[0] + 1000, y[0])]))[0]) and np.isnan(file.nodata)
    assert abs(read - height) < 0.05
    # it is an elevation model for the pose graph too
    model = load_elevation(tmp_path / "elevation.tif", 0.5, ORIGIN)
    heights, slopes, known = model.at(place[None, :2])
    assert known[0] and abs(heights[0] - height) < 0.05 and abs(np.linalg.norm(slopes[0]) - 0.1) < 0.1


def test_without_an_origin_heights_are_in_the_map(tmp_path: Path) -> None:
    write_terrain(tmp_path, hill(), SETTINGS)
    with rasterio.open(tmp_path / "elevation.tif") as file:
        assert file.crs is None
        assert abs(next(file.sample([(14.1, 2.1)]))[0] - 1.41) < 0.05


def test_nothing_is_written_about_no_ground(tmp_path: Path) -> None:
    assert "no ground is known" in write_terrain(tmp_path, np.empty((0, 3)), SETTINGS)
    assert not list(tmp_path.iterdir())


def test_trajectories_are_valid_geojson(tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 100.0, 200.0]
    write_geojson(
        tmp_path / "a.geojson", {"drive": poses, "one pose": poses[:1]}, make_pose(np.eye(3), [0, 5, 1]), ORIGIN
    )
    read = geojson.loads((tmp_path / "a.geojson").read_text())
    assert read.is_valid and [one.properties["name"] for one in read.features] == ["drive"]
    line = np.array(json.loads((tmp_path / "a.geojson").read_text())["features"][0]["geometry"]["coordinates"])
    found = to_enu(line[:, [1, 0, 2]], ORIGIN)
    np.testing.assert_allclose(found, [[0, 5, 1], [100, 5, 1], [200, 5, 1]], atol=1e-3)


def test_a_large_map_says_how_it_was_limited_and_keeps_all_heights(tmp_path: Path) -> None:
    steps = np.arange(0.0, 300.0, 0.1)
    strip = np.concatenate([np.column_stack([steps, steps + aside, 0.1 * steps]) for aside in np.arange(-4, 4, 0.1)])
    settings = TerrainSettings(max_cells=250_000)
    written = write_terrain(tmp_path, strip - [100.0, 40.0, 0.0], settings)
    assert "in cells of 0.8 m instead of 300 x 308 m in cells of 0.2 m, by terrain.max_cells" in written
    about = yaml.safe_load((tmp_path / "map.yaml").read_text())
    image = cv2.imread(str(tmp_path / "map.pgm"), cv2.IMREAD_UNCHANGED)
    assert about["resolution"] == 0.8 and image.size <= 250_000 and (image == 254).any()
    with rasterio.open(tmp_path / "elevation.tif") as file:
        assert file.shape == (1540, 1500) and file.block_shapes == [(256, 256)]
        heights = file.read(1)
        places = np.column_stack([steps, steps])[3::97] - [100.0, 40.0] + 0.05
        read = np.concatenate(list(file.sample(places)))
    np.testing.assert_allclose(read, 0.1 * (places[:, 0] + 100), atol=0.05)
    assert np.isnan(heights).mean() > 0.9
    assert (tmp_path / "elevation.tif").stat().st_size < 0.1 * heights.nbytes  # empty blocks take no space


def test_a_map_too_wide_for_a_geotiff_is_still_a_map(tmp_path: Path) -> None:
    written = write_terrain(tmp_path, np.concatenate([hill(), [[1e6, 1e6, 0.0]]]), TerrainSettings(max_cells=10_000))
    assert "no elevation.tif" in written and "terrain.cell_m" in written
    assert cv2.imread(str(tmp_path / "map.pgm"), cv2.IMREAD_UNCHANGED).size <= 10_000
