"""Lay stereo's points over the LiDAR's scans: what is left tells baseline, mounting and clock apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import small_gicp
from numpy.typing import NDArray

from umf_ros.core.frames import Frame
from umf_ros.core.geometry import Array

PLANE_POINTS, PLANE_M, RANGE_M, PIXEL_PX = 20, 0.01, 0.02, 0.3  # by hand: of surfaces, ranges and disparities
OVERLAID_FRAMES = 20  # by hand: that deviations are measured from
WIDEST = np.array([*np.radians((10, 10, 10)), 0.2, 0.5])  # by hand: of what is looked for, rad, share and s
ROUNDS = 5  # of reweighting
STRIPS = 8  # by hand: upright ones of an image
MEDIAN_OF_NORMAL = 0.6745


@dataclass(frozen=True, slots=True)
class Overlay:
    """Errors of the LiDAR's calibration by the surfaces that stereo sees, each with its standard deviation.

    Attributes:
        turn_deg: (3,) rotation vector that sets `body_T_lidar` right, body axes.
        scale: stereo's depth by the LiDAR's.
        lag_s: to be added to the LiDAR's stamps, by the camera's clock.
        deviations: (3,) of the turn (deg, its worst axis), of the scale, and of the lag (s).
    """

    turn_deg: Array
    scale: float
    lag_s: float
    deviations: Array


def overlay_equations(frame: Frame, disparity: Array, pixels: Array, chosen: NDArray[np.intp]) -> Array:
    """Equations (M, 7) of a frame: what a turn (rad), a stretch of stereo and a lag (s) change, what is left, a strip.

    A point of stereo has to lie in the plane around the LiDAR's point that is seen at its pixel. Each row is weighed
    by the deviation of its distance; the strip is that of the image.

    Args:
        frame: with points and motion.
        disparity: (M,) px.
        pixels: (M, 2) of the left image.
        chosen: (M,) rows of the scan's points that are seen there.
    """
    assert frame.points is not None
    camera, cloud = frame.camera, frame.points.astype(float)
    points, tree = cloud[chosen], small_gicp.KdTree(cloud)
    around = cloud[np.asarray(tree.batch_knn_search(points, PLANE_POINTS)[0], np.intp)]
    around -= around.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(around.swapaxes(1, 2) @ around)[1][:, :, 0]
    across, down = (pixels - (camera.cx, camera.cy)).T / camera.fx
    rays = np.column_stack([across, down, np.ones(len(pixels))]) @ frame.body_T_camera[:3, :3].T
    depth = (points - frame.body_T_camera[:3, 3]) @ frame.body_T_camera[:3, 2]
    pixel_m = depth**2 / (camera.fx * camera.baseline)
    nearer = pixel_m * (disparity - camera.fx * camera.baseline / depth)  # without a bias of 1 / disparity
    rates = np.zeros(6) if frame.motion is None else frame.motion.rates
    moved = rates[:3] + np.cross(rates[3:], points)
    levers = np.cross(points - frame.body_T_lidar[:3, 3], normals)
    facing, slip = (np.einsum("ij,ij->i", normals, one) for one in (rays, moved))
    deviation = np.hypot(PLANE_M, facing * np.hypot(RANGE_M, PIXEL_PX * pixel_m))
    rows = np.column_stack([-levers, facing * depth, -slip, facing * nearer])
    return np.column_stack([rows / deviation[:, None], pixels[:, 0] * STRIPS // camera.width])


def lay_over(equations: list[Array]) -> Overlay | None:
    """Solve the equations of many frames robustly; None of too few.

    The deviations follow from how frames differ, and strips of the image: points of one of them err alike. They grow
    where surfaces are rougher, or disparities noisier, than was reckoned with: such errors are seldom of mean zero.
    """
    if len(equations) < OVERLAID_FRAMES:
        return None
    rows, left, strips = np.split(np.concatenate(equations), (5, 6), axis=1)
    frames = np.repeat(np.arange(len(equations)), [len(part) for part in equations])
    known, weights, spread = np.diag(np.square(1 / WIDEST)), np.ones((len(rows), 1)), np.zeros((5, 5))
    for _ in range(ROUNDS):
        spread = np.linalg.inv((rows * weights).T @ rows + known)
        found = spread @ (rows * weights).T @ left
        remaining = left - rows @ found
        weights = 1 / (1 + (remaining / (3 * np.median(np.abs(remaining)))) ** 2)
    deviations = np.zeros(5)
    for labels in (frames, strips[:, 0]):
        pulls = np.stack([(rows * weights * remaining)[labels == one].sum(axis=0) for one in np.unique(labels)])
        deviations = np.maximum(deviations, np.sqrt(np.diag(spread @ (pulls.T @ pulls + known) @ spread)))
    deviations *= max(1.0, float(np.median(np.abs(remaining))) / MEDIAN_OF_NORMAL)
    told = np.array([np.degrees(deviations[:3].max()), *deviations[3:]])
    return Overlay(np.degrees(found[:3, 0]), float(1 / (1 + found[3, 0])), float(found[4, 0]), told)
