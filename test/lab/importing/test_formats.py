"""Small folders of every format: imported, inspected, and read as frames with the right geometry."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from command_line import only_line, umf

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.config import load_settings
from umf_ros.core.frames import Frame
from umf_ros.lab.commands.import_data import KINDS
from umf_ros.lab.importing import FORMATS
from umf_ros.sensors.calibration import load_calibration

SIZE = (64, 48)
COUNT = 5
SCANS_ALONE = ("mulran", "helipr", "nclt", "newer-college")
START_S = 1_400_000_000
STAMPS = [START_S * 10**9 + i * 10**8 for i in range(COUNT)]
POINTS = np.random.default_rng(0).uniform((2, -5, -1), (20, 5, 1), (200, 3)).astype("<f4")
PROJECTION = "50 0 32 {} 0 50 24 0 0 0 1 0"
VELO_TO_CAMERA = "0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3"
"""`camera_T_velo`, three rows: a camera that looks ahead, 0.3 m before the LiDAR and 0.1 m below it."""


def picture(path: Path, value: int, size: tuple[int, int] = SIZE) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full(size[::-1], value, np.uint8))


def scan(path: Path, number: int) -> np.ndarray:
    path.parent.mkdir(parents=True, exist_ok=True)
    points = np.random.default_rng(number).uniform((2, -5, -1, 0), (20, 5, 1, 1), (200, 4)).astype("<f4")
    points.tofile(path)
    return points


def kitti_odometry(root: Path) -> Path:
    source = root / "sequences" / "07"
    for i in range(COUNT):
        picture(source / "image_0" / f"{i:06d}.png", 10 * i)
        picture(source / "image_1" / f"{i:06d}.png", 10 * i + 5)
        scan(source / "velodyne" / f"{i:06d}.bin", i)
    (source / "times.txt").write_text("\n".join(f"{0.1 * i:.6e}" for i in range(COUNT)))
    (source / "calib.txt").write_text(
        f"P0: {PROJECTION.format(0)}\nP1: {PROJECTION.format(-10)}\nTr: {VELO_TO_CAMERA}\n"
    )
    (root / "poses").mkdir()
    rows = [f"1 0 0 0 0 1 0 0 0 0 1 {i}" for i in range(COUNT)]  # the camera drives ahead, a metre at a time
    (root / "poses" / "07.txt").write_text("\n".join(rows))
    return source


def kitti_raw(root: Path) -> Path:
    source = root / "2011_09_26_drive_0001_sync"
    stamps = "\n".join(f"2014-05-13 16:53:20.{i}00000000" for i in range(COUNT))
    for name in ("image_00", "image_01", "velodyne_points"):
        for i in range(COUNT):
            path = source / name / "data" / f"{i:010d}"
            scan(path.with_suffix(".bin"), i) if name.startswith("velo") else picture(path.with_suffix(".png"), 10 * i)
        (source / name / "timestamps.txt").write_text(stamps)
    left, right = (f"P_rect_0{i}: {PROJECTION.format(-10 * i)}" for i in range(2))
    rows = "calib_time: 09-Jan-2012", "R_rect_00: 1 0 0 0 1 0 0 0 1", left, right
    (root / "calib_cam_to_cam.txt").write_text("\n".join(rows))
    (root / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.1 -0.3\n")
    return source


def euroc(root: Path) -> Path:
    for name, shift in (("cam0", 0.0), ("cam1", 0.2)):
        folder = root / "mav0" / name
        rows = ["#timestamp [ns],filename"]
        for i in range(COUNT):
            stamp = START_S * 10**9 + i * 50_000_000
            picture(folder / "data" / f"{stamp}.png", 20 * i)
            rows.append(f"{stamp},{stamp}.png")
        (folder / "data.csv").write_text("\n".join(rows))
        (folder / "sensor.yaml").write_text(
            "# camera\nT_BS:\n  cols: 4\n  rows: 4\n"
            f"  data: [1, 0, 0, {shift}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
            "resolution: [64, 48]\nintrinsics: [50, 50, 32, 24]\ndistortion_coefficients: [0, 0, 0, 0]\n"
        )
    (truth := root / "mav0" / "state_groundtruth_estimate0").mkdir()
    lines = [f"{START_S * 10**9 + i * 50_000_000},{i},0,0,1,0,0,0,0,0,0" for i in range(COUNT)]
    (truth / "data.csv").write_text("#timestamp, p, q\n" + "\n".join(lines))
    return root


def tum_rgbd(root: Path) -> Path:
    (root / "depth").mkdir(parents=True)
    times = [f"{START_S + 0.1 * i:.4f}" for i in range(COUNT)]
    for i in range(COUNT):
        picture(root / "rgb" / f"{i}.png", 20 * i, (640, 480))
        cv2.imwrite(str(root / "depth" / f"{i}.png"), np.full((480, 640), 10_000, np.uint16))  # 2 m ahead
    for name, row in {"rgb": "rgb/{}.png", "depth": "depth/{}.png", "groundtruth": "{} 0 0 0 0 0 1"}.items():
        rows = [f"{time} {row.format(i)}" for i, time in enumerate(times)]
        (root / f"{name}.txt").write_text("# comment\n" + "\n".join(rows))
    return root


def nuscenes(root: Path) -> Path:
    turned = [0.7071067811865476, 0, 0, 0.7071067811865476]  # w first: the LiDAR looks to the left
    mounted = [
        {"token": "c", "sensor_token": "1", "translation": [1.7, 0, 1.5], "rotation": [0.5, -0.5, 0.5, -0.5]},
        {"token": "l", "sensor_token": "2", "translation": [0.9, 0, 1.8], "rotation": turned},
    ]
    mounted[0]["camera_intrinsic"], mounted[1]["camera_intrinsic"] = [[50, 0, 32], [0, 50, 24], [0, 0, 1]], []
    poses, taken = [], []
    for i in range(COUNT):
        micros = START_S * 10**6 + i * 100_000
        poses.append({"token": f"e{i}", "translation": [100.0 + i, 5, 0], "rotation": [1, 0, 0, 0]})
        picture(root / "samples" / "CAM_FRONT" / f"{i}.jpg", 20 * i)
        points = scan(root / "sweeps" / "LIDAR_TOP" / f"{i}.pcd.bin", i)
        np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(
            root / "sweeps" / "LIDAR_TOP" / f"{i}.pcd.bin"
        )
        for sensor, name in (("c", f"samples/CAM_FRONT/{i}.jpg"), ("l", f"sweeps/LIDAR_TOP/{i}.pcd.bin")):
            row = {"calibrated_sensor_token": sensor, "ego_pose_token": f"e{i}", "timestamp": micros, "filename": name}
            taken.append(row)
    taken.append({**taken[0], "filename": "samples/CAM_FRONT/of_another_blob.jpg"})
    sensors = [{"token": "1", "channel": "CAM_FRONT"}, {"token": "2", "channel": "LIDAR_TOP"}]
    tables = {"sensor": sensors, "calibrated_sensor": mounted, "ego_pose": poses, "sample_data": taken}
    (root / "v1.0-mini").mkdir()
    for name, rows in (tables | {"log": [{"token": "g", "location": "boston-seaport"}]}).items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return root


def folder(root: Path) -> Path:
    rows = []
    for i in range(COUNT):
        picture(root / "left" / f"{i}.png", 20 * i)
        picture(root / "right" / f"{i}.png", 20 * i)
        scan(root / "scans" / f"{i}.bin", i)
        rows += [f"{name} {START_S + 0.1 * i:.3f}" for name in (f"left/{i}.png", f"right/{i}.png", f"scans/{i}.bin")]
    (root / "times.txt").write_text("\n".join(rows))
    return root


def mulran(root: Path) -> Path:
    for i, stamp in enumerate(STAMPS):
        scan(root / "sensor_data" / "Ouster" / f"{stamp}.bin", i)
    rows = [f"{stamp},1,0,0,{300000 + i},0,1,0,4000000,0,0,1,20" for i, stamp in enumerate(STAMPS)]
    (root / "global_pose.csv").write_text("\n".join(rows))
    return root


def helipr(root: Path) -> Path:
    for name in ("LiDAR/Ouster", "LiDAR_GT"):
        (root / name).mkdir(parents=True)
    for stamp in STAMPS:
        rows = [struct.pack("<ffffIHHH", x, y, z, 0.5, 9, 8, 7, 6) for x, y, z in POINTS]
        (root / "LiDAR" / "Ouster" / f"{stamp}.bin").write_bytes(b"".join(rows))
    rows = [f"{stamp} {i} 0 0 0 0 0 1\n" for i, stamp in enumerate(STAMPS)]
    (root / "LiDAR_GT" / "Ouster_gt.txt").write_text("".join(rows))
    return root


def nclt(root: Path) -> Path:
    (root / "velodyne_sync").mkdir(parents=True)
    for stamp in STAMPS:
        rows = [struct.pack("<HHHBB", *np.rint((row + 100) / 0.005).astype(int), 50, 3) for row in POINTS]
        (root / "velodyne_sync" / f"{stamp // 1000}.bin").write_bytes(b"".join(rows))
    truth = [f"{stamp // 1000}, {i}, 2, -3, 0, 0, {np.pi / 2}" for i, stamp in enumerate(STAMPS)]
    (root / "groundtruth_2012-01-08.csv").write_text("\n".join([*truth, "9, NaN, NaN, NaN, NaN, NaN, NaN"]))
    return root


def newer_college(root: Path) -> Path:
    (root / "raw_format" / "ouster_scan").mkdir(parents=True)
    header = b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 200\nHEIGHT 1\nPOINTS 200\nDATA binary\n"
    for stamp in STAMPS:
        path = root / "raw_format" / "ouster_scan" / f"cloud_{stamp // 10**9}_{stamp % 10**9:09d}.pcd"
        path.write_bytes(header + POINTS.tobytes())
    return root


SETS = kitti_odometry, kitti_raw, euroc, tum_rgbd, nuscenes, mulran, helipr, nclt, newer_college, folder
MADE: dict[str, Callable[[Path], Path]] = {make.__name__.replace("_", "-"): make for make in SETS}


def imported(kind: str, tmp_path: Path) -> list[Frame]:
    (tmp_path / "set").mkdir()
    source = MADE[kind](tmp_path / "set")
    ended = umf("import", kind, source, tmp_path / "made.mcap")
    assert ended.status == 0 and "next: umf replay" in ended.text, ended.text
    told: list[str] = []
    settings = load_settings(tmp_path / "made.yaml")
    frames = list(FrameReader(open_bag(tmp_path / "made.mcap"), settings, warn=told.append))
    # only bare folders come without a calibration
    assert ["holds guesses" in warning for warning in told] == [True] * (kind == "folder"), told
    return frames


@pytest.mark.parametrize("kind", MADE)
def test_every_format_becomes_frames(kind: str, tmp_path: Path) -> None:
    frames = imported(kind, tmp_path)
    assert len(frames) == COUNT
    assert all((frame.left is not None) == (kind not in SCANS_ALONE) for frame in frames)
    assert all((frame.points is not None) == (kind != "euroc") for frame in frames)
    assert all((frame.right is not None) == (kind not in ("tum-rgbd", "nuscenes", *SCANS_ALONE)) for frame in frames)
    assert np.allclose(np.diff([frame.stamp_ns for frame in frames]), 50_000_000 if kind == "euroc" else 10**8)
    inspected = umf("inspect", tmp_path / "made.mcap")
    assert "no match is allowed" in inspected.text and "fault: " not in inspected.text  # it is the last line


@pytest.mark.parametrize("kind", MADE)
def test_a_folder_is_read_as_what_is_imported_of_it(kind: str, tmp_path: Path) -> None:
    frames, source = imported(kind, tmp_path), MADE[kind](tmp_path / "again")
    if kind in ("euroc", "folder"):
        needs = f"needs a calibration, which is written by umf import {kind} {source} {source.name}.mcap"
        assert only_line(umf("replay", source)) == f"{source} has files of {kind} and {needs}"
        return
    bag = open_bag(source)
    read = list(FrameReader(bag, settings_for(bag, None, "auto")))
    assert [frame.stamp_ns for frame in read] == [frame.stamp_ns for frame in frames]
    for one, other in zip(read, frames, strict=True):
        np.testing.assert_allclose(one.points, other.points, atol=1e-5)
        np.testing.assert_allclose(one.body_T_lidar, other.body_T_lidar, atol=1e-9)
        assert (one.left is None) == (other.left is None) and (one.left is None or (one.left == other.left).all())
        if one.left is not None:
            assert one.camera == other.camera
            np.testing.assert_allclose(one.body_T_camera, other.body_T_camera, atol=1e-9)
    truth, same = read_ground_truth(bag), read_ground_truth(open_bag(tmp_path / "made.mcap"))
    assert (truth is None) == (same is None) == (kind in ("kitti-raw", "newer-college"))
    assert truth is None or np.allclose(truth.poses, same.poses, atol=1e-9)


@pytest.mark.parametrize("kind", ["kitti-odometry", "kitti-raw", "nuscenes", "folder"])
def test_without_its_images_a_set_needs_no_camera(kind: str, tmp_path: Path) -> None:
    source = MADE[kind](tmp_path)
    for path in (*source.rglob("*.png"), *source.rglob("*.jpg")):
        path.unlink()
    if kind == "folder":
        rows = (source / "times.txt").read_text().splitlines()
        (source / "times.txt").write_text("\n".join(row for row in rows if row.startswith("scans")))
    assert umf("import", kind, source, tmp_path / "made.mcap").status == 0
    made, bag = load_settings(tmp_path / "made.yaml"), open_bag(source)
    for one, settings in ((open_bag(tmp_path / "made.mcap"), made), (bag, settings_for(bag, None, "auto"))):
        frames = list(FrameReader(one, settings))
        assert len(frames) == COUNT and all(frame.points is not None for frame in frames)
        assert all(frame.left is None for frame in frames)


def test_scans_of_one_time_or_minutes_apart_or_missing_are_named(tmp_path: Path) -> None:
    table = folder(tmp_path) / "times.txt"
    scans = [line.split()[0] for line in table.read_text().splitlines() if line.startswith("scans")]
    for apart_s, told in ((100, "scans 100.0 s apart, from which none"), (0, "all messages have the same time")):
        table.write_text("\n".join(f"{scan} {1000 + apart_s * number}" for number, scan in enumerate(scans)))
        assert told in umf("inspect", table.parent).out
    table.write_text("none.bin 1.0")
    assert "there is no file none.bin" in only_line(umf("inspect", table.parent))


def test_the_axes_of_nclt_point_up(tmp_path: Path) -> None:
    """Its car drives north, and its body and scanner are seen upside down."""
    imported("nclt", tmp_path)
    truth = read_ground_truth(open_bag(tmp_path / "made.mcap"))
    assert truth is not None and len(truth) == COUNT
    np.testing.assert_allclose(truth.poses[1, :3, 3], [1, -2, 3], atol=1e-9)
    np.testing.assert_allclose(truth.poses[1, :3, 0], [0, -1, 0], atol=1e-9)  # heading east: to the right of north
    np.testing.assert_allclose(truth.poses[1, :3, 2], [0, 0, 1], atol=1e-9)
    assert load_calibration(str(tmp_path / "made.calibration.yaml")).body_T_lidar[2, 2] < -0.99


@pytest.mark.parametrize(
    ("kind", "file", "content", "message"),
    [
        ("mulran", "global_pose.csv", "1,2,3\n", "expected lines of a stamp and 12 numbers"),
        ("mulran", "sensor_data/Ouster/first.bin", "", "names of scans are no stamps"),
        ("helipr", "LiDAR_GT/Ouster_gt.txt", "1 2\n", "Ouster_gt.txt, line 1: expected 8 numbers"),
        ("helipr", f"LiDAR/Ouster/{START_S}000000000.bin", "12345", "5 bytes are no records of 26"),
        ("nclt", "groundtruth_2012-01-08.csv", "a,b,c,d,e,f,g\n", "cannot read"),
        ("newer-college", "raw_format/ouster_scan/cloud_1.pcd", "", "names of scans are no stamps"),
    ],
)
def test_a_malformed_folder_is_one_clear_line(kind: str, file: str, content: str, message: str, tmp_path: Path) -> None:
    source = MADE[kind](tmp_path / "set")
    (source / file).write_text(content)
    assert message in only_line(umf("inspect", source))


def test_kittis_camera_looks_ahead_from_its_lidar_and_drives_that_way(tmp_path: Path) -> None:
    frame = imported("kitti-odometry", tmp_path)[0]
    np.testing.assert_allclose(frame.body_T_camera[:3, 2], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(frame.body_T_camera[:3, 3], [0.3, 0, -0.1], atol=1e-9)
    assert frame.camera.baseline == pytest.approx(0.2) and (frame.camera.width, frame.camera.fx) == (64, 50)
    truth = read_ground_truth(open_bag(tmp_path / "made.mcap"))
    assert truth is not None
    np.testing.assert_allclose(truth.poses[:, :3, 3], [[i, 0, 0] for i in range(COUNT)], atol=1e-9)
    assert frame.intensity is not None and 0 < frame.intensity.max() <= 1


def test_depth_images_are_scans_ahead_of_the_camera(tmp_path: Path) -> None:
    frame = imported("tum-rgbd", tmp_path)[2]
    assert frame.points is not None
    np.testing.assert_allclose(frame.points[:, 0], 2.0, atol=1e-5)
    assert len(frame.points) == 160 * 120


def test_nuscenes_is_seen_from_its_ego_frame(tmp_path: Path) -> None:
    frame = imported("nuscenes", tmp_path)[0]
    np.testing.assert_allclose(frame.body_T_camera[:3, 2], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(frame.body_T_camera[:3, 3], [1.7, 0, 1.5], atol=1e-9)
    assert frame.points is not None and frame.points[:, 1].min() > 1  # what the LiDAR has ahead lies to the left
    truth = read_ground_truth(open_bag(tmp_path / "made.mcap"))
    assert truth is not None
    np.testing.assert_allclose(truth.poses[:, :3, 3], [[100 + i, 5, 0] for i in range(COUNT)], atol=1e-9)


@pytest.mark.parametrize(
    ("table", "content", "message"),
    [
        ("log", [{"location": "boston"}, {"location": "singapore"}], "2 cities (boston, singapore)"),
        ("ego_pose", {"no": "rows"}, "expected a list of rows"),
        ("sensor", [{"token": 3}], "not the tables of nuScenes"),
        ("sample_data", [], "neither images nor scans"),
    ],
)
def test_tables_that_are_none_are_one_clear_line(tmp_path: Path, table: str, content: object, message: str) -> None:
    source = nuscenes(tmp_path / "set")
    (source / "v1.0-mini" / f"{table}.json").write_text(json.dumps(content))
    assert message in only_line(umf("import", "nuscenes", source, tmp_path / "a.mcap"))


def test_eurocs_pair_is_rectified(tmp_path: Path) -> None:
    assert imported("euroc", tmp_path)[0].camera.baseline == pytest.approx(0.2, abs=1e-6)


def with_lens(root: Path, camera: str, distortion: str, coefficients: list[float]) -> Path:
    source = euroc(root)
    for name in ("cam0", "cam1"):
        path = source / "mav0" / name / "sensor.yaml"
        models = f"camera_model: {camera}\ndistortion_model: {distortion}\n"
        path.write_text(models + path.read_text().replace("[0, 0, 0, 0]", str(coefficients)))
    return source


def test_a_fisheye_of_euroc_stays_one(tmp_path: Path) -> None:
    """Its coefficients as those of another lens are 42 px wrong at 45 deg."""
    source = with_lens(tmp_path / "set", "pinhole", "equidistant", [0.0035, 0.0007, -0.002, 0.0002])
    umf("import", "euroc", source, tmp_path / "made.mcap")
    left = yaml.safe_load((tmp_path / "made.calibration.yaml").read_text())["raw_camera"]["left"]
    assert (left["distortion_model"], left["distortion"][0]) == ("equidistant", 0.0035)
    assert load_calibration(tmp_path / "made.calibration.yaml").camera.baseline == pytest.approx(0.2, abs=1e-6)


@pytest.mark.parametrize(
    "models", [("omni", "radtan"), ("eucm", "none"), ("ds", "none"), ("pinhole", "fov"), ("pinhole", "field-of-view")]
)
def test_lenses_that_cannot_be_rectified_are_named(tmp_path: Path, models: tuple[str, str]) -> None:
    source = with_lens(tmp_path / "set", *models, [0.1, 0, 0, 0])
    assert f"the model {'-'.join(models)} cannot be rectified" in only_line(
        umf("import", "euroc", source, tmp_path / "a.mcap")
    )


def test_an_imported_recording_is_of_no_known_data_set_and_never_overwritten(tmp_path: Path) -> None:
    """Its calibration may have been measured meanwhile."""
    imported("folder", tmp_path)
    assert "no topic of a known data set" in umf("replay", tmp_path / "made.mcap", "--out", tmp_path).text
    assert "calibration names a file" in only_line(umf("replay", tmp_path / "made.mcap", "--out", tmp_path / "out"))
    (tmp_path / "made.mcap").unlink()
    (tmp_path / "made.calibration.yaml").write_text("measured")
    again = only_line(umf("import", "folder", tmp_path / "set", tmp_path / "made.mcap"))
    assert "made.calibration.yaml is there already: nothing was written" in again
    assert (tmp_path / "made.calibration.yaml").read_text() == "measured"
    (tmp_path / "set" / "times.txt").rename(tmp_path / "times.txt")
    assert "scans and images need a times.txt of lines FILE SECONDS" in only_line(umf("inspect", tmp_path / "set"))


@pytest.mark.parametrize("time", ["1625644800000000000", "-5", "1e30", "nan", "soon"])
@pytest.mark.parametrize(
    ("kind", "table", "column"),
    [("folder", "times.txt", 1), ("tum-rgbd", "rgb.txt", 0), ("kitti-odometry", "times.txt", 0)],
)
def test_times_that_are_no_seconds_are_one_clear_line(
    tmp_path: Path, kind: str, table: str, column: int, time: str
) -> None:
    source = MADE[kind](tmp_path / "set")
    text = (source / table).read_text()
    (source / table).write_text(text.replace(text.split()[column], time, 1))
    assert f"{table}: expected lines" in only_line(umf("import", kind, source, tmp_path / "a.mcap"))


def test_the_command_knows_every_format() -> None:
    assert set(KINDS) == set(FORMATS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["waymo", ".", "a.mcap"], "unknown kind 'waymo'; expected kitti-odometry, kitti-raw, euroc"),
        (["folder", "nowhere", "a.mcap"], "there is no folder nowhere"),
        (["folder", "{empty}", "a.bag"], "the name must end in .mcap"),
        (["folder", "{empty}", "a.mcap"], "times.txt"),
        (["kitti-odometry", "{empty}", "a.mcap"], "calib.txt"),
        (["kitti-raw", "{empty}", "a.mcap"], "calib_cam_to_cam.txt"),
        (["euroc", "{empty}", "a.mcap"], "sensor.yaml"),
        (["tum-rgbd", "{empty}", "a.mcap"], "rgb.txt"),
        (["nuscenes", "{empty}", "a.mcap"], "holds no tables: expected a folder v1.0-mini"),
    ],
)
def test_a_folder_of_another_format_is_one_clear_line(tmp_path: Path, arguments: list[str], message: str) -> None:
    (tmp_path / "empty").mkdir()
    filled = [text.format(empty=tmp_path / "empty") for text in arguments]
    assert message in only_line(umf("import", *filled[:2], tmp_path / filled[2]))
    assert not (tmp_path / "a.mcap").exists()
