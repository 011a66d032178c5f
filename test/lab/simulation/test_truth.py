"""Measurements of camera and LiDAR, against the ground they stand on."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from umf_ros.core.geometry import invert, make_pose, transform
from umf_ros.lab.simulation.camera import TRAINING_SIZE, Camera, Sun, resized
from umf_ros.lab.simulation.lidar import (
    LINES,
    PERIOD_NS,
    POINTS,
    PULSES,
    RANGE_M,
    Lidar,
    eyes,
    mosaic,
    pulse_directions,
    pulse_times,
)
from umf_ros.lab.simulation.relief import SIZE_M
from umf_ros.lab.simulation.world import GROUND, HORIZON, ROCK

SUN = Sun(30, 35)


def seeing(camera: Camera, depth: np.ndarray, world_T_camera: np.ndarray) -> np.ndarray:
    """(H, W, 3) places in the world seen by the pixels of an undistorted camera."""
    eye = camera.intrinsics
    column, row = np.meshgrid(np.arange(eye.width), np.arange(eye.height))
    rays = np.stack([(column - eye.cx) / eye.fx, (row - eye.cy) / eye.fy, np.ones(column.shape)], -1)
    return transform(world_T_camera, (rays * depth[..., None]).reshape(-1, 3)).reshape(*depth.shape, 3)


@pytest.fixture(scope="module")
def view(drive):
    """A small camera, its pose, and a picture."""
    camera = Camera(drive.world, resized(drive.calibration.camera, *TRAINING_SIZE))
    pose = drive.pose(int(drive.scan_stamps_ns[4])) @ drive.calibration.body_T_camera
    return camera, pose, camera.take(pose, SUN, np.random.default_rng(0))


@pytest.fixture(scope="module")
def standing(drive):
    """The LiDAR's pose, and two scans of one place."""
    pose = drive.pose(int(drive.scan_stamps_ns[4])) @ drive.calibration.body_T_lidar
    lidar = Lidar(drive.world)
    return pose, lidar.scan(pose, np.random.default_rng(1)), lidar.scan(pose, np.random.default_rng(2))


# depth and labels


def test_depth_leads_to_the_ground(drive, view):
    camera, pose, picture = view
    ground = picture.semantic == GROUND
    place = seeing(camera, picture.depth.astype(float), pose)[ground]
    above = place[:, 2] - drive.world.relief.height(place[:, 0], place[:, 1])
    near = picture.depth[ground] < 60
    assert near.sum() > 10_000
    assert np.median(np.abs(above[near])) < 0.01 and np.percentile(np.abs(above[near]), 99) < 0.1


def test_every_rock_is_seen_where_it_lies(drive, view):
    camera, pose, picture = view
    mesh = drive.world.solids[ROCK]
    place = seeing(camera, picture.depth.astype(float), pose)
    numbers, counts = np.unique(picture.instance[picture.instance > 0], return_counts=True)
    assert len(numbers) > 10
    for number in numbers[np.argsort(-counts)[:10]]:
        corners = mesh.vertices[np.unique(mesh.triangles[mesh.instance == number - 1])]
        seen = place[picture.instance == number]
        slack = 0.03 + 1e-3 * np.linalg.norm(seen - pose[:3, 3], axis=1).max()
        assert (seen >= corners.min(axis=0) - slack).all() and (seen <= corners.max(axis=0) + slack).all()


