from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
from recordings import (
    CLOUD,
    LEFT,
    ODOMETRY,
    RIGHT,
    START_NS,
    cloud,
    drive,
    image,
    scan,
    small_settings,
    traverse,
    write_mcap,
    write_ros1,
)
from rosbags.typesys import Stores, get_typestore

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import detect_dataset
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import load_preset, load_settings
from umf_ros.core.errors import BagError
from umf_ros.core.trajectory import Trajectory
from umf_ros.sensors.decode import OdometrySample

ENTRIES = traverse(3.0)
SCANS = int(3.0 * 4.7)


def test_a_recording_becomes_one_frame_per_scan(tmp_path: Path) -> None:
    bag = open_bag(write_mcap(tmp_path / "a.mcap", ENTRIES))
    told: list[str] = []
    reader = FrameReader(bag, small_settings(tmp_path), warn=told.append)
    frames = list(reader)
    assert len(frames) == SCANS and told == []
    assert reader.progress == pytest.approx(1)
    for frame in frames:
        assert frame.left is not None and frame.points is not None and frame.odom_T_body is not None
        assert np.allclose(frame.odom_T_body, drive((frame.stamp_ns - START_NS) / 1e9), atol=1e-3)
    assert sum(frame.right is not None for frame in frames) > SCANS // 2
    assert {name: counter.lost for name, counter in reader.counters.items()} == dict.fromkeys(reader.counters, 0)


@pytest.mark.parametrize("from_file", [False, True])
def test_the_stream_holds_every_message_of_the_odometry_before_the_frames_that_need_it(
    tmp_path: Path, from_file: bool
) -> None:
    bag = open_bag(write_mcap(tmp_path / "a.mcap", ENTRIES))
    stamps = START_NS + np.arange(60) * 50_000_000
    trajectory = Trajectory(stamps, np.stack([drive(i * 0.05) for i in range(60)])) if from_file else None
    heard: list[int] = []
    frames = 0
    for item in FrameReader(bag, small_settings(tmp_path), trajectory).stream():
        if isinstance(item, OdometrySample):
            heard.append(item.stamp_ns)
            assert np.allclose(item.odom_T_body, drive((item.stamp_ns - START_NS) / 1e9))
            continue
        frames += 1
        assert heard[-1] >= item.stamp_ns
    assert frames == SCANS
    assert heard == stamps.tolist()


def test_topics_that_are_missing_are_not_waited_for(tmp_path: Path) -> None:
    entries = [entry for entry in ENTRIES if entry[0] in (LEFT, CLOUD)]
    reader = FrameReader(open_bag(write_mcap(tmp_path / "a.mcap", entries)), small_settings(tmp_path))
    stamps = [frame.stamp_ns for frame in reader]
    assert len(stamps) == SCANS
    images = [entry for entry in ENTRIES if entry[0] in (LEFT, RIGHT)]
    frames = list(FrameReader(open_bag(write_mcap(tmp_path / "b.mcap", images)), small_settings(tmp_path)))
    assert len(frames) == 90 and all(frame.points is None for frame in frames)


def test_odometry_can_come_from_a_file(tmp_path: Path) -> None:
    entries = [entry for entry in ENTRIES if entry[0] != ODOMETRY]
    seconds = np.arange(0, 4, 0.1)
    path = Trajectory(START_NS + np.round(seconds * 1e9).astype(np.int64), np.stack([drive(s) for s in seconds]))
    bag = open_bag(write_mcap(tmp_path / "a.mcap", entries))
    frames = list(FrameReader(bag, small_settings(tmp_path), path))
    assert len(frames) == SCANS
    for frame in frames:
        assert frame.odom_T_body is not None
        assert np.allclose(frame.odom_T_body, drive((frame.stamp_ns - START_NS) / 1e9), atol=2e-3)


@pytest.mark.parametrize("wrong_s", [0, 3600])
def test_odometry_is_compared_with_headers_and_not_with_times_of_recording(tmp_path: Path, wrong_s: int) -> None:
    """Also where the first header is wrong."""
    entries = [(topic, at + 10**18, copy.deepcopy(message)) for topic, at, message in ENTRIES if topic != ODOMETRY]
    entries[0][2].header.stamp.sec += wrong_s
    seconds = np.arange(0, 4, 0.1)
    path = Trajectory(START_NS + np.round(seconds * 1e9).astype(np.int64), np.stack([drive(s) for s in seconds]))
    frames = list(FrameReader(open_bag(write_mcap(tmp_path / "a.mcap", entries)), small_settings(tmp_path), path))
    assert sum(frame.odom_T_body is not None for frame in frames) >= SCANS - 1


def test_odometry_of_another_recording_is_said(tmp_path: Path) -> None:
    path = Trajectory(np.array([1, 2]) * 10**9, np.stack([np.eye(4), np.eye(4)]))
    bag = open_bag(write_mcap(tmp_path / "a.mcap", ENTRIES))
    with pytest.raises(BagError, match="covers none of the recording"):
        FrameReader(bag, small_settings(tmp_path), path)


