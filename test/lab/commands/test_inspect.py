"""`umf inspect`, and recordings of every kind of message through inspection and replay."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings
import yaml
from command_line import only_line, umf
from foreign_messages import HESAI, OUSTER, VELODYNE, compressed, drive, livox, relaid
from recordings import (
    CLOUD,
    LEFT,
    ODOMETRY,
    RIGHT,
    START_NS,
    Entry,
    camera_info,
    image,
    make,
    transform,
    traverse,
)

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import message_types, open_bag
from umf_ros.core.config import load_settings
from umf_ros.core.errors import BagError
from umf_ros.core.geometry import make_pose
from umf_ros.sensors.calibration import load_calibration


def write(path: Path, entries: Iterable[Entry], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write messages of all types the package knows."""
    monkeypatch.setattr(recordings, "STORE", message_types())
    return recordings.write_mcap(path, sorted(entries, key=lambda entry: entry[1]))


def config_for(bag: Path, folder: Path) -> Path:
    """The files of `umf inspect --write` for a recording, with the calibration's images as large as they are."""
    ended = umf("inspect", bag, "--write", folder)
    assert (folder / "my_rover.yaml").is_file(), ended.text
    return folder / "my_rover.yaml"


KINDS: dict[str, dict[str, Any]] = {
    "compressed images": {"images": compressed},
    "jpeg images": {"images": partial(compressed, kind="jpg")},
    "Livox": {"clouds": livox},
    "Ouster": {"clouds": lambda message: relaid(message, OUSTER)},
    "Hesai": {"clouds": lambda message: relaid(message, HESAI)},
    "Velodyne": {"clouds": lambda message: relaid(message, VELODYNE)},
    "yuyv": {"images": lambda m: image(START_NS, np.stack([np.frombuffer(m.data, np.uint8).reshape(48, 64)] * 2, -1), "yuyv", header=m.header)},  # noqa: E501
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_message_goes_through_inspection_and_replay(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = write(tmp_path / "bag.mcap", drive(**KINDS[kind]), monkeypatch)
    config = config_for(bag, tmp_path)
    as_usual = write(tmp_path / "usual.mcap", traverse(3.0), monkeypatch)
    usual = list(
        FrameReader(open_bag(as_usual), load_settings(config, topics__left_image=LEFT, topics__right_image=RIGHT))
    )
    told: list[str] = []
    frames = list(FrameReader(open_bag(bag), load_settings(config), warn=told.append))
    assert told == ["the calibration holds guesses, measure them: camera, body_T_camera, body_T_lidar"]
    assert len(frames) == len(usual) > 10
    for mine, other in zip(frames, usual, strict=True):
        assert mine.points is not None and other.points is not None and (mine.left is None) == (other.left is None)
        np.testing.assert_allclose(mine.points, other.points, atol=1e-4)
        if mine.left is not None and "jpeg" not in kind:
            np.testing.assert_array_equal(mine.left, other.left)
    ended = umf("replay", bag, "--config", config, "--embedder", "thumbnail", "--out", tmp_path / "runs")
    assert "3.0 s" not in ended.err and (tmp_path / "runs" / "latest" / "report.html").is_file(), ended.text


def test_it_says_what_is_there_and_what_that_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = write(tmp_path / "bag.mcap", traverse(25.0), monkeypatch)
    ended = umf("inspect", bag)
    assert ended.status == 0, ended.text
    assert "left_image /stereo/left/image_rect 30.0 Hz 64 x 48, mono8" in ended.text
    assert "200 returns, intensity up to 100, 0.20 s per scan" in " ".join(ended.text.split())
    assert "not used: /ground_truth/pose" in ended.text and "117 of 117 scans have an image within 0.05 s" in ended.text
    assert "image of 64 x 48 pixels, the calibration is for 688 x 512" in ended.text  # as a replay says
    assert ended.out.splitlines()[-1] == f"Ready for loop closure: umf replay {bag}"


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        (traverse(3.0), "3.0 s are shorter than loop.min_time_gap_s, 20 s: no match is allowed"),
        ([e for e in traverse(25.0) if e[0] == LEFT], "no depth: one camera, no scans and no right images"),
        ([e for e in traverse(25.0) if e[0] == ODOMETRY], "neither images nor scans"),
    ],
)
def test_what_could_find_nothing_ends_with_3(
    tmp_path: Path, entries: list[Entry], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = umf("inspect", write(tmp_path / "bag.mcap", entries, monkeypatch))
    assert said in ended.text, ended.text
    assert ended.status == 3 and "Not usable for loop closure: " in ended.text


def test_camera_info_and_transforms_become_the_calibration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = make_pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.4, 0.1, 1.2])
    lidar = make_pose(np.eye(3), [0.3, 0.0, 1.3])
    tree = make("tf2_msgs/msg/TFMessage", transforms=[transform("base_link", "eye", camera), transform("base_link", "beam", lidar)])  # noqa: E501  # fmt: skip
    entries: list[Entry] = [("/tf_static", START_NS, tree)]
    for topic, at, message in traverse(3.0):
        if topic in (LEFT, CLOUD):
            message.header.frame_id = "eye" if topic == LEFT else "beam"
        entries.append((topic, at, message))
    entries.append(("/stereo/left/camera_info", START_NS + 1, camera_info(START_NS, 50.0, (64, 48))))
    entries.append(("/stereo/right/camera_info", START_NS + 2, camera_info(START_NS, 50.0, (64, 48), 0.25)))
    bag = write(tmp_path / "bag.mcap", entries, monkeypatch)
    settings = load_settings(config_for(bag, tmp_path))
    found = load_calibration(settings.calibration)
    np.testing.assert_allclose(found.body_T_camera, camera, atol=1e-6)
    np.testing.assert_allclose(found.body_T_lidar, lidar, atol=1e-6)
    assert (found.camera.fx, found.camera.width, found.camera.baseline) == (50.0, 64, 0.25)
    assert "TO BE MEASURED" not in (tmp_path / "my_calibration.yaml").read_text()
    written = yaml.safe_load((tmp_path / "my_rover.yaml").read_text())["/**"]["ros__parameters"]
    assert written["topics"]["cloud"] == CLOUD
    line = only_line(umf("inspect", bag, "--write", tmp_path))
    assert line.endswith("my_rover.yaml is there already: nothing was written; move it, or name another folder")


