from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from umf_ros.core.errors import CalibrationError, UmfError
from umf_ros.lab.datasets.s3li_folder import (
    contradictions,
    find_s3li,
    image_key,
    read_calde,
    read_camchain,
    read_pairs,
    truth_of,
)
from umf_ros.lab.importing import vslam_lab
from umf_ros.lab.scan_files import SensorFileError
from umf_ros.sensors.calibration import load_calibration

CAL = """# DLR CalLab
camera.0.A=[1740.1 0 1030.5; 0 1741.2 770.25; 0 0 1]
camera.0.k1=-0.1
camera.0.k2=0.08
camera.0.width=2064
camera.0.height=1544
camera.1.A=[1738 0 1029; 0 1739 772; 0 0 1]
camera.1.k1=-0.11
camera.1.p1=0.0004
camera.1.R=[1 0 0; 0 1 0; 0 0 1]
camera.1.T=[90.66 0.1 -2]
camera.1.width=0
camera.1.height=0
"""
CAMCHAIN = {
    "cam0": {
        **{"camera_model": "pinhole", "distortion_model": "radtan", "resolution": [2064, 1544]},
        **{"intrinsics": [1740.0, 1741.0, 1030.0, 770.0], "distortion_coeffs": [-0.1, 0.08, 0.0, 0.0]},
        **{"T_cam_imu": [[0, -1, 0, 0.25], [0, 0, -1, 0.01], [1, 0, 0, 0.0], [0, 0, 0, 1]]},
        "timeshift_cam_imu": 0.009,
    },
    "cam1": {
        **{"camera_model": "pinhole", "distortion_model": "radtan", "resolution": [2064, 1544]},
        **{"intrinsics": [1739.0, 1740.0, 1028.0, 771.0], "distortion_coeffs": [-0.1, 0.08, 0.0, 0.0]},
        "T_cn_cnm1": [[1, 0, 0, -0.0907], [0, 1, 0, 0], [0, 0, 1, 0.002], [0, 0, 0, 1]],
    },
}


def write(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content), encoding="utf-8")
    return path


def test_calde_is_in_millimetres_and_the_right_camera_in_the_left(tmp_path: Path) -> None:
    found = read_calde(write(tmp_path / "a.cal", CAL))
    assert found.left == {
        **{"width": 2064, "height": 1544, "fx": 1740.1, "fy": 1741.2, "cx": 1030.5, "cy": 770.25},
        "distortion": [-0.1, 0.08, 0.0, 0.0],
    }
    assert found.right["width"] == 2064 and found.right["distortion"] == [-0.11, 0.0, 0.0004, 0.0]
    assert found.left_T_right[:3, 3] == pytest.approx([0.09066, 0.0001, -0.002])


def test_camchain_is_in_metres(tmp_path: Path) -> None:
    found = read_camchain(write(tmp_path / "camchain.yaml", CAMCHAIN))
    assert found.baseline_m == pytest.approx(0.0907, abs=1e-4)
    assert found.left_T_right[0, 3] == pytest.approx(0.0907)


