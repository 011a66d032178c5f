from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Embedding, Frame, LocalFeatures, StereoCamera
from umf_ros.core.geometry import make_pose, transform
from umf_ros.embedding.depth import disparities, lift

CAMERA = StereoCamera(688, 512, 579.488, 579.488, 342.133, 255.806, 0.2003)
BODY_T_CAMERA = make_pose(Rotation.from_euler("ZYX", [-90, 0, -96], degrees=True).as_matrix(), [0.3, 0.1, 1.1])
WALL_M = 8.0


def texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((CAMERA.height, CAMERA.width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return np.clip(128 + 300 * smooth, 0, 255).astype(np.uint8)


def stereo_pair(disparity: float) -> tuple[np.ndarray, np.ndarray]:
    left = texture()
    moved = np.float32([[1, 0, -disparity], [0, 1, 0]])
    return left, cv2.warpAffine(left, moved, (CAMERA.width, CAMERA.height), borderMode=cv2.BORDER_REFLECT)


def features(pixels: np.ndarray) -> LocalFeatures:
    count = len(pixels)
    unknown = np.full((count, 3), np.nan, np.float32)
    return LocalFeatures(
        pixels.astype(np.float32), np.ones((count, 4), np.float16), np.ones(count, np.float32), unknown
    )


def embedding(pixels: np.ndarray) -> Embedding:
    return Embedding(np.ones(4, np.float32), image=features(pixels))


def frame(points: np.ndarray | None, right: np.ndarray | None = None, left: np.ndarray | None = None) -> Frame:
    cloud = None if points is None else points.astype(np.float32)
    return Frame(1, CAMERA, BODY_T_CAMERA, np.eye(4), left=left, right=right, points=cloud)


def grid(margin: int = 120) -> np.ndarray:
    u, v = np.meshgrid(np.arange(margin, CAMERA.width - 20, 60), np.arange(40, CAMERA.height - 40, 60))
    return np.column_stack([u.ravel(), v.ravel()]).astype(float)


def wall(depth: float) -> np.ndarray:
    """Points of the body frame that the camera sees at one depth, as dense as a scan."""
    u, v = np.meshgrid(np.arange(0, CAMERA.width, 4), np.arange(0, CAMERA.height / 2, 4))
    ray = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    return transform(BODY_T_CAMERA, (depth * ray).reshape(-1, 3))


def depths(found: Embedding) -> np.ndarray:
    assert found.image is not None
    return CAMERA.project(found.image.points.astype(float), BODY_T_CAMERA)[1]


def test_disparity_is_found_to_a_fraction_of_a_pixel() -> None:
    left, right = stereo_pair(14.4)
    found = disparities(left, right, grid(), CAMERA)
    assert np.isfinite(found).mean() > 0.9
    np.testing.assert_allclose(found[np.isfinite(found)], 14.4, atol=0.25)


def test_flat_or_repeating_images_have_no_disparity() -> None:
    grey = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
    assert np.isnan(disparities(grey, grey, grid(), CAMERA)).all()
    stripes = np.tile((127 + 100 * np.sin(np.arange(CAMERA.width) / 2)).astype(np.uint8), (CAMERA.height, 1))
    assert np.isnan(disparities(stripes, stripes, grid(), CAMERA)).all()


def test_features_at_the_border_are_left_alone() -> None:
    left, right = stereo_pair(10)
    corners = np.array([[0, 0], [CAMERA.width - 1, CAMERA.height - 1], [2, 300]], float)
    assert np.isnan(disparities(left, right, corners, CAMERA)).all()


def test_scan_gives_depth_where_it_looks_and_nothing_elsewhere() -> None:
    pixels = np.array([[300.0, 100.0], [500.0, 200.0], [300.0, 450.0]])
    found = depths(lift(frame(wall(WALL_M)), embedding(pixels)))
    np.testing.assert_allclose(found[:2], WALL_M, atol=0.02)
    assert np.isnan(found[2])


def test_depth_steps_are_not_averaged() -> None:
    both = np.vstack([wall(5.0), wall(15.0)])
    assert np.isnan(depths(lift(frame(both), embedding(np.array([[300.0, 100.0]]))))).all()


def test_stereo_fills_in_below_the_scan() -> None:
    disparity = CAMERA.fx * CAMERA.baseline / 6.0
    left, right = stereo_pair(disparity)
    pixels = np.array([[400.0, 100.0], [400.0, 400.0]])
    found = depths(lift(frame(wall(WALL_M), right, left), embedding(pixels)))
    np.testing.assert_allclose(found, [WALL_M, 6.0], atol=0.15)


def test_lifted_points_project_back_onto_their_pixels() -> None:
    pixels = np.array([[200.0, 50.0], [600.0, 150.0]])
    lifted = lift(frame(wall(WALL_M)), embedding(pixels)).image
    assert lifted is not None
    np.testing.assert_allclose(CAMERA.project(lifted.points.astype(float), BODY_T_CAMERA)[0], pixels, atol=0.01)


def test_frames_without_scan_or_pair_leave_depths_unknown() -> None:
    found = lift(frame(None, left=texture()), embedding(grid()))
    assert found.image is not None and np.isnan(found.image.points).all()
    assert lift(frame(wall(5.0)), Embedding(np.ones(4, np.float32))).image is None
