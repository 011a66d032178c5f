"""Baseline, mounting and clock by stereo over scans, among flat walls whose distances are known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, ScanMotion, StereoCamera
from umf_ros.core.geometry import from_quaternion, make_pose, transform
from umf_ros.runs.findings import about_sensors
from umf_ros.sensors.sensor_check import OVERLAID_FRAMES, Overlay, SensorReport, lay_over, overlay_equations

CAMERA = StereoCamera(688, 512, 580.0, 580.0, 343.5, 255.5, 0.2)
BODY_T_CAMERA = from_quaternion((0.0, 0.1, 1.2), (-0.5, 0.5, -0.5, 0.5))
BODY_T_LIDAR = make_pose(np.eye(3), [0.0, 0.0, 1.3])
WALLS = np.array(
    [[0, 0, 1, 0], [0.1, 0.05, 1, -0.4], [-1, 0.2, 0, -9], [0.1, -1, 0.1, -4], [0.3, 1, 0, -3], [0, 0, -1, -6]]
)
"""Normals and offsets: n x >= d inside."""


def distances(world_T_eye: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """From an eye among the walls along (N, 3) directions of its own, in their lengths."""
    closing = directions @ world_T_eye[:3, :3].T @ WALLS[:, :3].T
    room = WALLS[:, :3] @ world_T_eye[:3, 3] - WALLS[:, 3]
    with np.errstate(divide="ignore"):
        ways = np.where(closing < 0, -room / closing, np.inf)
    return ways.min(axis=1)


def looked(rng: np.random.Generator, turn_deg: np.ndarray, baseline: float, late_s: float, noise: float) -> np.ndarray:
    """Equations of a frame on the move: the LiDAR turned, the baseline stated so many times too long, the scan late."""
    rates = np.array([1.0, 0, 0, *rng.normal(0, 0.3, 3)])
    here = make_pose(Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix(), [*rng.uniform(-0.5, 0.5, 2), 0.1])
    then = here @ make_pose(Rotation.from_rotvec(-late_s * rates[3:]).as_matrix(), -late_s * rates[:3])
    across, up = np.meshgrid(np.radians(np.linspace(-28, 28, 80)), np.radians(np.linspace(-18, 12, 50)))
    rays = np.stack([np.cos(up) * np.cos(across), np.cos(up) * np.sin(across), np.sin(up)], -1).reshape(-1, 3)
    points = rays * distances(then @ BODY_T_LIDAR, rays)[:, None]
    points = transform(BODY_T_LIDAR, points @ Rotation.from_rotvec(np.radians(turn_deg)).as_matrix().T)
    motion = ScanMotion(np.zeros(len(points), np.float32), rates, np.zeros(6))
    frame = Frame(0, CAMERA, BODY_T_CAMERA, BODY_T_LIDAR, points=points.astype(np.float32), motion=motion)
    pixels, depth = CAMERA.project(points, BODY_T_CAMERA)
    inside = (pixels > 0).all(axis=1) & (pixels < (688, 512)).all(axis=1)
    chosen = np.flatnonzero(inside & (depth > 2) & (depth < 15))[::6]
    looks = np.column_stack([(pixels[chosen] - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx, np.ones(len(chosen))])
    true = distances(here @ BODY_T_CAMERA, looks)
    disparity = CAMERA.fx * CAMERA.baseline / baseline / true + rng.normal(0, noise, len(true))
    return overlay_equations(frame, disparity, pixels[chosen], chosen)


def overlaid(
    rng: np.random.Generator,
    turn_deg: tuple[float, float, float] = (0, 0, 0),
    baseline: float = 1.0,
    late_s: float = 0.0,
    noise: float = 0.2,
    frames: int = 30,
) -> Overlay | None:
    return lay_over([looked(rng, np.array(turn_deg), baseline, late_s, noise) for _ in range(frames)])


def lines(overlay: Overlay | None, severity: str = "warning") -> list[str]:
    found = about_sensors(SensorReport(overlay=overlay))
    return [one.what for one in found if (one.severity == "note") == (severity == "note")]


def test_sensors_that_agree_are_told_nothing(rng: np.random.Generator) -> None:
    found = overlaid(rng)
    assert found is not None and np.abs(found.turn_deg).max() < 0.2 and lines(found) == lines(found, "note") == []
    assert found.scale == pytest.approx(1, abs=0.003) and found.lag_s == pytest.approx(0, abs=0.005)
    assert overlaid(rng, frames=OVERLAID_FRAMES - 1) is None


@pytest.mark.parametrize("turn_deg", [(1.0, 0, 0), (0, -1.0, 0), (0, 0, 1.0)])
def test_a_degree_of_the_mounting_is_told(rng: np.random.Generator, turn_deg: tuple[float, float, float]) -> None:
    found = overlaid(rng, turn_deg)
    assert found is not None
    np.testing.assert_allclose(found.turn_deg, -np.array(turn_deg), atol=0.25)
    axis = "xyz"[int(np.abs(turn_deg).argmax())]
    assert [f"mostly about {axis}" in line and "the mounting is wrong" in line for line in lines(found)] == [True]


@pytest.mark.parametrize("baseline", [0.99, 1.01])
def test_a_hundredth_of_the_baseline_is_told(rng: np.random.Generator, baseline: float) -> None:
    found = overlaid(rng, baseline=baseline)
    assert found is not None and found.scale == pytest.approx(baseline, abs=0.003)
    assert ["the baseline is wrong by this factor" in line for line in lines(found)] == [True]


@pytest.mark.parametrize("late_s", [0.02, -0.1])
def test_scans_that_are_late_are_told(rng: np.random.Generator, late_s: float) -> None:
    found = overlaid(rng, late_s=late_s)
    assert found is not None and found.lag_s == pytest.approx(-late_s, abs=0.006)
    assert ["the LiDAR's clock is" in line for line in lines(found)] == [True]


def test_a_bias_of_matching_is_no_baseline(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "CAMERA", replace(CAMERA, baseline=0.07))
    found = overlaid(rng, baseline=1.013, frames=60)  # 0.1 of 8 px
    assert lines(found) == [] and any("does not determine the baseline to 1 %" in line for line in lines(found, "note"))


def test_noise_that_hides_a_fault_is_told_instead(rng: np.random.Generator) -> None:
    found = overlaid(rng, (0.6, 0, 0), 1.006, noise=4.0)
    assert lines(found) == [] and any("does not determine the baseline to 1 %" in line for line in lines(found, "note"))
