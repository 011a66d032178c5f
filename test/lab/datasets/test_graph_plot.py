"""The picture of a pose graph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from graph_worlds import closing, content_of, lap_pairs, two_laps

from umf_ros.lab.datasets.g2o import G2oGraph
from umf_ros.lab.datasets.graph_recording import as_recording, plot_graph

WORLD = closing(closing(two_laps(), lap_pairs(*range(0, 90, 6)), noise=1.0), lap_pairs(47), (5.0, 5.0, 0))


@pytest.mark.parametrize(("lift_m", "views"), [(0.0, 1), (5.0, 2)])
def test_a_picture_shows_the_side_only_where_there_is_height(tmp_path: Path, lift_m: float, views: int) -> None:
    from matplotlib.image import imread

    content = content_of(WORLD)
    for vertex, pose in content.poses.items():
        pose[2, 3] = lift_m * np.sin(vertex / 20)
    plot_graph(as_recording(content), content.poses, tmp_path / "a.png")
    height, width = imread(tmp_path / "a.png").shape[:2]
    assert width / height == pytest.approx(views * 7 / 6.5, rel=0.01)


def test_a_picture_of_thousands_of_closures_still_shows_the_path(tmp_path: Path) -> None:
    from matplotlib.image import imread

    pairs = [(a, b) for a in range(0, 100, 2) for b in range(100, 200, 2)]
    content = content_of(closing(two_laps(), pairs))
    plot_graph(as_recording(content), content.poses, tmp_path / "a.png")
    image = imread(tmp_path / "a.png")[..., :3]
    dark = (image.max(axis=-1) < 0.45).sum()
    pure_green = ((image - [0.17, 0.63, 0.17]) ** 2).sum(axis=-1) < 0.01
    assert dark > 2000 and pure_green.mean() < 0.2


def test_a_picture_of_edges_alone_is_composed_from_odometry(tmp_path: Path) -> None:
    content = content_of(WORLD)
    plot_graph(as_recording(G2oGraph({}, content.edges)), {}, tmp_path / "a.png")
    plot_graph(as_recording(content), content.poses, tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
