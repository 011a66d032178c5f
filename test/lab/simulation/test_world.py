"""Rocks, horizon and light of a whole world."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from umf_ros.core.geometry import make_pose
from umf_ros.lab.simulation.camera import Camera, Shader, Sun, cast
from umf_ros.lab.simulation.relief import SIZE_M
from umf_ros.lab.simulation.world import GROUND, HORIZON, ROCK, grid_triangles, scatter_rocks

NOWHERE = np.empty((0, 2))


def centres(mesh) -> np.ndarray:
    """(rocks, 2) places of the rocks of a mesh."""
    rock = mesh.instance
    corner = mesh.vertices[mesh.triangles[:, 0]]
    counts = np.maximum(np.bincount(rock), 1)
    return np.stack([np.bincount(rock, corner[:, axis]) / counts for axis in range(2)], 1)


def test_rocks_are_many_and_mostly_small(drive):
    mesh = drive.world.solids[ROCK]
    low = np.full(mesh.instance.max() + 1, np.inf)
    high = np.full_like(low, -np.inf)
    corner = mesh.vertices[mesh.triangles[:, 0], 0]
    np.minimum.at(low, mesh.instance, corner)
    np.maximum.at(high, mesh.instance, corner)
    widths = (high - low)[np.isfinite(high - low)]
    assert len(widths) > 5000
    assert np.median(widths) < 0.35 and widths.max() > 1.5
    assert (widths > 0.4).sum() > 2 * (widths > 0.8).sum()  # each doubling of the size leaves far fewer


def test_rocks_stand_on_the_ground(drive):
    mesh = drive.world.solids[ROCK]
    place = mesh.vertices[::97]
    above = place[:, 2] - drive.world.relief.height(place[:, 0], place[:, 1])
    assert above.min() > -2.5 and above.max() < 4.5 and abs(np.median(above)) < 0.2


def test_normals_point_outwards(drive):
    mesh = drive.world.solids[ROCK]
    first = mesh.instance == mesh.instance[0]
    used = np.unique(mesh.triangles[first])
    outward = mesh.vertices[used] - mesh.vertices[used].mean(axis=0)
    assert np.mean((outward * mesh.normals[used]).sum(axis=1) > 0) > 0.95
    assert np.allclose(np.linalg.norm(mesh.normals[used], axis=1), 1, atol=1e-5)


def test_aliasing_repeats_clusters_of_rocks(drive):
    """With the knob turned up, many rocks have neighbours in exactly the same arrangement as others."""
    shares = []
    for aliasing in (0.0, 1.0):
        mesh = scatter_rocks(drive.world.relief, np.random.default_rng(1), aliasing, NOWHERE)
        place = centres(mesh)[-4000:]  # clusters come last
        tree = cKDTree(place)
        gap = np.round(tree.query(place, k=2)[0][:, 1], 3)
        _, count = np.unique(gap, return_counts=True)
        shares.append(count[count > 15].sum() / len(gap))
    assert shares[1] > shares[0] + 0.1


def test_no_rock_lies_on_the_way_it_is_kept_clear_of(drive):
    path = np.stack([np.linspace(-30, 30, 200), np.zeros(200)], 1)
    free = scatter_rocks(drive.world.relief, np.random.default_rng(1), 0.0, path)
    full = scatter_rocks(drive.world.relief, np.random.default_rng(1), 0.0, NOWHERE)
    near = [(cKDTree(path).query(mesh.vertices[:, :2])[0] < 0.5).sum() for mesh in (free, full)]
    assert near[0] < 0.6 * near[1]


def test_the_edge_of_the_ground_is_never_seen(drive):
    """Level rays from the middle end on ground or mountains or in the sky, never below the world."""
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    for tilt in (-0.05, -0.02, 0.0):
        directions = np.stack([np.cos(angles), np.sin(angles), np.full(720, tilt)], 1)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        height = float(drive.world.relief.height(0, 0)) + 1.4
        hits = cast(drive.world, np.array([0, 0, height]), directions.astype(np.float32))
        seen = np.isfinite(hits.distance)
        bottom = height + directions[seen, 2] * hits.distance[seen]
        assert bottom.min() > -40
        assert set(np.unique(hits.geometry[seen])) <= {GROUND, HORIZON, ROCK}
        inside = np.abs(directions[seen] * hits.distance[seen, None])[:, :2].max(axis=1) < SIZE_M * 0.48
        assert not (hits.geometry[seen][inside] == HORIZON).any()


def test_shadows_fall_away_from_the_sun(drive):
    """A flat picture from above: what is lit turns with the sun, and a low sun leaves more in the dark."""
    shader_low, shader_high = (Shader(drive.world, Sun(40, elevation)) for elevation in (8, 60))
    x, y = np.meshgrid(np.linspace(-20, 20, 64), np.linspace(-20, 20, 64))
    origins = np.stack([x, y, np.full_like(x, 60)], -1).reshape(-1, 3).astype(np.float32)
    down = np.tile(np.float32([0, 0, -1]), (len(origins), 1))
    hits = cast(drive.world, origins, down)
    place = [np.ascontiguousarray(origins[:, 0]), np.ascontiguousarray(origins[:, 1]), 60 - hits.distance]
    lit = []
    for shader in (shader_low, shader_high):
        answer = np.zeros(len(origins), np.float32)
        shader._test_sun(answer, np.arange(len(origins)), hits, hits.distance, tuple(place))
        lit.append(answer.mean())
    assert lit[0] < lit[1] and lit[1] > 0.8


def test_adaptive_shadows_agree_with_testing_every_pixel(drive, monkeypatch):
    camera = Camera(drive.world, drive.calibration.camera)
    pose = drive.pose(drive.exposures[5].stamp_ns) @ drive.calibration.body_T_camera
    fast = camera.take(pose, Sun(70, 20), np.random.default_rng(0)).image
    monkeypatch.setattr("umf_ros.lab.simulation.shading._LARGE_PX", 10_000)
    exact = camera.take(pose, Sun(70, 20), np.random.default_rng(0)).image
    assert np.mean(np.abs(fast.astype(int) - exact) > 8) < 0.01


def test_a_camera_that_looks_up_sees_only_sky(drive):
    camera = Camera(drive.world, drive.calibration.camera)
    picture = camera.take(make_pose(np.eye(3), [0, 0, 50]), Sun(0, 30), np.random.default_rng(0))
    assert (picture.depth == 0).all() and (picture.semantic == 255).all()
    assert cv2.GaussianBlur(picture.image, (0, 0), 5).std() < 60


def test_the_sun_moves_on_and_stays_above_the_horizon():
    sun = Sun(350, 12)
    assert sun.moved(30).azimuth_deg == pytest.approx(20)
    assert all(10 <= sun.moved(hours).elevation_deg <= 60 for hours in range(0, 360, 10))
    assert np.linalg.norm(sun.direction) == pytest.approx(1, abs=1e-6)
    assert Sun(90, 0).direction == pytest.approx([0, 1, 0], abs=1e-6)


def test_a_grid_is_covered_once_by_its_triangles():
    triangles = grid_triangles(4)
    place = np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 2)
    a, b, c = (place[triangles[:, corner]].astype(float) for corner in range(3))
    area = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert (area > 0).all() and area.sum() == pytest.approx(9)
