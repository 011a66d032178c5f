"""Limits of a calibration, and sensors that they were not written for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from recordings import CALIBRATION, START_NS

from umf_ros.core.config import Sync
from umf_ros.lab.scan_files import UNCALIBRATED
from umf_ros.sensors.assembly import ScanLimits
from umf_ros.sensors.calibration import Calibration, load_calibration
from umf_ros.sensors.decode import Cloud
from umf_ros.sensors.synchronizer import Synchronizer


def limits(told: list[str], min_intensity: float = 0.0, max_height_m: float = math.inf) -> ScanLimits:
    calibration = Calibration(UNCALIBRATED.camera, np.eye(4), np.eye(4), np.eye(4), 0.0, min_intensity, max_height_m)
    return ScanLimits(calibration, told.append)


def scan(scale: float = 4095.0, count: int = 1000, height_m: float = 2.0) -> Cloud:
    """Intensities spread evenly up to the scale, a quarter of them 0."""
    rng = np.random.default_rng(5)
    points = rng.uniform((-20, -20, -height_m), (20, 20, height_m), (count, 3)).astype(np.float32)
    intensity = np.maximum(rng.uniform(-scale / 3, scale, count), 0).astype(np.float32)
    return Cloud(points, intensity, np.arange(count))


def test_no_limit_drops_nothing() -> None:
    told: list[str] = []
    cloud = scan()
    kept = limits(told).apply(cloud)
    assert cloud.intensity is not None and (cloud.intensity == 0).sum() > 200
    assert len(kept.points) == 1000 and told == []


def test_limits_drop_weak_and_far_returns_of_the_sensor_they_are_for() -> None:
    told: list[str] = []
    cloud = scan(height_m=10.0)
    kept = limits(told, min_intensity=15, max_height_m=7).apply(cloud)
    assert kept.intensity is not None and kept.time_offset_ns is not None and cloud.intensity is not None
    expected = (cloud.intensity > 15) & (np.abs(cloud.points[:, 2]) <= 7)
    np.testing.assert_array_equal(kept.time_offset_ns, np.flatnonzero(expected))
    assert told == []


@pytest.mark.parametrize("scale", [1.0, 0.0115, 15.0])
def test_an_intensity_limit_for_another_scale_is_not_applied_and_told_once(scale: float) -> None:
    told: list[str] = []
    both = limits(told, min_intensity=15)
    assert [len(both.apply(scan(scale)).points) for _ in range(3)] == [1000] * 3
    (line,) = told
    assert "min_intensity 15" in line and "100 %" in line and "not applied" in line


def test_a_scan_of_zeros_has_no_intensity() -> None:
    told: list[str] = []
    cloud = Cloud(scan().points, np.zeros(1000, np.float32))
    assert len(limits(told, min_intensity=15).apply(cloud).points) == 1000
    assert told == []


def test_without_intensities_the_limit_says_nothing() -> None:
    told: list[str] = []
    assert len(limits(told, min_intensity=15).apply(Cloud(scan().points)).points) == 1000
    assert told == []


def test_a_poor_scan_of_the_right_sensor_is_filtered_like_the_others() -> None:
    """As when a rover looks into the sky: what the limit is there for."""
    told: list[str] = []
    cube = limits(told, min_intensity=15)
    cube.apply(scan())
    sky = scan(scale=14.0, count=300)
    assert len(cube.apply(sky).points) == 0
    assert len(told) == 1 and "300 returns, none of them usable" in told[0]


def test_a_height_limit_along_another_axis_is_not_applied() -> None:
    told: list[str] = []
    assert len(limits(told, max_height_m=7).apply(scan(height_m=60.0)).points) == 1000
    (line,) = told
    assert "max_height_m 7" in line and "z axis" in line


@pytest.mark.parametrize("units", [100, 1000])
def test_points_in_other_units_are_told_once(units: int) -> None:
    told: list[str] = []
    metres, filtered = scan(), limits(told)
    for _ in range(3):
        filtered.apply(Cloud(metres.points * np.array([1, 1, 0], np.float32) + np.array([8, 0, 0], np.float32)))
    assert not told
    for _ in range(3):
        filtered.apply(Cloud((metres.points + np.array([8, 0, 0], np.float32)) * np.float32(units)))
    (line,) = told
    assert "in metres" in line


def test_limits_are_off_where_the_calibration_has_none(tmp_path) -> None:
    path = tmp_path / "calibration.yaml"
    without = "".join(line for line in CALIBRATION.splitlines(keepends=True) if not line.startswith(("min_", "max_")))
    path.write_text(without)
    found = load_calibration(path)
    assert (found.min_intensity, found.max_height_m) == (0, math.inf)
    path.write_text(without + "max_height_m: 0\n")
    assert load_calibration(path).max_height_m == math.inf


def test_the_shipped_limits_are_those_of_the_cube_1() -> None:
    for name in ("simulated", "s3li-etna", "s3li-vulcano"):
        calibration = load_calibration(name)
        assert (calibration.min_intensity, calibration.max_height_m) == (15, 7)


def test_frames_of_a_lidar_with_intensities_up_to_1_have_their_scan(tmp_path) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(CALIBRATION)
    told: list[str] = []
    synchronizer = Synchronizer(Sync(), load_calibration(path), {"cloud"}, told.append)
    synchronizer.add("cloud", START_NS, scan(1.0))
    (frame,) = synchronizer.flush()
    assert frame.points is not None and len(frame.points) == 1000
    assert len(told) == 1
