"""Reconstructions as pictures (thesis figures 4.6 and 4.8)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.errors import OutputError
from umf_ros.geometry import Array

GAP = 6
SCALE = 2


def save_images(path: Path, columns: Sequence[tuple[str, Array]]) -> None:
    """Draw images side by side, one row per example.

    Args:
        path: PNG to write.
        columns: a title and (B, H, W) values; every row shares its scale of brightness.
    """
    low, high = (np.quantile(columns[0][1], q, axis=(1, 2))[:, None, None] for q in (0.01, 0.99))
    _write(path, [(name, (values - low) / np.maximum(high - low, 1e-6)) for name, values in columns])


def save_occupancy(path: Path, columns: Sequence[tuple[str, Array]]) -> None:
    """Draw grids from above, one row per example: how high the ground lies, darker where it is unsure.

    Args:
        path: PNG to write.
        columns: a title and (B, X, Y, Z) chances of being occupied.
    """
    levels = np.linspace(0.25, 1.0, columns[0][1].shape[3])
    seen = [(name, (values * levels).max(axis=3)[:, ::-1, ::-1]) for name, values in columns]
    _write(path, [(name, values.repeat(3, axis=1).repeat(3, axis=2)) for name, values in seen])


def _write(path: Path, columns: Sequence[tuple[str, Array]]) -> None:
    drawn = [_column(name, np.clip(values * 255, 0, 255).astype(np.uint8)) for name, values in columns]
    picture = np.concatenate(drawn, axis=1)
    encoded, content = cv2.imencode(".png", picture)
    try:
        if encoded:
            path.write_bytes(content.tobytes())
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from None


def _column(name: str, images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = images.shape[1:]
    title = np.full((26, width * SCALE + GAP), 255, np.uint8)
    cv2.putText(title, name, (4, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 0, 1, cv2.LINE_AA)
    rows = [title]
    for image in images:
        large = cv2.resize(image, (width * SCALE, height * SCALE), interpolation=cv2.INTER_NEAREST)
        rows.append(np.pad(large, ((0, GAP), (0, GAP)), constant_values=255))
    return np.concatenate(rows, axis=0)
