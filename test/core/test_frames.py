from __future__ import annotations

import numpy as np

from umf_ros.core.frames import StereoCamera
from umf_ros.core.geometry import make_pose

CAMERA = StereoCamera(640, 480, 400.0, 300.0, 320.0, 240.0, 0.2)
# looks ahead: right is minus y of the body, down is minus z
AHEAD = make_pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [1.0, 0.0, 0.5])


def test_points_are_seen_at_their_pixels_and_depths() -> None:
    points = np.array([[5.0, 0.0, 0.5], [5.0, -1.0, 0.5], [9.0, 2.0, -1.5]])
    pixels, depth = CAMERA.project(points, AHEAD)
    np.testing.assert_allclose(pixels, [[320, 240], [420, 240], [220, 315]])
    np.testing.assert_allclose(depth, [4, 4, 8])


def test_what_lies_behind_the_camera_has_no_positive_depth() -> None:
    pixels, depth = CAMERA.project(np.array([[1.0, 0.0, 0.5], [-3.0, 0.0, 0.5]]), AHEAD)
    assert (depth <= 0).all() and np.isfinite(pixels).all()
