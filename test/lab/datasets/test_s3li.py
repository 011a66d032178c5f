from __future__ import annotations

import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from etna import entries, write_pos
from recordings import START_NS, drive, small_settings, traverse, write_mcap, write_ros1
from rosbags.typesys import Stores, get_typestore

from umf_ros.core.errors import BagError, UmfError
from umf_ros.core.geometry import heading, transform
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.lab.datasets.s3li import ETNA_TEST, ETNA_TRAINING, read_bag, read_toolkit
from umf_ros.sensors.calibration import load_calibration

DATA = Path(__file__).parent / "data"


def turns(poses: np.ndarray) -> np.ndarray:
    return np.unwrap([heading(pose) for pose in poses])


def test_a_recording_with_rtklib_truth(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    bag = write_ros1(tmp_path / "s3li_loops.bag", entries(6, store=store))
    truth = write_pos(tmp_path / "global_lle.pos", 7)
    settings = small_settings(tmp_path, dataset="s3li-etna")
    sequence = read_bag(bag, truth, settings=settings, spacing_m=0.9)
    assert sequence.name == "s3li_loops" and sequence.setting == "real" and 4 <= len(sequence) <= 7
    steps = np.linalg.norm(np.diff(sequence.world_T_body[:, :3, 3], axis=0), axis=1)
    assert steps.min() >= 0.9 and steps.max() < 1.3
    # no odometry: the heading is the course, 30 deg to the north of the drive's
    stamps = np.linalg.norm(sequence.world_T_body[:, :3, 3], axis=1)
    assert stamps[0] < 0.5
    assert np.degrees(turns(sequence.world_T_body))[0] == pytest.approx(30, abs=15)
    assert np.degrees(np.ptp(turns(sequence.world_T_body))) > 40
    sample = sequence.sample(2)
    assert sample.image is not None and sample.image.shape == (256, 344)
    assert sample.points is not None and len(sample.points) == len(sample.intensity)
    assert np.array_equal(sample.world_T_body, sequence.world_T_body[2])


def test_headings_come_from_the_odometry_where_there_is_some(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "a.mcap", entries(8))
    stamps = START_NS + np.arange(180, dtype=np.int64) * 50_000_000
    tum = tmp_path / "odometry.tum"
    write_tum(tum, Trajectory(stamps, np.stack([drive(i * 0.05) for i in range(180)])))
    settings = small_settings(tmp_path, dataset="s3li-etna")
    sequence = read_bag(bag, write_pos(tmp_path / "a.pos", 9), tum, settings, spacing_m=0.5)
    expected = np.degrees(turns(sequence.world_T_body))
    # a scan's stamp is 0.1 s after its start; the drive turns by 0.3 rad/s and travels 1 m/s
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(sequence.world_T_body[:, :3, 3], axis=0), axis=1))])
    assert expected == pytest.approx(expected[0] + np.degrees(0.3 * way), abs=1.0)
    assert expected[0] == pytest.approx(30 + np.degrees(0.3) * 0.1, abs=2.0)


def test_odometry_of_the_imu_is_turned_to_the_body(tmp_path: Path) -> None:
    """S3LI's Eval/BASALT holds poses of the IMU, whose axes are not the rover's."""
    bag = write_mcap(tmp_path / "a.mcap", entries(8))
    stamps = START_NS + np.arange(180, dtype=np.int64) * 50_000_000
    body = np.stack([drive(i * 0.05) for i in range(180)])
    settings = small_settings(tmp_path, dataset="s3li-etna").model_copy(update={"calibration": ""})
    body_T_imu = load_calibration("s3li-etna").body_T_imu
    truth, found = write_pos(tmp_path / "a.pos", 9), []
    for frame, poses in (("body", body), ("imu", body @ body_T_imu)):
        write_tum(tmp_path / f"{frame}.tum", Trajectory(stamps, poses))
        found.append(read_bag(bag, truth, tmp_path / f"{frame}.tum", settings, 0.5, frame).world_T_body)
    np.testing.assert_allclose(found[0], found[1], atol=1e-5)