def test_a_calibration_of_a_file_is_one_that_the_package_reads(tmp_path: Path) -> None:
    base = yaml.safe_load((Path(__file__).parents[3] / "config/calibration/s3li_vulcano.yaml").read_text())
    found = read_calde(write(tmp_path / "a.cal", CAL))
    calibration = load_calibration(write(tmp_path / "calibration.yaml", base | found.entries()))
    assert calibration.image_size == (2064, 1544)
    assert calibration.camera.baseline == pytest.approx(found.baseline_m)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (CAL, "", "camera.0 and camera.1 are not both there"),
        (CAL, CAL[:120], "camera.0 and camera.1 are not both there"),
        (CAL, CAL[:220], "camera.1.A is |camera.1.R is missing"),
        (CAL[-90:], "", "camera.1.[RT] is "),
        ("90.66 0.1 -2", "0.09066 0.0001 -0.002", "baseline of .* millimetres"),
        ("90.66 0.1 -2", "90.66 0.1", "camera.1.T is .*expected 3 numbers"),
        ("1740.1 0 1030.5", "0.84 0 0.5", "focal length of 0.84 .*expected pixels"),
        ("1740.1 0 1030.5", "nan 0 1030.5", "camera.0.A is"),
        ("[1 0 0; 0 1 0; 0 0 1]", "[2 0 0; 0 1 0; 0 0 1]", "no rotation"),
        ("camera.", "cam;", "not both there"),
    ],
)
def test_a_malformed_calde_file_is_one_line(tmp_path: Path, old: str, new: str, text: str) -> None:
    path = write(tmp_path / "a.cal", CAL.replace(old, new))
    with pytest.raises(CalibrationError, match=text) as error:
        read_calde(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


@pytest.mark.parametrize(
    ("camera", "key", "value", "text"),
    [
        ("cam0", "intrinsics", [1740.0, 1741.0], "cam0.intrinsics is .*expected 4 numbers"),
        ("cam0", "distortion_model", "equidistant", "only pinhole-radtan"),
        ("cam1", "T_cn_cnm1", [[1, 0, 0, -90.7], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]], "baseline of .* metres"),
        ("cam1", "T_cn_cnm1", None, "no 4 x 4 matrix"),
        ("cam1", "resolution", "2064 x 1544", "cam1.resolution"),
        ("cam1", "", None, "cam0 and cam1 are not both there"),
    ],
)
def test_a_malformed_camchain_is_one_line(tmp_path: Path, camera: str, key: str, value: object, text: str) -> None:
    content = {name: dict(values) for name, values in CAMCHAIN.items()}
    if key:
        content[camera][key] = value
    else:
        del content[camera]
    path = write(tmp_path / "camchain.yaml", content)
    with pytest.raises(CalibrationError, match=text) as error:
        read_camchain(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


@pytest.mark.parametrize("content", ["", "cam0: [", "\x00"])
def test_a_camchain_that_is_no_yaml_is_one_line(tmp_path: Path, content: str) -> None:
    with pytest.raises(CalibrationError) as error:
        read_camchain(write(tmp_path / "camchain.yaml", content))
    assert "\n" not in str(error.value)


def test_what_contradicts_each_other_is_told_with_both_numbers(tmp_path: Path) -> None:
    cal = read_calde(write(tmp_path / "a.cal", CAL))
    chain = read_camchain(write(tmp_path / "camchain.yaml", CAMCHAIN))
    told = contradictions([cal, chain], ["a.cal", "camchain"], 0.0892)
    assert len(told) == 2 and "0.08920 m" in told[0] and "0.09068 m" in told[0] and "+1.7 %" in told[0]
    longer = replace(chain, left=chain.left | {"fx": 1800.0})
    told = contradictions([cal, longer], ["a.cal", "camchain"], 0.0907)
    assert told == ["fx of the left camera is 1740.1 px by a.cal and 1800.0 px by camchain (+3.4 %)"]
    assert not contradictions([cal, chain], ["a.cal", "camchain"], 0.0907)


def test_pairs_of_the_toolkit(tmp_path: Path) -> None:
    rows = [("/home/x/dataset/crater/images/img1.png", "/home/x/dataset/loops/images/img2.png", np.float64(0.7))]
    (tmp_path / "pairs.pkl").write_bytes(pickle.dumps(rows))
    assert read_pairs(tmp_path / "pairs.pkl") == [(rows[0][0], rows[0][1], 0.7)]
    assert image_key(rows[0][0]) == "crater/img1.png" == image_key("D:/crater/images/img1.png")


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ([], "no list of overlapping pairs"),
        ({"a": 1}, "no list of overlapping pairs"),
        ([("a", "b")], r"expected rows \(image, image, overlap\)"),
        ([("a", 3, 0.5)], r"expected rows \(image, image, overlap\)"),
        ([("a", "b", 70.0)], "expected a share between 0 and 1"),
        ([("a", "b", "0.7")], "expected a share"),
    ],
)
def test_malformed_pairs_are_one_line(tmp_path: Path, content: object, text: str) -> None:
    path = tmp_path / "pairs.pkl"
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(UmfError, match=text):
        read_pairs(path)
    path.write_bytes(pickle.dumps([("a", "b", 0.5)] * 50)[:60])
    with pytest.raises(UmfError, match="cannot read the pickle"):
        read_pairs(path)


def pos(seconds: float) -> str:
    return f"2269 {seconds:.3f} 38.4 14.96 120.0 1 12\n"