def test_the_horizon_begins_where_the_ground_ends(drive):
    """Seen from a mast, all around: mountains stand beyond the square, and what is neither is sky."""
    camera = Camera(drive.world, resized(drive.calibration.camera, *TRAINING_SIZE))
    height = float(drive.world.relief.height(0, 0)) + 25
    for heading in (0, 90, 180, 270):
        turn = np.radians(heading)
        ahead, left = np.array([np.cos(turn), np.sin(turn), 0]), np.array([-np.sin(turn), np.cos(turn), 0])
        pose = make_pose(np.stack([-left, [0, 0, -1], ahead], axis=1), [0, 0, height])
        picture = camera.take(pose, SUN, np.random.default_rng(0))
        place = seeing(camera, picture.depth.astype(float), pose)
        outside = np.abs(place[..., :2]).max(axis=-1)
        assert outside[picture.semantic == HORIZON].min(initial=np.inf) > 0.45 * SIZE_M
        assert outside[picture.semantic == GROUND].max(initial=0) < 0.51 * SIZE_M
        assert ((picture.semantic == 255) == (picture.depth == 0)).all()
        assert (picture.instance[picture.semantic != ROCK] == 0).all()


def test_a_small_and_a_large_picture_agree(drive, view):
    _, pose, small = view
    large = Camera(drive.world, drive.calibration.camera).take(pose, SUN, np.random.default_rng(0))
    column = (((np.arange(224) + 0.5) * 688 / 224) - 0.5).round().astype(int)
    row = (((np.arange(224) + 0.5) * 512 / 224) - 0.5).round().astype(int)
    depth = large.depth[np.ix_(row, column)]
    both = (depth > 0) & (small.depth > 0)
    assert np.median(np.abs(depth[both] / small.depth[both] - 1)) < 0.01
    shrunk = cv2.resize(large.image, TRAINING_SIZE, interpolation=cv2.INTER_AREA)
    assert np.corrcoef(shrunk.ravel(), small.image.ravel())[0, 1] > 0.85


def test_a_raw_camera_bends_the_world_as_its_coefficients_say(night):
    """Returns of the LiDAR, projected by OpenCV with the distortion, meet the rendered depth; without it they miss."""
    stamp = int(night.scan_stamps_ns[5])
    left, right = eyes(night.world, night.preset.layout, night.calibration)
    world_T_lidar = night.pose(stamp) @ night.calibration.body_T_lidar
    scan = Lidar(night.world).scan(world_T_lidar, np.random.default_rng(0))
    points = transform(world_T_lidar, scan.points[scan.intensity > 0].astype(float))
    coefficients = ([-0.11, 0.085, 0.0004, -0.0003], [-0.108, 0.081, -0.0002, 0.0005])
    for eye, bend in zip((left, right), coefficients, strict=True):
        pose = night.pose(stamp) @ eye.body_T_camera
        picture, pinhole = eye.camera.take(pose, SUN, np.random.default_rng(0)), eye.camera.intrinsics
        seen = transform(invert(pose), points)
        seen = seen[seen[:, 2] > 1]
        matrix = np.array([[pinhole.fx, 0, pinhole.cx], [0, pinhole.fy, pinhole.cy], [0, 0, 1]])
        errors = []
        for distortion in (np.array(bend), np.zeros(4)):
            pixels = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]
            column, row = np.round(pixels).astype(int).T
            outer = np.hypot(*((pixels - [pinhole.cx, pinhole.cy]) / pinhole.fx).T) > 0.4
            inside = outer & (column >= 0) & (row >= 0) & (column < pinhole.width) & (row < pinhole.height)
            depth = picture.depth[row[inside], column[inside]]
            errors.append(np.median(np.abs(depth / seen[inside, 2] - 1)))
            assert inside.sum() > 500
        assert errors[0] < 0.01 and errors[1] > 1.5 * errors[0]


# light and noise


def test_the_noise_of_a_picture_is_small_and_has_no_bias(drive, view):
    camera, pose, picture = view
    again = camera.take(pose, SUN, np.random.default_rng(7))
    middle = (picture.image > 40) & (picture.image < 200)
    difference = (again.image.astype(float) - picture.image)[middle]
    assert middle.sum() > 5000
    assert 1.5 < difference.std() / np.sqrt(2) < 5  # of 255
    assert abs(difference.mean()) < 0.1
    assert np.array_equal(again.depth, picture.depth) and np.array_equal(again.instance, picture.instance)
    same = camera.take(pose, SUN, np.random.default_rng(0))
    assert np.array_equal(same.image, picture.image)


