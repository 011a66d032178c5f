"""Labels of a drive: same place, different places, unknown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_worlds import CAMERA, TINY, pose_at, some_scan

from umf_ros.core.config import Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Frame
from umf_ros.lab.fit.adaptation import Drive, DriveReader, label_drive
from umf_ros.lab.fit.scene import with_scene
from umf_ros.lab.training.networks import save_weights
from umf_ros.networks.efficientnet import DEPTH, EfficientNetLite0
from umf_ros.networks.umf import UMF
from umf_ros.sensors.decode import OdometrySample

STEP_M = 5.0
LAP = 20


def drive_of(x: np.ndarray, y: np.ndarray, closures: list[tuple[int, int]], yaw: np.ndarray | None = None) -> Drive:
    count = len(x)
    yaw = np.zeros(count) if yaw is None else yaw
    nothing = np.zeros((count, 1), np.float32)
    return Drive(
        np.arange(count) * 10**9,
        nothing,
        nothing,
        nothing,
        np.ones(count, bool),
        np.ones(count, bool),
        np.stack([pose_at(*each) for each in zip(x, y, yaw, strict=True)]),
        np.arange(count) * STEP_M,
        np.zeros(count, int),
        np.array(closures, int).reshape(-1, 2),
    )


def two_laps(closures: list[tuple[int, int]], offset: float = 0.0) -> Drive:
    """Twice along a line of 100 m, the second time beside the first."""
    x = np.tile(np.arange(LAP) * STEP_M, 2)
    return drive_of(x, np.repeat([0.0, offset], LAP), closures)


def test_a_closure_speaks_for_the_places_around_it_and_for_no_others() -> None:
    labels = label_drive(two_laps([(LAP + 10, 10)]))
    assert labels.same[LAP + 10, 10] and labels.same[LAP + 11, 11] and labels.same[10, LAP + 10]
    assert not labels.same[LAP + 3, 3]  # near in the map, but nothing measured says so
    assert not (labels.same & labels.other).any()


def test_what_the_map_may_get_wrong_is_left_out() -> None:
    labels = label_drive(two_laps([(LAP + 10, 10)]))
    assert labels.other[LAP + 10, 0] and labels.other[10, 1]
    assert not labels.other[LAP + 10, 6]  # 20 m away
    longer = label_drive(drive_of(np.arange(200) * STEP_M, np.zeros(200), [(199, 0)]))
    # 30 m apart in the map, half a kilometre from any closure
    assert longer.other[8, 2] and not longer.other[103, 97]


def test_without_closures_nothing_is_known() -> None:
    labels = label_drive(two_laps([]))
    assert not labels.same.any() and not len(labels.revisits)


def test_views_that_are_turned_are_not_the_same() -> None:
    x, yaw = np.tile(np.arange(LAP) * STEP_M, 2), np.repeat([0.0, 90.0], LAP)
    labels = label_drive(drive_of(x, 0 * x, [(LAP + 10, 10)], yaw))
    assert not labels.same.any() and labels.other[LAP + 10, 10]


def test_neighbours_of_one_pass_are_not_asked_for() -> None:
    labels = label_drive(two_laps([(LAP + 10, 10)]))
    assert not labels.same[10, 11] and not labels.other[10, 11]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_weights(with_scene(UMF(TINY).eval(), EfficientNetLite0(DEPTH), 8), path, {})
    return path


def frames(count: int) -> list[Frame]:
    rng = np.random.default_rng(0)
    return [
        Frame(
            stamp_ns=step * 10**9,
            camera=CAMERA,
            body_T_camera=np.eye(4),
            body_T_lidar=np.eye(4),
            odom_T_body=pose_at(3.0 * step, 0.0),
            left=np.kron(rng.integers(0, 255, (32, 43)), np.ones((16, 16))).astype(np.uint8),
            points=some_scan(step),
        )
        for step in range(count)
    ]


def reader(weights: Path) -> DriveReader:
    from umf_ros.networks.weights import load_weights

    settings = Settings.model_validate({"embedding": {"weights": str(weights), "runtime": "torch", "threads": 1}})
    return DriveReader(load_weights(weights), settings)


def test_a_recording_becomes_a_drive_that_can_be_kept(weights: Path, tmp_path: Path) -> None:
    reading = reader(weights)
    for frame in frames(5):
        assert frame.odom_T_body is not None
        reading.take(OdometrySample(frame.stamp_ns, frame.odom_T_body))
        detection = reading.take(frame)
        assert detection is not None and detection.keyframe is not None
    drive = reading.finish()
    assert drive.seen.shape == drive.felt.shape == (5, TINY.tokens) and drive.cells.shape == (5, 15 * 112)
    assert drive.image_present.all() and drive.cloud_present.all() and drive.closures.shape == (0, 2)
    np.testing.assert_allclose(drive.map_T_body[:, 0, 3], 3.0 * np.arange(5), atol=1e-6)
    np.testing.assert_allclose(drive.path_length_m, 3.0 * np.arange(5), atol=1e-6)
    drive.save(tmp_path / "drive.npz")
    again = Drive.load(tmp_path / "drive.npz")
    np.testing.assert_array_equal(again.seen, drive.seen)
    assert list(tmp_path.iterdir()) == [tmp_path / "drive.npz"]


def test_without_odometry_nothing_can_be_learned(weights: Path) -> None:
    with pytest.raises(UmfError, match="no keyframe has odometry"):
        reader(weights).finish()
