from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from recordings import CALIBRATION, camera_info, traverse, write_mcap

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import load_settings
from umf_ros.core.errors import CalibrationError
from umf_ros.core.geometry import make_pose, transform
from umf_ros.sensors.calibration import RawCamera, SensorWindow, StereoRectifier, load_calibration
from umf_ros.sensors.decode import decode_camera_info

DATASETS = ("simulated", "s3li-etna", "s3li-vulcano")


@pytest.mark.parametrize("name", DATASETS)
def test_axes_of_every_data_set_are_as_the_frames_say(name: str) -> None:
    calibration = load_calibration(name)
    camera, lidar = calibration.body_T_camera[:3, :3], calibration.body_T_lidar[:3, :3]
    for pose in (camera, lidar, calibration.body_T_imu[:3, :3]):
        assert np.allclose(pose @ pose.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(pose) == pytest.approx(1)
    forward, left, up = np.eye(3)
    # the simulated camera looks down by some degrees
    assert camera[:, 2] @ forward > 0.97 and camera[:, 0] @ left < -0.97 and camera[:, 1] @ up < -0.97
    assert lidar[:, 1] @ forward > 0.97 and lidar[:, 0] @ left < -0.97 and lidar[:, 2] @ up > 0.97
    # both sensors sit on one bar
    assert np.linalg.norm(calibration.body_T_camera[:3, 3] - calibration.body_T_lidar[:3, 3]) < 0.2


def test_etna_imu_hangs_upside_down_and_feels_gravity_upwards_in_the_body() -> None:
    calibration = load_calibration("s3li-etna")
    at_rest = np.array([0.0, 0.0, -9.81])  # what an accelerometer reads whose z axis points down
    assert np.allclose(calibration.body_T_imu[:3, :3] @ at_rest, [0, 0, 9.81], atol=1e-5)


def test_etna_camera_is_where_the_data_set_says_relative_to_the_imu() -> None:
    imu_T_camera = np.linalg.inv(load_calibration("s3li-etna").body_T_imu) @ load_calibration("s3li-etna").body_T_camera
    published = np.array(
        [
            [0.9999198, 0.00649271, -0.01087349, -0.1372],
            [-0.01079265, -0.01235939, -0.99986537, -0.0551],
            [-0.00662623, 0.99990254, -0.01228832, -0.0691],
            [0, 0, 0, 1],
        ]
    )
    assert np.allclose(imu_T_camera, published, atol=1e-6)


def test_etna_lidar_points_land_where_the_data_set_projects_them() -> None:
    calibration = load_calibration("s3li-etna")
    camera_T_lidar = np.linalg.inv(calibration.body_T_camera) @ calibration.body_T_lidar
    rotation = [[0.997479, -0.059131, -0.039222], [-0.040101, -0.013762, -0.999101], [0.058538, 0.998155, -0.016099]]
    assert np.allclose(camera_T_lidar, make_pose(rotation, [0.1, 0, 0]), atol=2e-6)
    assert calibration.lidar_time_offset_s == pytest.approx(0.1)


RAW = {"width": 64, "height": 48, "fx": 1e-300, "fy": 1e300, "cx": 1e300, "cy": 0.0, "distortion": [1e300] * 8}
NO_PAIR = {
    "left": RAW,
    "right": RAW,
    "left_T_right": {"translation": [0.0, 0.0, 0.0], "quaternion": [0.0, 0.0, 0.0, 1.0]},
    "width": 64,
    "height": 48,
}


def test_camera_info_replaces_intrinsics_and_keeps_a_known_baseline() -> None:
    calibration = load_calibration("s3li-etna")
    left, right = camera_info(0, 500.0, (688, 512)), camera_info(0, 500.0, (688, 512), baseline=0.3)
    both = calibration.with_camera(decode_camera_info(left, right))
    assert (both.camera.fx, both.camera.baseline) == (500, pytest.approx(0.3))
    assert calibration.with_camera(decode_camera_info(left)).camera.baseline == calibration.camera.baseline
    raw = load_calibration("s3li-vulcano")
    assert raw.with_camera(decode_camera_info(left, right)) is raw


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"min_intensity": None}, "min_intensity"),
        ({"min_intensty": 3}, "unknown parameter min_intensty"),
        ({"body_T_lidar": {"translation": [0, 0, 0], "quaternion": [0, 0, 0, 2]}}, "body_T_lidar.quaternion"),
        ({"body_T_camera": {"translation": [0, 0], "quaternion": [0, 0, 0, 1]}}, "body_T_camera.translation"),
        ({"camera": {"width": 0}}, "camera.width"),
        ({"camera": None}, "either camera"),
        ({"lidar_time_offset_s": "soon"}, "lidar_time_offset_s"),
        ({"lidar_time_offset_s": 1e300}, "lidar_time_offset_s"),
        ({"camera": {"width": 10**9}}, "camera.width"),
        ({"body_T_lidar": {"translation": [0, float("nan"), 0], "quaternion": [0, 0, 0, 1]}}, "body_T_lidar"),
        ({"camera": None, "raw_camera": NO_PAIR}, "no calibration of real sensors"),
    ],
)
def test_faults_are_named_by_key_on_one_line(change: dict[str, object], text: str, tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(CALIBRATION) | change))
    with pytest.raises(CalibrationError) as caught:
        load_calibration(path)
    assert text in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_key_missing_file_and_no_yaml(tmp_path: Path) -> None:
    content = yaml.safe_load(CALIBRATION)
    del content["body_T_imu"]
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(CalibrationError, match="body_T_imu is missing"):
        load_calibration(path)
    with pytest.raises(CalibrationError, match="cannot read"):
        load_calibration(tmp_path / "nothing.yaml")
    path.write_text("camera: [")
    with pytest.raises(CalibrationError, match="not valid YAML"):
        load_calibration(path)
    path.write_text("just words")
    with pytest.raises(CalibrationError, match="expected names and values, found a str"):
        load_calibration(path)