def test_what_is_there_and_what_is_missing(tmp_path: Path) -> None:
    write(tmp_path / "etna/Bagfiles/s3li_loops.bag", "#ROSBAG V2.0\n")
    write(tmp_path / "etna/GT/s3li_loops/global_lle.pos", "")
    write(tmp_path / "etna/GT/s3li_loops/baseline_xyz.pos", "")
    write(tmp_path / "etna/Eval/ORBSLAM/s3li_loops/a.txt", "")
    write(tmp_path / "etna/Eval/BASALT/s3li_loops/b.txt", "")
    write(tmp_path / "vulcano/moon_lake/metadata.yaml", "")  # as rosbags-convert leaves it
    write(tmp_path / "vulcano/d-gnss/day_one.pos", pos(100))
    write(tmp_path / "vulcano/d-gnss/day_two.pos", pos(90_000) + pos(90_001))
    write(tmp_path / "vulcano/cfgs/2023-07-06.cal", CAL)
    write(tmp_path / "vulcano/cfgs/2023-07-05.cal", CAL)
    write(tmp_path / "vulcano/cfgs/kalibr/x-camchain.yaml", "")
    write(tmp_path / "lab/vegetation/rgb.csv", "")
    found = find_s3li(tmp_path)
    loops, vegetation, lake = found.sequences
    assert (loops.name, vegetation.name, lake.name) == ("s3li_loops", "vegetation", "moon_lake")
    assert loops.odometry and loops.odometry.name == "b.txt" and [path.stem for path in loops.truth] == ["global_lle"]
    assert lake.recording == tmp_path / "vulcano/moon_lake"
    assert [path.name for path in lake.calibrations] == ["2023-07-06.cal", "x-camchain.yaml"]
    assert vegetation.export == tmp_path / "lab/vegetation" and vegetation.recording is None
    assert any("no trajectory" in line for line in lake.missing)
    assert [line for line in vegetation.missing if "from the export" in line]
    assert len(found.absent) == 11 and not found.pairs
    start = (315_964_800 + 2269 * 604_800 + 90_000 - 18) * 10**9
    truth = truth_of(lake, start - 10**9, start + 10**9)
    assert truth is not None and truth[0].stem == "day_two"
    assert truth_of(lake, 0, 1) is None


def test_a_folder_without_s3li_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UmfError, match="holds no recording of S3LI"):
        find_s3li(tmp_path)
    with pytest.raises(UmfError, match="there is no folder"):
        find_s3li(tmp_path / "nowhere")


EXPORT = """%YAML:1.0
---
Camera0.fx: 435.2
Camera0.fy: 435.4
Camera0.cx: 258.1
Camera0.cy: 193.2
Stereo.bf: 9.066208e-02
"""


def export(folder: Path, rgb: str, calibration: str = EXPORT) -> Path:
    write(folder / "calibration.yaml", calibration)
    write(folder / "rgb.csv", rgb)
    for number in range(2):
        (folder / f"rgb_{number}").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / f"rgb_{number}" / "1.png"), np.zeros((386, 516), np.uint8))
    return folder


def test_an_export_of_vslam_lab(tmp_path: Path) -> None:
    found = vslam_lab(export(tmp_path, "1688634001.25,rgb_0/1.png,1688634001.26,rgb_1/1.png\n"))
    assert abs(found.left[0][0] - 1_688_634_001_250_000_000) < 1000 and found.right[0][1] == tmp_path / "rgb_1/1.png"
    camera = found.camera["camera"]
    assert (camera["width"], camera["height"], camera["fx"]) == (516, 386, 435.2)
    assert camera["baseline"] == pytest.approx(0.09066208) and found.truth is None and not found.scans


@pytest.mark.parametrize(
    ("rgb", "calibration", "text"),
    [
        ("", EXPORT, "neither images nor scans"),
        ("ts,path\n1,rgb_0/1.png\n", EXPORT, "expected SECONDS,FILE,SECONDS,FILE"),
        ("1,rgb_0/1.png", EXPORT, "expected SECONDS,FILE,SECONDS,FILE"),
        ("1,a,1,b", EXPORT.replace("9.066208e-02", "90.66"), "expected pixels and metres"),
        ("1,a,1,b", EXPORT.replace("435.2", "-1"), "expected pixels and metres"),
        ("1,a,1,b", EXPORT[:32], "expected pixels and metres"),
        ("1,a,1,b", EXPORT[:40], "no calibration of an export"),
        ("1,a,1,b", "", "no calibration of an export"),
    ],
)
def test_a_malformed_export_is_one_line(tmp_path: Path, rgb: str, calibration: str, text: str) -> None:
    with pytest.raises(SensorFileError, match=text) as error:
        vslam_lab(export(tmp_path, rgb, calibration))
    assert "\n" not in str(error.value)