def test_exposure_makes_it_brighter(view):
    camera, pose, picture = view
    dark, bright = (camera.take(pose, SUN, np.random.default_rng(0), exposure).image.mean() for exposure in (0.6, 1.5))
    assert dark < picture.image.mean() < bright


def test_a_sky_without_air_is_black(drive, night, view):
    exposure = night.exposures[0]
    moon = night.picture(exposure)
    assert (moon.semantic == 255).any()
    assert np.percentile(moon.image[moon.semantic == 255], 90) < 12
    _, _, etna = view
    assert np.median(etna.image[etna.semantic == 255]) > 40
    assert night.world.traits.sky == 0 < drive.world.traits.sky


@pytest.mark.parametrize(("row", "column", "colour"), [(0, 0, "red"), (0, 1, "green"), (1, 0, "green"), (1, 1, "blue")])
def test_a_colour_filter_repeats_every_second_pixel(row, column, colour):
    grey = np.full((6, 8), 100, np.uint8)
    raw = mosaic(grey)
    wanted = {"red": 112, "green": 100, "blue": 80}[colour]
    assert np.abs(raw[row::2, column::2].astype(int) - wanted).max() <= 1
    colours = cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2RGB)[2:4, 2:6].reshape(-1, 3).mean(axis=0)
    assert colours[0] > colours[1] > colours[2]  # as any reader of rggb8 sees it
    assert mosaic(np.full((2, 2), 255, np.uint8)).max() == 255


def test_only_raw_cameras_publish_through_a_filter(drive, night):
    for simulator, same in ((drive, True), (night, False)):
        picture = simulator.picture(simulator.exposures[1])
        assert np.array_equal(simulator.published(picture), picture.image) == same


# the scan


def test_returns_lie_on_the_ground_or_on_rocks_above_it(drive, standing):
    pose, scan, _ = standing
    points = transform(pose, scan.points[scan.intensity > 0].astype(float))
    above = points[:, 2] - drive.world.relief.height(points[:, 0], points[:, 1])
    assert len(points) > 5000
    assert np.median(np.abs(above)) < 0.03
    assert np.percentile(above, 1) > -0.12


def test_ranges_err_by_centimetres_and_not_to_one_side(standing):
    """The same pulses twice: the world cancels, and what remains is the noise."""
    _, one, two = standing
    both = (one.intensity > 0) & (two.intensity > 0)
    near, far = (np.linalg.norm(scan.points[both], axis=1) for scan in (one, two))
    error, distance = near - far, (near + far) / 2
    wanted = 0.02 * (1 + distance / 60)
    assert (error / wanted).std() == pytest.approx(np.sqrt(2), rel=0.05)
    assert abs(error.mean()) < 0.002
    assert distance.max() < RANGE_M + 1


def test_a_pulse_without_a_return_points_where_it_was_sent(standing):
    _, scan, _ = standing
    missing = scan.intensity == 0
    np.testing.assert_allclose(scan.points[missing], pulse_directions()[missing], atol=1e-6)
    assert 0.01 < missing.mean() < 0.7 and (scan.ambient[missing] > 0).any()
    assert not scan.usable(15, 7.0)[missing].any()


def test_a_few_pulses_are_lost_anywhere(standing):
    """Where everything around returns, one or two in a hundred still do not."""
    _, scan, other = standing
    strong = (other.intensity > 200) & (np.linalg.norm(other.points, axis=1) < 15)
    assert strong.sum() > 1000
    assert np.mean(scan.intensity[strong] == 0) == pytest.approx(0.015, abs=0.01)