def blob(camera: RawCamera, point: np.ndarray, camera_T_left: np.ndarray) -> np.ndarray:
    """A raw image with one bright spot where the camera sees a point of the left camera's frame."""
    rotation, _ = cv2.Rodrigues(camera_T_left[:3, :3])
    distortion = np.array(camera.distortion)
    matrix = camera.matrix((camera.width, camera.height))
    seen_by = cv2.fisheye if camera.distortion_model == "equidistant" else cv2
    pixel, _ = seen_by.projectPoints(point[None, None], rotation, camera_T_left[:3, 3], matrix, distortion)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    away = (u - pixel[0, 0, 0]) ** 2 + (v - pixel[0, 0, 1]) ** 2
    return (250 * np.exp(-away / 72)).astype(np.uint8)


def centre(image: np.ndarray) -> np.ndarray:
    v, u = np.nonzero(image > 30)
    weight = image[v, u].astype(float)
    return np.array([u @ weight, v @ weight]) / weight.sum()


LENSES = {
    "radtan": (-0.2, 0.08, 0.001, -0.0005),
    "rational": (-0.2, 0.08, 0.001, -0.0005, 0.01, 0.02, -0.01, 0.005),
    "thin prism": (-0.2, 0.08, 0.001, -0.0005, 0.01, 0.02, -0.01, 0.005, 0.002, -0.001, 0.001, 0.002),
    "equidistant": (0.0035, 0.0007, -0.002, 0.0002),
}
HALVES = SensorWindow((1032, 772), (0, 0), (1032, 772), (2, 2))
CUT = SensorWindow((1032, 772), (100, 60), (860, 640), (1, 1))
CUT_HALVES = SensorWindow((1032, 772), (100, 60), (860, 640), (2, 2))


@pytest.mark.parametrize("window", [None, HALVES, CUT, CUT_HALVES])
@pytest.mark.parametrize("lens", LENSES)
def test_rectified_pair_sees_points_where_an_ideal_pair_would(lens: str, window: SensorWindow | None) -> None:
    """Also in raw images that show a window of the calibrated sensor, each pixel the mean of those it holds."""
    model = "equidistant" if lens == "equidistant" else "radtan"
    common = {"width": 1032, "height": 772, "distortion": LENSES[lens], "distortion_model": model}
    left = RawCamera(fx=870.0, fy=868.0, cx=520.0, cy=380.0, **common)
    right = RawCamera(fx=865.0, fy=866.0, cx=512.0, cy=390.0, **common)
    turn, _ = cv2.Rodrigues(np.array([0.01, -0.015, 0.02]))
    left_T_right = make_pose(turn, [0.2, 0.003, -0.002])
    rectifier = StereoRectifier(left, right, left_T_right, size=(344, 256))
    if window is not None:
        rectifier = rectifier.within(window)
        assert rectifier.raw_size == window.size
    camera, rectified_T_left = rectifier.camera, np.linalg.inv(rectifier.raw_T_rectified)
    assert camera.baseline == pytest.approx(np.linalg.norm(left_T_right[:3, 3]), rel=1e-6)

    def shown(raw: np.ndarray) -> np.ndarray:
        if window is None:
            return raw
        (x, y), (width, height) = window.offset, window.part
        part = raw[y : y + height, x : x + width]
        return cv2.resize(part, window.size, interpolation=cv2.INTER_AREA)

    for point in np.array([[0.3, -0.2, 4.0], [-1.0, 0.8, 6.0], [1.5, 0.9, 9.0]]):
        seen_left = centre(rectifier.apply(shown(blob(left, point, np.eye(4))), 0))
        seen_right = centre(rectifier.apply(shown(blob(right, point, np.linalg.inv(left_T_right))), 1))
        x, y, z = transform(rectified_T_left, point[None])[0]
        assert np.allclose(seen_left, [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], atol=0.15)
        assert seen_left[1] - seen_right[1] == pytest.approx(0, abs=0.15)
        assert seen_left[0] - seen_right[0] == pytest.approx(camera.fx * camera.baseline / z, abs=0.15)


