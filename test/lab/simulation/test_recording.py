"""Contents of a bag, byte for byte."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_tum
from umf_ros.lab.simulation.bag_writer import BagWriter
from umf_ros.lab.simulation.simulator import describe, record, write_side_files
from umf_ros.sensors.decode import decode_cloud, stamp_ns


@pytest.fixture(scope="module")
def path(drive, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "drive.mcap"
    counts: list[int] = []
    with BagWriter(path) as bag:
        record(drive, bag, workers=2, truth=True, progress=counts.append)
    assert counts == list(range(1, len(drive.scan_stamps_ns) + 1))
    return path


@pytest.fixture(scope="module")
def messages(path):
    by_topic: dict[str, list] = {}
    for topic, log_ns, message in open_bag(path).messages():
        by_topic.setdefault(topic, []).append((log_ns, message))
    return by_topic


def test_one_worker_writes_the_same_bytes(drive, path, tmp_path):
    with BagWriter(tmp_path / "again.mcap") as bag:
        record(drive, bag, workers=1, truth=True)
    assert (tmp_path / "again.mcap").read_bytes() == path.read_bytes()


def test_topics_and_rates_are_s3lis(drive, messages):
    seconds = drive.duration_s
    rates = {topic: len(found) / seconds for topic, found in messages.items()}
    assert rates["/imu/data"] == pytest.approx(400, rel=0.01)
    assert rates["/odom"] == pytest.approx(25, rel=0.03)
    assert rates["/gnss/fix"] == pytest.approx(5, rel=0.1)
    assert len(messages["/bf_lidar/points_raw"]) == len(messages["/stereo/left/image_rect"]) == len(drive.exposures)
    stamps = [stamp_ns(message) for _, message in messages["/bf_lidar/points_raw"]]
    assert 1e9 / np.diff(stamps).mean() == pytest.approx(4.7, abs=0.01)
    assert "/ground_truth/pose" in messages


def test_a_point_has_the_28_bytes_of_a_blickfeld(messages):
    message = messages["/bf_lidar/points_raw"][0][1]
    layout = [(field.name, field.offset, field.datatype, field.count) for field in message.fields]
    assert layout == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
        ("intensity", 12, 6, 1),
        ("ambient_light", 16, 6, 1),
        ("point_id", 20, 6, 1),
        ("point_time_offset", 24, 6, 1),
    ]
    assert (message.point_step, message.height, message.width, message.is_bigendian) == (28, 1, 17_400, False)
    assert len(message.data) == message.row_step == 28 * 17_400
    words = np.frombuffer(message.data, "<u4").reshape(-1, 7)
    assert np.array_equal(words[:, 5], np.arange(17_400))
    missing = words[:, 3] == 0
    xyz = np.frombuffer(message.data, "<f4").reshape(-1, 7)[:, :3]
    assert np.allclose(np.linalg.norm(xyz[missing], axis=1), 1, atol=1e-5)
    assert len(decode_cloud(message).points) == (~missing).sum()


def test_images_and_camera_infos_are_s3lis(drive, messages):
    message = messages["/stereo/left/image_rect"][0][1]
    assert (message.width, message.height, message.step, message.encoding) == (688, 512, 688, "mono8")
    left, right = (messages[f"/stereo/{side}/camera_info"][0][1] for side in ("left", "right"))
    assert left.k[0] == pytest.approx(579.4882694716105) and left.p[3] == 0
    assert right.p[3] == pytest.approx(-116.0858, abs=1e-3)
    assert len(messages["/stereo/right/image_rect"]) == sum(exposure.right for exposure in drive.exposures)


def test_pairs_share_their_stamp_and_lie_near_the_scan(drive, messages):
    left = {stamp_ns(message) for _, message in messages["/stereo/left/image_rect"]}
    right = {stamp_ns(message) for _, message in messages["/stereo/right/image_rect"]}
    scans = np.array([stamp_ns(message) for _, message in messages["/bf_lidar/points_raw"]])
    assert right <= left
    assert all(np.abs(scans - stamp).min() < 10_000_000 for stamp in left)


def test_messages_arrive_in_order_and_after_they_were_measured(messages):
    for topic, found in messages.items():
        logs = [log_ns for log_ns, _ in found]
        assert logs == sorted(logs), topic
        assert all(log_ns >= stamp_ns(message) for log_ns, message in found), topic
    log_ns, scan = messages["/bf_lidar/points_raw"][0]
    assert log_ns - stamp_ns(scan) > 200_000_000  # a scan is there when it is complete


def test_maps_of_the_truth_fit_their_image(messages):
    depth, rocks = messages["/ground_truth/depth"][0][1], messages["/ground_truth/instance"][0][1]
    assert (depth.encoding, depth.step) == ("32FC1", 4 * 688)
    metres = np.frombuffer(depth.data, "<f4").reshape(512, 688)
    assert metres[-1].min() > 0.5 and metres[-1].max() < 10
    assert np.frombuffer(rocks.data, "<i4").min() >= 0
    assert messages["/ground_truth/semantic"][0][1].encoding == "mono8"


def test_side_files_hold_odometry_and_positions(drive, path):
    write_side_files(drive, path)
    trajectory = read_tum(path.with_suffix(".odometry.tum"))
    assert np.allclose(trajectory.poses, drive.odometry.poses, atol=1e-6)
    lines = [line for line in path.with_suffix(".pos").read_text().splitlines() if not line.startswith("%")]
    assert len(lines) == 13


def test_what_was_simulated_is_told(drive):
    facts = describe(drive)
    assert facts["seed"] == "31" and json.loads(facts["drift"])["turn_deg_m"] == 0.3
    assert json.loads(facts["legs"])[0]["label"] == "first"


def test_frames_need_no_file(drive):
    frame = next(drive.frames())
    assert frame.left.shape == (512, 688) and frame.points.dtype == np.float32
    assert len(frame.points) == len(frame.intensity) > 3000 and frame.intensity.min() > 15
    assert np.percentile(frame.points[:, 2], 20) < 0.8  # the ground, in the frame of the rover's feet
    assert frame.image_stamp_ns == drive.exposures[0].stamp_ns
    assert np.allclose(frame.body_T_camera, drive.calibration.body_T_camera, atol=0.02)


def test_scans_of_the_bag_are_those_of_the_drive(drive, messages):
    for number in (0, 4):
        scan, message = drive.scan(number), messages["/bf_lidar/points_raw"][number][1]
        cloud, returned = decode_cloud(message), scan.intensity > 0
        assert stamp_ns(message) == drive.scan_stamps_ns[number]
        np.testing.assert_array_equal(cloud.points, scan.points[returned])
        np.testing.assert_array_equal(cloud.intensity, scan.intensity[returned])


def test_images_of_the_bag_are_those_of_the_drive(drive, messages):
    picture, message = drive.picture(drive.exposures[2]), messages["/stereo/left/image_rect"][2][1]
    assert stamp_ns(message) == drive.exposures[2].stamp_ns
    assert np.array_equal(message.data.reshape(512, 688), picture.image)
    depth, rocks = (messages[f"/ground_truth/{name}"][2][1].data for name in ("depth", "instance"))
    assert np.array_equal(depth.view(np.float32).reshape(512, 688), picture.depth)
    assert np.array_equal(rocks.view(np.int32).reshape(512, 688), picture.instance)


def test_the_truth_of_the_bag_is_the_motion(drive, messages):
    for index in (0, 20, 50):
        log_ns, message = messages["/ground_truth/pose"][index]
        place = message.pose.position
        assert [place.x, place.y, place.z] == pytest.approx(drive.pose(log_ns)[:3, 3].tolist(), abs=1e-9)
        assert message.header.frame_id == "world"
