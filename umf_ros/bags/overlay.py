"""Baseline, mounting and clock of stereo camera and LiDAR by points that both measure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import small_gicp
from numpy.typing import NDArray

from umf_ros.core.frames import Frame
from umf_ros.core.geometry import Array

PLANE_POINTS, PLANE_M, RANGE_M, PIXEL_PX = (
    20,
    0.01,
    0.02,
    0.3,
)  # by hand: neighbours of a plane, sigmas of surface, range and disparity
OVERLAID_FRAMES = 20  # by hand: least frames
WIDEST = np.array([*np.radians((10, 10, 10)), 0.2, 0.5])  # by hand: prior sigmas, rad, share and s
ROUNDS = 5  # of reweighting
STRIPS = 8  # by hand: vertical strips of an image
MEDIAN_OF_NORMAL = 0.6745


@dataclass(frozen=True, slots=True)
class Overlay:
    """Errors of the calibration by stereo points on LiDAR surfaces, with their standard deviations.

    Attributes:
        turn_deg: (3,) rotation vector that corrects `body_T_lidar`, body axes.
        scale: depth of stereo over that of the LiDAR.
        lag_s: correction of the LiDAR's stamps to the camera's clock.
        deviations: (3,) standard deviations of turn (deg, largest axis), scale, and lag (s).
    """

    turn_deg: Array
    scale: float
    lag_s: float
    deviations: Array


def overlay_equations(frame: Frame, disparity: Array, pixels: Array, chosen: NDArray[np.intp]) -> Array:
    """Return equations (M, 7) of a frame: derivatives by turn (3, rad), stereo scale and lag (s), residual, and strip.

    A stereo point must lie in the plane around the LiDAR point at its pixel. Each row is divided by the standard
    deviation of this distance; the last column is the vertical strip of the image.

    Args:
        frame: with points and motion.
        disparity: (M,) px.
        pixels: (M, 2) of the left image.
        chosen: (M,) rows of the scan's points at these pixels.
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
    nearer = pixel_m * (disparity - camera.fx * camera.baseline / depth)  # linear in the disparity, so unbiased
    rates = np.zeros(6) if frame.motion is None else frame.motion.rates
    moved = rates[:3] + np.cross(rates[3:], points)
    levers = np.cross(points - frame.body_T_lidar[:3, 3], normals)
    facing, slip = (np.einsum("ij,ij->i", normals, one) for one in (rays, moved))
    deviation = np.hypot(PLANE_M, facing * np.hypot(RANGE_M, PIXEL_PX * pixel_m))
    rows = np.column_stack([-levers, facing * depth, -slip, facing * nearer])
    return np.column_stack([rows / deviation[:, None], pixels[:, 0] * STRIPS // camera.width])


def lay_over(equations: list[Array]) -> Overlay | None:
    """Solve the equations of many frames robustly; return None for too few frames.

    The standard deviations are those between frames and between strips of the image, within which errors are correlated
    (cluster-robust). They are enlarged if the residuals exceed the assumed noise.
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
