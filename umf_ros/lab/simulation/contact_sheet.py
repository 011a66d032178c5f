"""Pictures of a world on one page, for a person to judge."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from umf_ros.core.errors import writing
from umf_ros.core.frames import Image
from umf_ros.core.geometry import transform
from umf_ros.lab.simulation.camera import Camera
from umf_ros.lab.simulation.lidar import FIELD_OF_VIEW_DEG, RANGE_M
from umf_ros.lab.simulation.noise import Field
from umf_ros.lab.simulation.survey import Survey

FRAMES, SCANS, COLUMNS = 24, 6, 6
_TILE = (344, 256)
_BIRD_REACH_M = 40.0


def contact_sheet(survey: Survey, path: Path) -> None:
    """Write 24 frames, each place of the first pass above its revisit, and 6 scans from the side and from above.

    Raises:
        OutputError: the picture cannot be written.
    """
    camera = Camera(survey.world, survey.calibration.camera)
    tiles = [_frame(survey, camera, index) for index in range(FRAMES)]
    scans = [_scan(survey, index) for index in range(SCANS)]
    rows = [np.hstack(tiles[row : row + COLUMNS]) for row in range(0, FRAMES, COLUMNS)]
    sheet = np.vstack([*(cv2.cvtColor(row, cv2.COLOR_GRAY2BGR) for row in rows), np.hstack(scans)])
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".png", sheet)[1].tobytes())


def _frame(survey: Survey, camera: Camera, index: int) -> Image:
    """The frame of a place on the sheet: even rows show the first pass, odd rows the revisit."""
    row, column = divmod(index, COLUMNS)
    drive = survey.passes[row % 2]
    step = int((row // 2 * COLUMNS + column) / (FRAMES // 2) * len(drive.path))
    rng = np.random.default_rng([survey.world.seed, 16, index])
    image = camera.take(
        survey.pose(row % 2, step) @ survey.calibration.body_T_camera, drive.sun, rng, drive.exposure
    ).image
    return np.asarray(cv2.resize(image, _TILE, interpolation=cv2.INTER_AREA), np.uint8)


def _scan(survey: Survey, index: int) -> Image:
    drive = survey.passes[0]
    sample = survey.sample(0, index * len(drive.path) // SCANS)
    body_T_lidar = np.linalg.inv(survey.calibration.body_T_lidar)
    points = transform(body_T_lidar, sample.points[:, :3].astype(np.float64))
    return np.vstack([_ahead(points), _from_above(sample.points.astype(np.float32))])


def _ahead(points: Field) -> Image:
    """What the LiDAR sees, near in red and far in blue."""
    canvas = np.zeros((160, _TILE[0], 3), np.uint8)
    distance = np.linalg.norm(points, axis=1)
    azimuth = np.degrees(np.arctan2(points[:, 0], points[:, 1]))
    elevation = np.degrees(np.arcsin(points[:, 2] / distance))
    scale = _TILE[0] / (FIELD_OF_VIEW_DEG[0] + 4)
    column, row = _TILE[0] / 2 + azimuth * scale, 80 - elevation * scale
    _dots(canvas, column, row, _colours(1 - np.log(distance) / np.log(RANGE_M)))
    return canvas


def _from_above(points: Field) -> Image:
    """The scan in the body frame from above, the rover at the bottom, high in red and low in blue."""
    canvas = np.zeros((_TILE[1], _TILE[0], 3), np.uint8)
    scale = _TILE[1] / _BIRD_REACH_M
    _dots(
        canvas, _TILE[0] / 2 - points[:, 1] * scale, _TILE[1] - points[:, 0] * scale, _colours(points[:, 2] / 6 + 0.4)
    )
    return canvas


def _colours(value: Field) -> Image:
    if len(value) == 0:
        return np.empty((0, 3), np.uint8)
    scaled = np.clip(value * 255, 0, 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(scaled[:, None], cv2.COLORMAP_TURBO)[:, 0], np.uint8)


def _dots(canvas: Image, column: Field, row: Field, colours: Image) -> None:
    for across in (0, 1):
        for along in (0, 1):
            u, v = (column + across).astype(int), (row + along).astype(int)
            inside = (u >= 0) & (u < canvas.shape[1]) & (v >= 0) & (v < canvas.shape[0])
            canvas[v[inside], u[inside]] = colours[inside]
