"""From frames to what the networks of other methods read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from umf_ros.baselines.place_network import EARLY, IMAGE_SIZE, MEASURED, POINTS, VOXELS, PlaceInput
from umf_ros.core.frames import Frame, Points
from umf_ros.core.geometry import transform
from umf_ros.core.levelling import level
from umf_ros.embedding.inputs import VoxelScan, is_blank, shrink, standardise, voxelise
from umf_ros.networks.encoders import parent_and_child

EMPTY_MAPS = (EARLY, IMAGE_SIZE[0] // 16, IMAGE_SIZE[1] // 16)


@dataclass(frozen=True, slots=True)
class PreparedView:
    """One frame, preprocessed; None for what is missing or not read.

    Attributes:
        image: (160, 224) float32, standardised.
        scan: voxelised, upright.
        points: (1024, 3) float32 metres, upright.
    """

    image: NDArray[np.float32] | None = None
    scan: VoxelScan | None = None
    points: Points | None = None


def view_frame(frame: Frame, reads: frozenset[str]) -> PreparedView:
    """What a network reads of a frame; a black image is none, and a scan stands upright on its ground."""
    image = frame.left if "image" in reads else None
    seen = None if image is None or is_blank(image) else standardise(shrink(image, IMAGE_SIZE))
    if frame.points is None or not len(frame.points) or not reads & {"voxels", "points"}:
        return PreparedView(seen)
    upright = transform(level(frame.points), frame.points).astype(np.float32)
    scan = voxelise(upright, frame.intensity, 1, VOXELS) if "voxels" in reads else None
    return PreparedView(seen, scan, some_points(upright, np.random.default_rng(0)) if "points" in reads else None)


def some_points(points: Points, rng: np.random.Generator, reach_m: float = 40.0) -> Points | None:
    """1024 of the points (N, 3) within reach, some of them twice where there are fewer; None without any."""
    near = points[np.isfinite(points).all(axis=1) & (np.hypot(points[:, 0], points[:, 1]) < reach_m)]
    if not len(near):
        return None
    return near[rng.choice(len(near), POINTS, replace=len(near) < POINTS)].astype(np.float32)


def stack_images(views: Sequence[PreparedView]) -> Tensor:
    """(B, 1, 160, 224), zeros for what is missing."""
    blank = np.zeros(IMAGE_SIZE, np.float32)
    return torch.from_numpy(np.stack([blank if view.image is None else view.image for view in views]))[:, None]


def stack(views: Sequence[PreparedView], maps: Tensor | None) -> PlaceInput:
    """A batch.

    Args:
        views: its frames.
        maps: (B, 80, 10, 14) of their images; None where they are not read.
    """
    scans = [view.scan for view in views]
    longest = max(1, *(0 if scan is None else int(scan.fine_mask.sum()) for scan in scans))
    voxels = torch.zeros(len(views), longest, MEASURED)
    cells, mask = torch.zeros(len(views), longest, dtype=torch.long), torch.zeros(len(views), longest, dtype=torch.bool)
    for row, scan in enumerate(scans):
        if scan is None:
            continue
        kept = int(scan.fine_mask.sum())
        cells[row, :kept] = torch.from_numpy(scan.fine_index[:kept])
        mask[row, :kept] = True
        voxels[row, :kept] = measured(scan)[:kept]
    points = [np.zeros((POINTS, 3), np.float32) if view.points is None else view.points for view in views]
    return PlaceInput(
        maps=torch.zeros(len(views), *EMPTY_MAPS) if maps is None else maps,
        image_present=torch.tensor([view.image is not None for view in views]),
        voxels=voxels,
        cells=cells,
        mask=mask,
        points=torch.from_numpy(np.stack(points)),
        cloud_present=torch.tensor([_feels(view) for view in views]),
    )


def _feels(view: PreparedView) -> bool:
    return view.points is not None or (view.scan is not None and bool(view.scan.fine_mask.any()))


def measured(scan: VoxelScan) -> Tensor:
    """(V, 6) features of the voxels of a scan, padding included."""
    parent, child = parent_and_child(torch.from_numpy(scan.fine_index))
    grid = torch.from_numpy(scan.grid).flatten(0, 2).unflatten(1, (MEASURED, 8))
    return grid[parent, :, child]
