"""Rovers of strange kinds: what their sensors make of a frame, and where they are mounted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import make_frame
from support.strange_rovers import ROVERS, Rover, StrangeSensors, calibration_of

from umf_ros.core.frames import Frame, ScanMotion
from umf_ros.sensors.calibration import load_calibration

COUNT = 600


@pytest.fixture
def frame() -> Frame:
    rng = np.random.default_rng(0)
    bearing, away = rng.uniform(-0.6, 0.6, COUNT), rng.uniform(3, 30, COUNT)
    made = make_frame(1.0)
    at = made.body_T_lidar[:3, 3]
    points = at + np.column_stack([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-1, 1, COUNT)])
    motion = ScanMotion(np.linspace(0, 0.2, COUNT, dtype=np.float32), np.zeros(6), np.zeros(6))
    return replace(
        made,
        left=np.full((40, 60), 128, np.uint8),
        points=points.astype(np.float32),
        intensity=rng.uniform(20, 900, COUNT).astype(np.float32),
        motion=motion,
    )


@pytest.mark.parametrize("rover", ROVERS)
def test_a_scan_keeps_a_part_of_the_pulses_with_their_moments(rover: Rover, frame: Frame) -> None:
    seen = StrangeSensors(rover, 1).see(frame)
    assert seen.points is not None and seen.motion is not None and frame.points is not None
    assert COUNT / rover.every * 0.5 < len(seen.points) <= COUNT / rover.every
    assert len(seen.motion.moments_s) == len(seen.points) and np.all(np.diff(seen.motion.moments_s) > 0)
    kept = np.searchsorted(np.linspace(0, 0.2, COUNT, dtype=np.float32), seen.motion.moments_s)
    moved = seen.points - frame.points[kept]
    along = frame.points[kept] - frame.body_T_lidar[:3, 3]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    shift = (moved * along).sum(axis=1)
    assert 0.7 * rover.noise_m < shift.std() < 1.3 * rover.noise_m
    np.testing.assert_allclose(moved, shift[:, None] * along, atol=1e-4)
    bearing = np.degrees(np.arctan2(-frame.points[kept, 1], frame.points[kept, 0]))
    assert bearing.max() < rover.right_deg
    assert seen.intensity is None if not rover.unit else seen.intensity is not None


def test_a_lens_darkens_the_corners_and_a_response_the_rest(frame: Frame) -> None:
    rover = replace(ROVERS[0], gamma=2.0, dark=0.5)
    seen = StrangeSensors(rover, 1).see(replace(frame, points=None, intensity=None, motion=None))
    assert seen.left is not None and seen.points is None
    assert seen.left[20, 30] == pytest.approx(255 * (128 / 255) ** 2, abs=1.5)
    assert seen.left[0, 0] == pytest.approx(255 * (128 / 255 * 0.5) ** 2, abs=1.5)


def test_the_rig_is_lowered_and_the_camera_tilted(tmp_path: Path) -> None:
    rover = replace(ROVERS[1], height_m=0.5, down_deg=20.0, focal_px=300.0)
    usual, strange = load_calibration("simulated"), load_calibration(calibration_of(rover, tmp_path / "rig.yaml"))
    assert strange.camera.fx == strange.camera.fy == 300.0
    assert strange.body_T_camera[2, 3] == pytest.approx(0.5)
    lowered = usual.body_T_camera[2, 3] - 0.5
    assert usual.body_T_lidar[2, 3] - strange.body_T_lidar[2, 3] == pytest.approx(lowered)
    pitch = [np.degrees(np.arcsin(rig.body_T_camera[2, 2])) for rig in (usual, strange)]
    assert pitch[0] - pitch[1] == pytest.approx(20.0, abs=0.2)
