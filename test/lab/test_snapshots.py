"""Frames of single files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import CALIBRATION

from umf_ros.core.geometry import transform
from umf_ros.lab.scan_files import UNCALIBRATED, SensorFileError, fit_image, make_snapshot, read_image
from umf_ros.sensors.calibration import Calibration, load_calibration
from umf_ros.sensors.decode import Cloud

POINTS = np.array([[5, 1, 0.5], [8, -2, 1], [3, 0, 9]], np.float32)


@pytest.fixture
def calibration(tmp_path: Path) -> Calibration:
    path = tmp_path / "calibration.yaml"
    path.write_text(CALIBRATION)
    return load_calibration(path)


def test_without_a_calibration_a_scan_is_in_the_body_frame() -> None:
    frame = make_snapshot(Cloud(POINTS), stamp_ns=7)
    assert frame.points is not None and frame.stamp_ns == 7 and frame.intensity is None
    np.testing.assert_array_equal(frame.points, POINTS)
    np.testing.assert_array_equal(frame.body_T_lidar, np.eye(4))
    assert frame.odom_T_body is None and frame.left is None


def test_with_one_it_is_where_the_lidar_sits(calibration: Calibration) -> None:
    frame = make_snapshot(Cloud(POINTS, np.full(3, 50, np.float32)), calibration=calibration)
    assert frame.points is not None
    np.testing.assert_allclose(frame.points, transform(calibration.body_T_lidar, POINTS))
    np.testing.assert_array_equal(frame.body_T_lidar, calibration.body_T_lidar)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".pgm"])
def test_images_of_any_kind_become_grey(tmp_path: Path, suffix: str) -> None:
    grey = np.tile(np.linspace(20, 220, 64).astype(np.uint8), (48, 1))
    path = tmp_path / f"image{suffix}"
    cv2.imwrite(str(path), grey if suffix == ".pgm" else np.dstack([grey] * 3))
    found = read_image(path)
    assert found.shape == (48, 64) and found.dtype == np.uint8
    assert np.abs(found.astype(int) - grey).max() <= 3


def test_16_bit_images_keep_their_upper_byte(tmp_path: Path) -> None:
    upper = np.arange(256, dtype=np.uint16).reshape(16, 16)
    cv2.imwrite(str(tmp_path / "deep.png"), 256 * upper + 255)
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png"), upper)


def test_images_come_to_the_size_of_the_calibration(calibration: Calibration) -> None:
    large = np.repeat(np.repeat(np.arange(48 * 64, dtype=np.uint32).reshape(48, 64) % 251, 3, 0), 3, 1).astype(np.uint8)
    np.testing.assert_array_equal(fit_image(large, calibration), large[::3, ::3])
    frame = make_snapshot(None, fit_image(large, calibration), calibration=calibration)
    assert frame.left is not None and frame.left.shape == (48, 64) and frame.points is None
    with pytest.raises(SensorFileError, match="image of 80 x 48 pixels, the calibration is for 64 x 48"):
        fit_image(np.zeros((48, 80), np.uint8), calibration)
    assert fit_image(np.zeros((48, 80), np.uint8), UNCALIBRATED).shape == (48, 80)


def test_raw_images_are_rectified() -> None:
    calibration = load_calibration("s3li-vulcano")
    raw = np.random.default_rng(0).integers(0, 255, (1544, 2064), np.uint8)
    frame = make_snapshot(None, raw, raw, calibration)
    assert frame.left is not None and frame.right is not None
    assert frame.left.shape == frame.right.shape == (512, 688)


def test_what_is_no_image_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("no image")
    (tmp_path / "empty.png").touch()
    for name in ("text.png", "empty.png"):
        with pytest.raises(SensorFileError, match=f"{name} is no image"):
            read_image(tmp_path / name)
    with pytest.raises(SensorFileError, match=r"cannot read .*nowhere\.png"):
        read_image(tmp_path / "nowhere.png")
