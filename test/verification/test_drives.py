"""Overlap and error as the benchmark counts them, on a wall whose geometry is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, StereoCamera
from umf_ros.core.geometry import Array, make_pose, relative
from umf_ros.lab.simulation.drives import DEPTH_STRIDE, SurveyedDrive, kept, path_length, worlds
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.scenes import BODY_T_CAMERA

SQUARE = StereoCamera(224, 224, 190.0, 190.0, 112.0, 112.0, 0.2)
WALL_M = 12.0


def turned(degrees: float, metres_left: float = 0.0) -> Array:
    return make_pose(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), [0.0, metres_left, 0.0])


def before_a_wall(*poses: Array) -> SurveyedDrive:
    """Frames that all see a wall at one depth, whatever their pose: enough for small motions."""
    frames = [Frame(n, SQUARE, BODY_T_CAMERA, np.eye(4)) for n in range(len(poses))]
    side = SQUARE.width // DEPTH_STRIDE
    return SurveyedDrive(1, "wall", frames, np.array(poses), np.full((len(poses), side, side), WALL_M, np.float16))


def test_a_view_overlaps_itself_entirely_and_its_back_not_at_all() -> None:
    drive = before_a_wall(np.eye(4), np.eye(4), turned(180.0))
    assert drive.overlap(1, 0) > 0.97
    assert drive.overlap(2, 0) == 0.0


def test_overlap_shrinks_with_the_sideways_step() -> None:
    width_m = WALL_M * SQUARE.width / SQUARE.fx
    drive = before_a_wall(np.eye(4), turned(0.0, width_m / 4), turned(0.0, width_m / 2))
    assert drive.overlap(1, 0) == pytest.approx(0.75, abs=0.05)
    assert drive.overlap(2, 0) == pytest.approx(0.5, abs=0.05)


def test_a_view_of_the_sky_overlaps_nothing() -> None:
    drive = before_a_wall(np.eye(4), np.eye(4))
    sky = SurveyedDrive(1, "sky", drive.frames, drive.truth, np.zeros_like(drive.depths))
    assert sky.overlap(1, 0) == 0.0


def test_error_is_measured_in_the_axes_of_the_match() -> None:
    drive = before_a_wall(turned(90.0), turned(120.0, 2.0))
    true = relative(drive.truth[0], drive.truth[1])
    off = make_pose(Rotation.from_rotvec([0, 0, 0.02]).as_matrix(), [0, 0, 0]) @ true
    off[:3, 3] = true[:3, 3] + [0.3, 0.0, -0.4]
    metres, degrees = drive.error(1, 0, off)
    assert (metres, degrees) == pytest.approx((0.5, np.degrees(0.02)))


def test_way_is_summed_along_the_path() -> None:
    path = np.array([make_pose(np.eye(3), place) for place in ([0, 0, 0], [3, 4, 0], [3, 4, 2])], float)
    assert path_length(path).tolist() == [0, 5, 7]


def test_worlds_take_turns_in_family_and_aliasing() -> None:
    chosen = list(worlds(20_000, 2 * len(FAMILIES)))
    assert [seed for seed, _, _ in chosen] == list(range(20_000, 20_000 + 2 * len(FAMILIES)))
    assert {family for _, family, _ in chosen} == set(FAMILIES)
    assert {aliasing for _, _, aliasing in chosen} == {1.0, 0.6}


def test_kept_drives_are_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def simulate(seed: int, family: str, aliasing: float) -> SurveyedDrive:
        made.append(seed)
        return before_a_wall(np.eye(4), turned(10.0, 2.4))

    monkeypatch.setattr("umf_ros.lab.simulation.drives.simulate", simulate)
    first, again = (kept(tmp_path / "drives", 20_000, "etna", 1.0) for _ in range(2))
    kept(tmp_path / "drives", 20_001, "etna", 1.0)
    kept(None, 20_000, "etna", 1.0)
    assert made == [20_000, 20_001, 20_000]
    np.testing.assert_array_equal(first.truth, again.truth)