def test_bad_messages_are_skipped_counted_and_told_once(tmp_path: Path) -> None:
    bad = [
        (LEFT, START_NS + i * 10**8, image(START_NS + i * 10**8, np.zeros((48, 64), np.uint8), "nv12"))
        for i in range(9)
    ]
    bag = open_bag(write_mcap(tmp_path / "a.mcap", sorted([*ENTRIES, *bad], key=lambda entry: entry[1])))
    told: list[str] = []
    reader = FrameReader(bag, small_settings(tmp_path), warn=told.append)
    assert len(list(reader)) == SCANS
    assert reader.counters["left"].dropped["encoding"] == 9
    assert len(told) == 1 and "nv12" in told[0]


def test_a_recording_that_breaks_off_is_used_and_said(tmp_path: Path) -> None:
    whole = write_mcap(tmp_path / "a.mcap", ENTRIES).read_bytes()
    path = tmp_path / "broken.mcap"
    path.write_bytes(whole[: len(whole) * 2 // 3])
    told: list[str] = []
    frames = list(FrameReader(open_bag(path), small_settings(tmp_path), warn=told.append))
    assert SCANS // 3 < len(frames) < SCANS
    assert len(told) == 1 and "is truncated" in told[0]


def test_a_recording_without_sensors_is_refused(tmp_path: Path) -> None:
    bag = open_bag(write_mcap(tmp_path / "a.mcap", [entry for entry in ENTRIES if entry[0] == ODOMETRY]))
    with pytest.raises(BagError, match="neither images nor scans"):
        FrameReader(bag, small_settings(tmp_path))


def test_a_topic_of_another_type_is_refused(tmp_path: Path) -> None:
    odometry = next(message for topic, _, message in ENTRIES if topic == ODOMETRY)
    bag = open_bag(write_mcap(tmp_path / "a.mcap", [(LEFT, START_NS, odometry)]))
    with pytest.raises(BagError, match="is of type nav_msgs/msg/Odometry, expected sensor_msgs/msg/Image"):
        FrameReader(bag, small_settings(tmp_path))


def test_bytes_that_are_no_message_are_skipped_and_counted(tmp_path: Path) -> None:
    def halved(number: int, topic: str, data: bytes) -> bytes:
        return data[: len(data) // 2] if topic == CLOUD and number % 3 == 0 else data

    path = write_mcap(tmp_path / "a.mcap", ENTRIES, change=halved)
    told: list[str] = []
    reader = FrameReader(open_bag(path), small_settings(tmp_path), warn=told.append)
    frames = list(reader)
    garbled = reader.counters["cloud"].dropped["undecodable"]
    assert garbled > 2 and len(frames) == SCANS - garbled
    assert len(told) == 1 and "does not match its type" in told[0]
    with pytest.raises(BagError, match=f"{path}: {CLOUD}: message does not match its type"):
        list(open_bag(path).messages())


def test_raw_bayer_images_of_vulcano_arrive_rectified(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    topics = load_preset("s3li-vulcano").topics
    left, right = topics.left_image, topics.right_image
    pixels = np.full((1544, 2064), 90, np.uint8)
    entries = []
    for i in range(3):
        stamp = START_NS + i * 100_000_000
        entries += [(topic, stamp, image(stamp, pixels, "bayer_rggb8", store)) for topic in (left, right)]
    points = np.random.default_rng(1).uniform((-5, 5, -2), (5, 15, 2), (50, 3))
    entries.append((CLOUD, START_NS + 90_000_000, cloud(START_NS + 90_000_000, scan(points), store)))
    bag = open_bag(write_ros1(tmp_path / "a.bag", sorted(entries, key=lambda entry: entry[1])))
    (frame,) = FrameReader(bag, load_settings(dataset=detect_dataset(bag)))
    assert frame.stamp_ns == START_NS + 90_000_000 and frame.image_stamp_ns == START_NS + 100_000_000
    assert frame.left is not None and frame.right is not None and frame.points is not None
    assert frame.left.shape == frame.right.shape == (512, 688) == (frame.camera.height, frame.camera.width)
    assert np.abs(frame.left.astype(int) - 90).max() <= 1
    assert frame.camera.baseline == pytest.approx(0.0892, abs=1e-4)


def test_guesses_of_the_calibration_are_one_warning(tmp_path: Path) -> None:
    settings = small_settings(tmp_path)
    calibration = Path(settings.calibration)
    text = calibration.read_text(encoding="utf-8")
    bag, told = open_bag(write_mcap(tmp_path / "a.mcap", ENTRIES)), list[str]()
    FrameReader(bag, settings, warn=told.append)
    assert not any("guess" in line for line in told)
    lines = text.split("\n")
    guessed = [f"{line}  # TO BE MEASURED: a guess" if line.startswith("body_T_l") else line for line in lines]
    calibration.write_text("# TO BE MEASURED: the baseline\n" + "\n".join(guessed), encoding="utf-8")
    FrameReader(bag, settings, warn=told.append)
    assert [line for line in told if "guess" in line] == [
        "the calibration holds guesses, measure them: the baseline, body_T_lidar"
    ]
