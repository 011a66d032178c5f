from __future__ import annotations

import struct
from collections import defaultdict
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

from umf_ros.bags.trajectories import read_rtklib, read_tum
from umf_ros.cli import umf
from umf_ros.core.config import Loop
from umf_ros.core.errors import BagError
from umf_ros.lab.datasets.s3li import ETNA_TEST, ETNA_TRAINING, load_data_frame, read_toolkit
from umf_ros.lab.datasets.s3li_folder import DATASETS, contradictions, find_s3li, image_key, read_pairs, read_stereo
from umf_ros.lab.simulation import twin
from umf_ros.lab.simulation.lidar import ETNA as ETNA_LAYOUT
from umf_ros.lab.simulation.motion_sensors import Motion, drifting
from umf_ros.lab.simulation.relief import Relief
from umf_ros.lab.simulation.twin import TWINS, Disorders, twin_of, write_twin
from umf_ros.lab.simulation.world import ground
from umf_ros.runs.truth import absolute_trajectory_error, find_revisits
from umf_ros.sensors.calibration import load_calibration

SEED = 20_300
LOOPS, LAKE = "s3li_loops", "moon_lake"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sequences of some metres."""
    out = tmp_path_factory.mktemp("twin")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(twin, "SHORTEST_M", 9.0)
        assert list(write_twin(out, SEED, 0.01, (LOOPS, LAKE))) == [LOOPS, LAKE]
    return out


@pytest.fixture(scope="module")
def relief() -> Relief:
    return ground(SEED, twin.ETNA_FAMILY, 0.3)


def messages(bag: Path) -> dict[str, list]:
    """Messages by topic, and their sequence numbers as they are in the file."""
    store, found = get_typestore(Stores.ROS1_NOETIC), defaultdict(list)
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            found[connection.topic].append(store.deserialize_ros1(data, connection.msgtype))
            assert struct.unpack_from("<I", data)[0] == len(found[connection.topic]) - 1
    return found


def stamp(message) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


pytestmark = pytest.mark.slow


def test_etna_is_written_as_it_is_published(folder: Path) -> None:
    bag = folder / "s3li_etna/Bagfiles" / f"{LOOPS}.bag"
    assert bag.read_bytes()[:13] == b"#ROSBAG V2.0\n" and b"compression=lz4" in bag.read_bytes()[:20_000]
    found = messages(bag)
    sides = [f"/stereo/{side}/{name}" for side in ("left", "right") for name in ("image_rect", "camera_info")]
    assert set(found) == {*sides, "/bf_lidar/points_raw", "/imu/data"}
    left, info = found["/stereo/left/image_rect"][0], found["/stereo/right/camera_info"][0]
    assert (left.encoding, left.width, left.height, left.step) == ("mono8", 688, 512, 688)
    assert info.P[3] == pytest.approx(-116.0858, abs=1e-3) and info.K[0] == pytest.approx(579.4882694716105)
    assert len(found["/stereo/right/image_rect"]) <= len(found["/stereo/left/image_rect"])
    cloud = found["/bf_lidar/points_raw"][3]
    assert (cloud.width, cloud.height, cloud.point_step, len(cloud.data)) == (17_400, 1, 28, 17_400 * 28)
    assert [field.name for field in cloud.fields][3:] == ["intensity", "ambient_light", "point_id", "point_time_offset"]
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 7)
    nothing = np.frombuffer(cloud.data, "<u4").reshape(-1, 7)[:, 3] == 0
    assert nothing.any() and np.linalg.norm(points[nothing, :3], axis=1) == pytest.approx(1.0, abs=1e-5)
    images = np.array([stamp(one) for one in found["/stereo/left/image_rect"]])
    behind = [np.abs(images - stamp(one) - 100_000_000).min() for one in found["/bf_lidar/points_raw"]]
    assert max(behind) < 15_000_000
    assert 1e-9 * np.diff([stamp(one) for one in found["/imu/data"]]).mean() == pytest.approx(1 / 400, rel=1e-3)
    assert "IMU.Frequency: 100" in (folder / "s3li_etna/Cfgs/orbslam_config.yaml").read_text()


def test_vulcano_is_raw_and_has_no_camera_info(folder: Path) -> None:
    found = messages(folder / "s3li_vulcano/bagfiles" / f"{LAKE}.bag")
    assert set(found) == {"/g319c_left/image_raw", "/g319c_right/image_raw", "/bf_lidar/points_raw", "/imu/data"}
    image = found["/g319c_left/image_raw"][2]
    assert (image.encoding, image.width, image.height) == ("bayer_rggb8", 2064, 1544)
    images = np.array([stamp(one) for one in found["/g319c_left/image_raw"]])
    assert max(np.abs(images - stamp(one)).min() for one in found["/bf_lidar/points_raw"]) < 15_000_000


@pytest.mark.parametrize(("name", "area"), [(LOOPS, "s3li_etna"), (LAKE, "s3li_vulcano")])
def test_the_package_finds_all_of_it_and_the_clocks_agree(folder: Path, name: str, area: str) -> None:
    found = find_s3li(folder)
    one = next(one for one in found.sequences if one.name == name)
    assert not one.missing and one.odometry and found.pairs[one.dataset].parent == folder / area / "dataset"
    track, way = read_rtklib(one.truth[0]), read_tum(one.odometry)
    start = int(twin_of(name).start.timestamp()) * 10**9
    assert abs(track.stamps_ns[0] - start) < 7 * 10**9 and abs(way.stamps_ns[0] - start) < 10**9
    calibration = load_calibration(one.dataset)
    body = way.of_body(calibration.body_T_imu)
    poses, known = track.at(body.stamps_ns)
    assert known.mean() > 0.4
    # position of the antenna against that of the IMU, along a few metres without drift to speak of
    assert absolute_trajectory_error(body.poses[known, :3, 3], poses[known, :3, 3]) < 0.25


def test_satellites_have_gaps_and_poor_solutions(folder: Path) -> None:
    path = folder / "s3li_etna/GT" / LOOPS / "global_lle.pos"
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("%")]
    quality = np.array([int(row[5]) for row in rows])
    assert {1, 5} <= set(quality) and (quality == 1).mean() > 0.5
    assert len(read_rtklib(path, 1)) == (quality == 1).sum() < len(read_rtklib(path)) + (quality == 2).sum() + 1
    seconds = np.array([60 * float(row[1].split(":")[1]) + float(row[1].split(":")[2]) for row in rows])
    assert np.diff(seconds).max() > 0.9
    week, of_week = (folder / "s3li_vulcano/d-gnss/2023-07-06.pos").read_text().splitlines()[3].split()[:2]
    assert int(week) == 2269 and 0 < float(of_week) < 604_800
    with pytest.raises(BagError, match="no position of quality 0"):
        read_rtklib(path, 0)


def test_the_toolkits_files_fit_together(folder: Path) -> None:
    area = folder / "s3li_etna"
    table = load_data_frame(area / "dataset" / LOOPS / f"{LOOPS}.pkl")
    assert {str(one) for one in table["seq_name"]} == {LOOPS} and table["point_cloud"][0].shape[1] == 3
    assert np.median(table["point_cloud"][0][:, 2]) > 2  # z of the camera looks ahead
    sequence = read_toolkit([area / "dataset" / LOOPS / f"{LOOPS}.pkl"], area / "dataset")
    sample = sequence.sample(0)
    assert sample.image is not None and sample.image.shape == (512, 688) and sample.image.std() > 8
    lake = next((folder / "s3li_vulcano/dataset" / LAKE / "images").glob("*.png"))
    assert cv2.imread(str(lake)).shape == (386, 516, 3)
    known = {image_key(str(path)) for path in table["img_path"]}
    for query, match, overlap in (
        read_pairs(area / "dataset/s3li_etna_pairs.pkl") if sequence.pass_index.max() > 1 else ()
    ):
        assert {image_key(query), image_key(match)} <= known and 0.5 < overlap <= 1.001


def test_calibrations_say_what_the_drive_was_made_with_and_contradict_the_launch_file(folder: Path) -> None:
    one = next(one for one in find_s3li(folder).sequences if one.name == LAKE)
    cal, chain = (read_stereo(path) for path in one.calibrations)
    assert cal.path.name == "2023-07-06.cal"
    assert cal.left["fx"] == pytest.approx(chain.left["fx"]) and cal.left["fx"] != 1739.0
    assert chain.baseline_m == pytest.approx(0.09066, abs=1e-6)
    assert len(contradictions([cal, chain], ["cal", "chain"], 0.0892)) == 2
    truth = load_calibration(folder / "truth/s3li_vulcano.yaml")
    known, rig = load_calibration("s3li-vulcano"), np.linalg.inv(truth.body_T_imu)
    assert (rig @ truth.body_T_lidar)[:3, 3] == pytest.approx(known.body_T_lidar[:3, 3], abs=2e-4)


def test_all_fourteen_by_name_and_length() -> None:
    assert {one.name for one in TWINS} == set(DATASETS)
    assert {one.name for one in TWINS if one.etna} == {*ETNA_TEST, *ETNA_TRAINING}
    assert twin_of("s3li_crater").scaled(0.1) == 101 and twin_of("s3li_mapping").scaled(0.1) == 60


@pytest.mark.parametrize("scale", [0.1, 1.0])
def test_the_crater_comes_back_once_at_its_end(relief: Relief, scale: float) -> None:
    one = twin_of("s3li_crater")
    preset = one.preset(SEED, scale, ETNA_LAYOUT)
    route = preset.route(relief, SEED)
    motion = Motion(relief, route, preset.speed_m_s, preset.tilt_deg, SEED)
    times = np.arange(0, motion.duration_s, 0.5)
    poses = motion.poses(times)
    assert route.length_m == pytest.approx(one.scaled(scale), abs=0.5) and np.abs(route.path).max() < 125
    again = find_revisits((times * 1e9).astype(np.int64), poses, motion.path_length(times), Loop())
    metres = motion.path_length(times[again])
    # from 12 m before its start on
    assert len(metres) and metres.min() > route.length_m - max(0.01 * one.scaled(scale), 6) - 13
    drift = absolute_trajectory_error(drifting(motion, preset.drift, times, SEED).poses[:, :3, 3], poses[:, :3, 3])
    assert drift > (60 if scale == 1 else 0.5)


def test_a_disorder_can_be_left_out_by_its_name() -> None:
    names = {field.name for field in fields(Disorders)}
    assert {"late_scans", "dummies", "gps_time", "missing_fixes", "imu_frame", "gaps", "drift", "baseline"} <= names
    calm = twin_of("s3li_crater").preset(SEED, 1.0, ETNA_LAYOUT, drifts=False)
    assert calm.drift.turn_deg_m < 0.01


def test_wrong_arguments_are_one_line(tmp_path: Path) -> None:
    runner = CliRunner()
    assert "--out DIR" in str(runner.invoke(umf(), ["simulate", "s3li-twin"]).exception)
    arguments = ["simulate", "s3li-twin", "--out", str(tmp_path), "--sequences", "crater"]
    assert "no sequence 'crater'" in str(runner.invoke(umf(), arguments).exception)