def test_the_centre_of_a_fisheye_keeps_its_resolution() -> None:
    one = RawCamera(
        **dict(zip(("fx", "fy", "cx", "cy"), (191.0, 191.0, 255.0, 257.0), strict=True)),
        **{"width": 512, "height": 512, "distortion": LENSES["equidistant"], "distortion_model": "equidistant"},
    )
    rectifier = StereoRectifier(one, one, make_pose(np.eye(3), [0.1, 0, 0]), size=(512, 512))
    assert rectifier.camera.fx == pytest.approx(191, rel=0.01) and rectifier.camera.baseline == pytest.approx(0.1)


def test_a_rectified_file_of_the_full_sensor_fits_its_binned_images(tmp_path: Path) -> None:
    full = load_calibration("simulated")
    width, height = full.image_size
    window = SensorWindow((width, height), (0, 0), (width, height), (2, 2))
    half = full.within(window, (width // 2, height // 2))
    assert half.image_size == (width // 2, height // 2)
    assert (half.camera.fx, half.camera.baseline) == (full.camera.fx / 2, full.camera.baseline)
    assert full.within(window, (width, height)) is full
    assert full.within(window._replace(sensor=(1, 1)), (width // 2, height // 2)) is full


@pytest.mark.parametrize(
    ("lens", "text"),
    [
        ({"distortion": [0.1] * 6}, "radtan: expected one of 0, 4, 5, 8, 12, 14 coefficients"),
        ({"distortion": [0.1] * 5, "distortion_model": "equidistant"}, "equidistant: expected one of 0, 4"),
        ({"distortion": [0.1] * 4, "distortion_model": "fov"}, "'radtan' or 'equidistant'"),
        ({"distortion": [0.0] * 4, "distortion_model": "equidistant"}, "both cameras need the same distortion_model"),
    ],
)
def test_lenses_that_are_none_are_named(lens: dict[str, object], text: str, tmp_path: Path) -> None:
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0}
    still = {"translation": [0.2, 0.0, 0.0], "quaternion": [0.0, 0.0, 0.0, 1.0]}
    pair = {"left": camera | lens, "right": camera | {"distortion": [0.0] * 4}, "left_T_right": still}
    content = {"raw_camera": pair | {"width": 64, "height": 48}, "lidar_time_offset_s": 0.0}
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(content | {f"body_T_{one}": still for one in ("camera", "lidar", "imu")}))
    with pytest.raises(CalibrationError, match=text) as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("without", "lacks"), [(("camera", "body_T_camera"), "camera"), (("body_T_lidar",), "lidar")])
def test_a_rover_without_a_sensor_leaves_out_its_entries(tmp_path: Path, without: tuple[str, ...], lacks: str) -> None:
    content = {name: value for name, value in yaml.safe_load(CALIBRATION).items() if name not in without}
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(content))
    found = load_calibration(path)
    assert found.lacks == (lacks,)
    bag = open_bag(write_mcap(tmp_path / "bag.mcap", traverse(1.0)))
    told: list[str] = []
    frames = list(FrameReader(bag, load_settings(None, calibration=str(path)), warn=told.append))
    assert any(f"the calibration has no body_T_{lacks}" in line for line in told)
    assert all((frame.left if lacks == "camera" else frame.points) is None for frame in frames)


def test_a_calibration_of_no_sensor_or_of_half_a_camera_is_refused(tmp_path: Path) -> None:
    content, path = yaml.safe_load(CALIBRATION), tmp_path / "calibration.yaml"
    for without in (("camera", "body_T_camera", "body_T_lidar"), ("body_T_camera",), ("camera",)):
        path.write_text(yaml.safe_dump({name: value for name, value in content.items() if name not in without}))
        with pytest.raises(CalibrationError, match="expected body_T_"):
            load_calibration(path)
