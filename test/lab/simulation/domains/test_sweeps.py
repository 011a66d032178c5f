"""One scan against the scene it was taken of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import interpolate, make_pose, transform
from umf_ros.lab.simulation.domains.scanners import SCANNERS, stamp_moment, sweep
from umf_ros.lab.simulation.domains.solids import Solids

START = make_pose(np.eye(3), [0.0, 0.0, 1.5])
END = START @ make_pose(Rotation.from_euler("z", 8, degrees=True).as_matrix(), [0.8, 0.0, 0.0])


@pytest.fixture(scope="module")
def room():
    solids = Solids()
    solids.slab([-9, -7], [9, 7], 0.0, reflectance=0.3)
    solids.ribbon(np.array([[-9, -7], [9, -7], [9, 7], [-9, 7], [-9, -7]]), 0.0, 8.0, reflectance=0.6)
    return solids.scene()


def off(scene, sweep, pose):
    """Median distance of the points from the scene when seen from a pose."""
    points = transform(pose, sweep.points.astype(float)).astype(np.float32)
    return float(np.median(scene.rays.compute_distance(o3d.core.Tensor.from_numpy(points)).numpy()))


def moving(moment):
    return interpolate(START, END, moment)


@pytest.mark.parametrize("name", SCANNERS)
def test_a_standing_sensor_measures_the_scene_to_its_noise(name, room):
    found = sweep(SCANNERS[name], room, lambda moment: START, np.random.default_rng(1))
    assert len(found.points) > 5000
    assert off(room, found, START) < 1.2 * SCANNERS[name].noise_m


def test_times_per_point_take_the_motion_out(room):
    scanner = replace(SCANNERS["spin16"], noise_m=0.0)
    timed = sweep(scanner, room, moving, np.random.default_rng(1))
    untimed = sweep(replace(scanner, timed=False), room, moving, np.random.default_rng(1))
    assert off(room, timed, START) < 0.01
    assert off(room, untimed, interpolate(START, END, 0.5)) > 0.04
    assert stamp_moment(scanner) == 0
    assert timed.offset_s.max() == pytest.approx(scanner.period_s, rel=0.05)
    assert untimed.offset_s is None


def test_intensity_comes_in_the_sensors_own_scale_or_not_at_all(room):
    scans = {
        name: sweep(scanner, room, lambda moment: START, np.random.default_rng(1)) for name, scanner in SCANNERS.items()
    }
    assert scans["solid360"].intensity is None
    assert 0.3 < scans["spin64"].intensity.max() <= 1
    assert 50 < scans["spin16"].intensity.max() <= 255


def test_nothing_returns_from_beyond_the_range(room):
    near = replace(SCANNERS["spin16"], range_m=7.5)
    found = sweep(near, room, lambda moment: START, np.random.default_rng(1))
    assert np.linalg.norm(found.points, axis=1).max() < 7.7