def test_an_imu_is_no_odometry_and_what_to_run_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from umf_ros.lab.simulation.bag_writer import imu_message

    entries = [entry for entry in traverse(3.0) if entry[0] != ODOMETRY]
    entries += [("/imu", START_NS + i, imu_message(np.zeros(3), np.zeros(3), START_NS + i)) for i in range(3)]
    bag = write(tmp_path / "bag.mcap", entries, monkeypatch)
    told = umf("inspect", bag).text
    assert "/imu is an IMU, which is no odometry: umf replay, umf slam and umf map make it from /bf_lidar" in told
    settings = load_settings(config_for(bag, tmp_path), topics__odometry="/imu")
    with pytest.raises(BagError, match="an IMU is no odometry: leave"):
        FrameReader(open_bag(bag), settings)


def test_a_recording_that_is_not_there_is_one_line() -> None:
    assert only_line(umf("inspect", "nowhere.mcap")) == "there is no recording nowhere.mcap"


def test_a_data_set_that_camera_info_contradicts_is_not_recognised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = [*traverse(25.0), ("/stereo/left/camera_info", START_NS + 1, camera_info(START_NS, 50.0, (1242, 375)))]
    ended = umf("inspect", write(tmp_path / "bag.mcap", entries, monkeypatch))
    assert "of the data set" not in ended.text and "1242 x 375 pixels" in ended.text and "--write" in ended.text