def test_the_simulators_own_truth_needs_no_file(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "a.mcap", traverse(4))
    sequence = read_bag(bag, settings=small_settings(tmp_path))
    index = len(sequence) - 1
    x, y = sequence.world_T_body[index, :2, 3]
    assert heading(sequence.world_T_body[index]) == pytest.approx(2 * math.atan2(y, x), abs=0.01)  # on a circle


def test_without_truth_there_is_no_sequence(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "a.mcap", entries(1))
    with pytest.raises(BagError, match="no ground truth"):
        read_bag(bag, settings=small_settings(tmp_path))
    late = write_pos(tmp_path / "late.pos", 1)
    late.write_text(late.read_text().replace("2021/07/07", "2021/07/08"))
    with pytest.raises(BagError, match="do the clocks agree"):
        read_bag(bag, late, settings=small_settings(tmp_path))


@pytest.fixture
def images(tmp_path: Path) -> Path:
    folder = tmp_path / "elsewhere" / "s3li_loops" / "left"
    folder.mkdir(parents=True)
    for number in range(5):
        cv2.imwrite(str(folder / f"{number:04d}.png"), np.full((512, 688), 40 * number, np.uint8))
    return tmp_path / "elsewhere"


@pytest.mark.parametrize("version", [2, 3])
def test_the_toolkits_pickle(images: Path, version: int) -> None:
    sequence = read_toolkit([DATA / f"toolkit_pandas{version}.pkl"], images)
    assert sequence.name == "s3li_loops" and len(sequence) == 5
    # 1e-5 deg to the north each, and a metre up
    positions = sequence.world_T_body[:, :3, 3]
    assert np.diff(positions[:, 1]) == pytest.approx([1.11] * 4, abs=0.01)
    assert np.diff(positions[:, 2]) == pytest.approx([1.0] * 4, abs=0.01)
    sample = sequence.sample(3)
    assert sample.image is not None and sample.image.mean() == 120 and sample.intensity is None
    # points come in the camera's optical frame; the camera looks ahead
    assert sample.points is not None and sample.points.shape == (7, 3)
    assert (sample.points[:, 0] > 6).all() and np.abs(sample.points[:, 1:]).max() < 2


def test_slam_gives_the_rotations(images: Path) -> None:
    sequence = read_toolkit([DATA / "toolkit_pandas2.pkl"], images)
    relative = sequence.world_T_body[0, :3, :3].T @ sequence.world_T_body[2, :3, :3]
    imu = load_calibration("s3li-etna").body_T_imu[:3, :3]
    # the IMU turned by 20 deg about its own z axis
    turned = imu.T @ relative @ imu
    assert math.degrees(math.atan2(turned[1, 0], turned[0, 0])) == pytest.approx(20, abs=0.1)


def test_several_pickles_share_their_coordinates(images: Path, tmp_path: Path) -> None:
    other = tmp_path / "b.pkl"
    shutil.copy(DATA / "toolkit_pandas2.pkl", other)
    sequence = read_toolkit([DATA / "toolkit_pandas2.pkl", other], images)
    assert sequence.pass_index.tolist() == [0] * 5 + [1] * 5
    assert np.allclose(sequence.world_T_body[:5], sequence.world_T_body[5:])


def test_an_image_that_is_nowhere_is_named(tmp_path: Path) -> None:
    with pytest.raises(UmfError, match=r"no image .*0001.png, nor in"):
        read_toolkit([DATA / "toolkit_pandas2.pkl"], tmp_path).sample(1)


def test_the_split_of_the_thesis() -> None:
    assert set(ETNA_TEST) == {"s3li_loops", "s3li_traverse_1"}
    assert len(set(ETNA_TEST) | set(ETNA_TRAINING)) == 7


def test_points_and_depths_agree_with_the_calibration(images: Path) -> None:
    sample = read_toolkit([DATA / "toolkit_pandas2.pkl"], images).sample(0)
    assert sample.points is not None
    optical = transform(np.linalg.inv(sample.body_T_camera), sample.points)
    assert optical[:, 2].min() > 3.9 and np.abs(optical[:, :2]).max() <= 1.0 + 1e-5