def test_far_and_dark_ground_returns_less(standing):
    _, scan, _ = standing
    distance = np.linalg.norm(scan.points, axis=1)
    returned = scan.intensity > 0
    near, far = (
        np.median(scan.intensity[returned & (distance > low) & (distance < high)]) for low, high in ((2, 8), (15, 40))
    )
    assert near > 2 * far


def test_a_scan_looks_at_the_sky_and_sees_nothing(drive):
    up = make_pose([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [0, 0, 60])  # forward is up
    scan = Lidar(drive.world).scan(up, np.random.default_rng(0))
    assert not scan.intensity.any()
    np.testing.assert_allclose(np.linalg.norm(scan.points, axis=1), 1, atol=1e-5)


def test_pulses_are_sent_line_by_line():
    directions, times = pulse_directions().reshape(LINES, PULSES, 3), pulse_times().reshape(LINES, PULSES)
    assert (np.diff(times.ravel().astype(np.int64)) >= 0).all()
    assert np.allclose(np.diff(times[:, 0].astype(float)), PERIOD_NS / LINES, rtol=0.02)
    azimuth = np.arctan2(directions[..., 0], directions[..., 1])
    elevation = np.arcsin(directions[..., 2])
    assert (np.diff(azimuth, axis=1) > 0).all()  # each from left to right
    assert (np.diff(elevation[:, PULSES // 2]) > 0).all()  # one above the other
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(azimuth, -azimuth[:, ::-1], atol=1e-6)


def test_each_line_is_seen_from_where_the_rover_was(drive, standing):
    """Over a scan with a metre of driving the first line is that of the start, the last that of the end."""
    pose, _, _ = standing
    lidar, step = Lidar(drive.world), make_pose(np.eye(3), [0, 1.0, 0])
    start, moving, end = (
        lidar.scan(here, np.random.default_rng(3), there)
        for here, there in ((pose, None), (pose, pose @ step), (pose @ step, None))
    )
    lines = [scan.points.reshape(LINES, PULSES, 3) for scan in (start, moving, end)]
    there = np.stack([scan.intensity.reshape(LINES, PULSES) > 0 for scan in (start, moving, end)]).all(axis=0)
    errors = np.linalg.norm(lines[1][None] - np.stack([lines[0], lines[2]]), axis=-1)
    first, last = slice(0, 8), slice(-30, None)
    assert np.median(errors[0, first][there[first]]) < 0.5 * np.median(errors[1, first][there[first]])
    assert np.median(errors[1, last][there[last]]) < np.median(errors[0, last][there[last]])


def test_frames_are_free_of_motion_and_agree_in_the_world(drive):
    frames = [frame for frame, _ in zip(drive.frames(), range(3), strict=False)]
    clouds = [transform(drive.pose(frame.stamp_ns), frame.points.astype(float)) for frame in frames]
    for cloud in clouds:
        assert np.median(np.abs(cloud[:, 2] - drive.world.relief.height(cloud[:, 0], cloud[:, 1]))) < 0.04
    apart = cKDTree(clouds[0][:, :2]).query(clouds[2][:, :2])[0]
    assert np.median(apart) < 0.2
    assert [frame.stamp_ns for frame in frames] == drive.scan_stamps_ns[:3].tolist()
    moved = invert(frames[0].odom_T_body) @ frames[2].odom_T_body
    true = invert(drive.pose(frames[0].stamp_ns)) @ drive.pose(frames[2].stamp_ns)
    assert moved[:3, 3] == pytest.approx(true[:3, 3], abs=0.05)


@pytest.mark.parametrize("lidar_frame", [False, True])
def test_points_of_the_bag_point_ahead_of_the_rover(drive, lidar_frame):
    """In the LiDAR's frame y looks ahead; in the body's x does."""
    scan = drive.scan(6)
    points = scan.points[scan.intensity > 15]
    if not lidar_frame:
        points = transform(drive.calibration.body_T_lidar, points)
    ahead = points[:, 1] if lidar_frame else points[:, 0]
    assert ahead.min() > 0 and len(points) < POINTS