def vlp_16_and_camera(cameras: tuple[str, ...] = ("/camera",)) -> list[Entry]:
    """The drive of `traverse` by a rover of no known data set, whose `/tf_static` says how it is built."""
    camera = make_pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.4, 0.1, 1.2])
    mounted = {"camera_optical": camera, "velodyne": make_pose(np.eye(3), [0.3, 0.0, 1.3])}
    tree = make("tf2_msgs/msg/TFMessage", transforms=[transform("base_link", name, pose) for name, pose in mounted.items()])  # noqa: E501  # fmt: skip
    entries: list[Entry] = [("/tf_static", START_NS, tree)]
    for topic, at, message in drive(clouds=lambda message: relaid(message, VELODYNE)):
        if topic.startswith(CLOUD):
            message.header.frame_id = "velodyne"
            entries.append(("/velodyne_points", at, message))
        elif topic == ODOMETRY:
            entries.append(("/wheels/odometry", at, message))
        elif topic.startswith(LEFT):
            message.header.frame_id = "camera_optical"
            entries += [(f"{name}/image_raw", at, message) for name in cameras]
    entries += [(f"{name}/camera_info", START_NS + 1, camera_info(START_NS, 50.0, (64, 48))) for name in cameras]
    return entries


def test_a_rover_of_no_data_set_needs_no_parameter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = write(tmp_path / "bag.mcap", vlp_16_and_camera(), monkeypatch)
    line = (
        "inputs: left_image /camera/image_raw, left_info /camera/camera_info, cloud /velodyne_points, "
        "odometry /wheels/odometry; not found: topics.right_image, topics.right_info; "
        "rig: /tf_static and camera_info (parameter calibration)"
    )
    ended = umf("replay", bag, "--embedder", "thumbnail", "--out", tmp_path / "runs")
    assert line in ended.out.splitlines(), ended.text
    frames = list(FrameReader(open_bag(bag), load_settings(tmp_path / "runs" / "latest" / "config.yaml")))
    assert len(frames) > 10 and all(frame.points is not None and frame.left is not None for frame in frames[1:-1])
    assert (frames[5].camera.fx, frames[5].camera.width) == (50.0, 64)
    np.testing.assert_allclose(frames[5].body_T_lidar[:3, 3], [0.3, 0.0, 1.3])
    np.testing.assert_allclose(frames[5].body_T_camera[:3, 3], [0.4, 0.1, 1.2], atol=0.01)  # at its own stamp
    assert line in umf("inspect", bag).text


def test_what_nothing_describes_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    two = write(tmp_path / "two.mcap", vlp_16_and_camera(("/front/camera", "/rear/camera")), monkeypatch)
    told = only_line(umf("replay", two, "--out", tmp_path / "runs"))
    assert told.endswith("left_image: /front/camera/image_raw or /rear/camera/image_raw")
    ended = umf("inspect", two)
    assert ended.status == 3 and "--set topics.left_image=/front/camera/image_raw" in ended.text
    bare = [entry for entry in vlp_16_and_camera() if entry[0] != "/tf_static"]
    told = only_line(umf("replay", write(tmp_path / "bare.mcap", bare, monkeypatch), "--out", tmp_path / "runs"))
    assert "without /tf_static the mountings of its sensors are unknown; the parameter calibration names a file" in told
    assert not (tmp_path / "runs").exists()


def test_a_sensor_that_the_transforms_leave_out_and_raw_pictures_are_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = vlp_16_and_camera()
    entries[-1][2].d[0] = 0.1
    entries[0][2].transforms.pop()
    bag = open_bag(write(tmp_path / "bag.mcap", entries, monkeypatch))
    told: list[str] = []
    assert not list(FrameReader(bag, settings_for(bag, None, "auto"), warn=told.append))
    assert any("/tf_static does not say where velodyne is on base_link (parameters" in line for line in told)
    assert any("the images are raw, with lens distortion" in line for line in told)


def test_a_recording_of_a_known_data_set_gets_its_calibration(mini_bag: Path, tmp_path: Path) -> None:
    ended = umf("inspect", mini_bag, "--write", tmp_path)
    assert "guess" not in ended.text
    settings = settings_for(open_bag(mini_bag), tmp_path / "my_rover.yaml", "auto")
    np.testing.assert_array_equal(
        load_calibration(settings.calibration).body_T_camera, load_calibration("simulated").body_T_camera
    )
