"""Every sensor against the truth it was made from."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import invert, relative, transform
from umf_ros.embedding.inputs import is_blank
from umf_ros.lab.simulation import motion_sensors
from umf_ros.lab.simulation.camera import TRAINING_SIZE, Camera, Sun, resized
from umf_ros.lab.simulation.lidar import PERIOD_NS, POINTS, VULCANO, Lidar, eyes, mosaic
from umf_ros.lab.simulation.world import ROCK


@pytest.fixture(scope="module")
def stereo(drive):
    exposure = drive.exposures[8]
    return drive.picture(exposure), drive.picture(exposure, right=True), exposure


def pixels(camera, points):
    """Pixels and depths of (N, 3) points in the camera frame."""
    depth = points[:, 2]
    return np.stack(
        [camera.fx * points[:, 0] / depth + camera.cx, camera.fy * points[:, 1] / depth + camera.cy], 1
    ), depth


def inside(camera, uv, depth, margin=2):
    limits = [camera.width - 1 - margin, camera.height - 1 - margin]
    return (depth > 0.5) & (uv >= margin).all(1) & (uv <= limits).all(1)


def test_lidar_points_land_on_the_rendered_depth(drive, stereo):
    """The scan, with its motion, against the depth of the image: 3 cm and 1 px in the median."""
    picture, _, exposure = stereo
    calibration, number = drive.calibration, 8
    scan, stamp = drive.scan(number), int(drive.scan_stamps_ns[number])
    ends = [drive.pose(stamp) @ calibration.body_T_lidar, drive.pose(stamp + PERIOD_NS) @ calibration.body_T_lidar]
    points = Lidar(drive.world).motion_free(scan, relative(*ends))[scan.intensity > 0]
    world_T_camera = drive.pose(exposure.stamp_ns) @ calibration.body_T_camera
    uv, depth = pixels(calibration.camera, transform(invert(world_T_camera) @ ends[0], points.astype(float)))
    seen = inside(calibration.camera, uv, depth)
    column, row = np.round(uv[seen]).astype(int).T
    error = depth[seen] - picture.depth[row, column]
    assert seen.sum() > 4000
    assert np.median(np.abs(error)) < 0.03
    assert abs(np.median(error)) < 0.01
    # where a pixel's own point lies: back-projected with the rendered depth and compared on the image
    other = np.stack([column, row], 1) - uv[seen]
    assert np.median(np.linalg.norm(other, axis=1)) < 1


def test_disparity_agrees_with_depth(drive, stereo):
    """Corners placed from the left into the right image move by what their depth says."""
    left, right, _ = stereo
    camera = drive.calibration.camera
    corners = cv2.goodFeaturesToTrack(left.image, 800, 0.01, 8, mask=(left.depth > 0).astype(np.uint8))
    placed, found, _ = cv2.calcOpticalFlowPyrLK(left.image, right.image, corners, None, winSize=(13, 13), maxLevel=4)
    column, row = np.round(corners[:, 0]).astype(int).T
    expected = camera.fx * camera.baseline / left.depth[row, column]
    moved = (corners - placed)[:, 0]
    error = (moved[:, 0] - expected)[found[:, 0] == 1]
    assert len(error) > 300
    assert np.median(np.abs(error)) < 0.3
    assert abs(np.median(error)) < 0.1
    assert np.median(np.abs(moved[found[:, 0] == 1, 1])) < 0.2


def test_depth_of_the_right_image_is_that_of_the_left_shifted(drive, stereo):
    left, right, _ = stereo
    camera = drive.calibration.camera
    row, column = np.mgrid[300:500:7, 150:600:7].reshape(2, -1)
    depth = left.depth[row, column]
    shifted = column - camera.fx * camera.baseline / depth
    other = right.depth[row, np.round(shifted).astype(int)]
    assert np.median(np.abs(other - depth)) < 0.02


def test_an_image_has_light_texture_and_labels(drive, stereo):
    picture, _, _ = stereo
    assert picture.image.shape == (512, 688) and picture.image.dtype == np.uint8
    assert picture.image.std() > 15 and 40 < picture.image.mean() < 230
    rocks = picture.semantic == ROCK
    assert rocks.any() and (picture.instance[rocks] > 0).all() and (picture.instance[~rocks] == 0).all()
    assert ((picture.depth == 0) == (picture.semantic == 255)).all()


def test_the_sun_changes_the_picture_and_not_the_depth(drive):
    camera = Camera(drive.world, resized(drive.calibration.camera, *TRAINING_SIZE))
    pose = drive.pose(drive.exposures[3].stamp_ns) @ drive.calibration.body_T_camera
    morning, noon = (camera.take(pose, Sun(azimuth, 25), np.random.default_rng(0)) for azimuth in (20, 200))
    assert np.array_equal(morning.depth, noon.depth)
    difference = np.abs(morning.image.astype(float) - noon.image)[morning.depth > 0].mean()
    again = camera.take(pose, Sun(20, 25), np.random.default_rng(1)).image
    assert difference > 3 * np.abs(morning.image.astype(float) - again).mean()


def test_the_small_camera_sees_the_whole_picture(drive):
    full = drive.calibration.camera
    small = resized(full, *TRAINING_SIZE)
    assert (small.width, small.height) == TRAINING_SIZE
    left_edge = (-0.5 - full.cx) / full.fx
    assert (-0.5 - small.cx) / small.fx == pytest.approx(left_edge)
    assert (small.width - 0.5 - small.cx) / small.fx == pytest.approx((full.width - 0.5 - full.cx) / full.fx)


def test_motion_blurs_along_the_motion_only(drive):
    camera = Camera(drive.world, resized(drive.calibration.camera, *TRAINING_SIZE))
    pose = drive.pose(drive.exposures[3].stamp_ns) @ drive.calibration.body_T_camera
    sharp, blurred = (
        camera.take(pose, Sun(20, 25), np.random.default_rng(0), 1.0, np.array(smear)).image.astype(float)
        for smear in ([0.0, 0.0], [5.0, 0.0])
    )
    across = [np.abs(np.diff(image[120:], axis=1)).mean() for image in (sharp, blurred)]
    along = [np.abs(np.diff(image[120:], axis=0)).mean() for image in (sharp, blurred)]
    assert across[1] / across[0] < 0.9 * along[1] / along[0]


def test_a_scan_has_the_pattern_of_the_cube(drive):
    scan = drive.scan(2)
    assert len(scan.points) == POINTS == 17_400
    missing = scan.intensity == 0
    assert np.allclose(np.linalg.norm(scan.points[missing], axis=1), 1, atol=1e-5) and missing.any()
    azimuth = np.degrees(np.arctan2(scan.points[:, 0], scan.points[:, 1]))
    elevation = np.degrees(np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1)))
    assert np.ptp(azimuth) == pytest.approx(70, abs=0.1)
    assert np.ptp(elevation) == pytest.approx(30, abs=0.1)
    assert scan.offset_ns[0] == 0 and 0.98 * PERIOD_NS < scan.offset_ns[-1] < PERIOD_NS
    assert (np.diff(scan.offset_ns.astype(np.int64)) >= 0).all()


def test_motion_during_a_scan_bends_it_and_can_be_taken_out(drive):
    lidar = Lidar(drive.world)
    start = drive.pose(int(drive.scan_stamps_ns[5])) @ drive.calibration.body_T_lidar
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("z", 6, degrees=True).as_matrix()
    turned[:3, 3] = [0, 0.5, 0]
    still, moving = (lidar.scan(start, np.random.default_rng(0), end) for end in (None, start @ turned))
    both = (still.intensity > 0) & (moving.intensity > 0)
    unbent = lidar.motion_free(moving, turned)
    last = both & (np.arange(POINTS) > 0.2 * POINTS)
    tree = cKDTree(still.points[both])
    bent, corrected = (np.median(tree.query(points[last])[0]) for points in (moving.points, unbent))
    assert corrected < 0.6 * bent


def test_imu_agrees_with_the_motion(drive):
    data = motion_sensors.measure_imu(drive.motion, drive.calibration.body_T_imu, drive.duration_s, drive.seed)
    assert 1 / np.diff(data.times_s).mean() == pytest.approx(400)
    mounting = Rotation.from_matrix(drive.calibration.body_T_imu[:3, :3])
    turn = mounting.inv() * Rotation.from_matrix(
        relative(drive.motion.pose(0), drive.motion.pose(data.times_s[-1]))[:3, :3]
    )
    step = Rotation.identity()
    for rate in data.rate[:-1]:
        step = step * Rotation.from_rotvec(rate / 400)
    assert ((turn * mounting).inv() * step).magnitude() < np.radians(1)
    assert np.linalg.norm(data.force, axis=1).mean() == pytest.approx(motion_sensors.GRAVITY_M_S2, abs=0.3)


def test_gnss_positions_come_back_in_gps_time(drive):
    track = motion_sensors.measure_gnss(drive.motion, drive.duration_s, drive.seed)
    first = track.geodetic[0]
    metres = (track.geodetic[-1, :2] - first[:2]) * [111_000, 111_320 * np.cos(np.radians(first[0]))]
    true = drive.motion.pose(track.times_s[-1])[:2, 3] - drive.motion.pose(0)[:2, 3]
    assert metres[::-1] == pytest.approx(true, abs=0.15)
    line = motion_sensors.rtklib_text(track, 1_625_644_800 * 10**9 + 250_000_000).splitlines()[3].split()
    assert line[:2] == ["2021/07/07", "08:00:18.250"]
    assert float(line[2]) == pytest.approx(first[0], abs=1e-9) and line[5] in "12"


def test_raw_colour_cameras_are_bent_and_rectify_to_the_calibrated_pair(drive):
    calibration = VULCANO.load()
    left, _ = eyes(drive.world, VULCANO, calibration)
    pose = drive.pose(drive.exposures[3].stamp_ns)
    raw = left.camera.take(pose @ left.body_T_camera, Sun(30, 30), np.random.default_rng(0))
    ideal = Camera(drive.world, calibration.camera)
    flat = ideal.take(pose @ calibration.body_T_camera, Sun(30, 30), np.random.default_rng(0))
    rectified = calibration.rectifier.apply(raw.image, 0)
    match = np.corrcoef(rectified[200:500].ravel(), flat.image[200:500].ravel())[0, 1]
    resized_raw = cv2.resize(raw.image, (688, 512), interpolation=cv2.INTER_AREA)
    assert match > 0.8
    assert match > np.corrcoef(resized_raw[200:500].ravel(), flat.image[200:500].ravel())[0, 1] + 0.02
    colours = mosaic(np.full((4, 4), 100, np.uint8))
    assert colours[0, 0] > colours[0, 1] > colours[1, 1]


def test_after_sunset_a_camera_soon_sees_nothing(drive):
    camera = Camera(drive.world, resized(drive.calibration.camera, *TRAINING_SIZE))
    pose = drive.pose(drive.exposures[8].stamp_ns) @ drive.calibration.body_T_camera
    day = Sun(30.0, 25.0)
    taken = [
        camera.take(pose, sun, np.random.default_rng(0)).image
        for sun in (day, day.set_for(2), day.set_for(3.5), day.set_for(40))
    ]
    contrast = [image.std() for image in taken]
    assert contrast[0] == contrast[1] > contrast[2] > 4 and is_blank(taken[3])  # exposure and gain make up for it first
    assert day.set_for(40).strength == day.set_for(7).strength < 1e-5 and day.set_for(-1).strength == 1
