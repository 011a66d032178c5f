"""Common parts of the networks of other methods: their inputs and the image trunk.

The thesis compares with NetVLAD, PointNet++, MinkLoc++ and AdaFusion [UMF 5.3.1]. Their image branches begin with
networks trained on photographs (VGG-16, ResNet-18); here all begin with the first stages of EfficientNet-Lite0, the
only such weights with a permissive licence. As NetVLAD does, the early stages stay and the last one learns on.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from umf_ros.core.frames import Frame, Points
from umf_ros.core.geometry import transform
from umf_ros.core.levelling import level
from umf_ros.embedding.inputs import VoxelScan, is_blank, shrink, standardise, voxelise
from umf_ros.networks.efficientnet import CONTRAST, STAGES, EfficientNetLite0
from umf_ros.networks.encoders import parent_and_child

Sense = Literal["image", "voxels", "points"]
IMAGE_SIZE = (160, 224)
"""Height and width that the trunk reads, as those of `umf_light`."""
DEPTH = 5
"""Stages of the trunk; the last of them learns."""
EARLY, LATE = STAGES[DEPTH - 2].channels, STAGES[DEPTH - 1].channels
VOXELS = 1024
"""Occupied voxels of a scan at most, of a grid of 40 to each side."""
MEASURED = 6
"""Features of a voxel (`umf_ros.embedding.inputs.VoxelScan`)."""
POINTS = 1024


class PlaceInput(NamedTuple):
    """A batch; what a network does not read is empty.

    Attributes:
        maps: (B, 80, 10, 14) of the trunk's early stages.
        image_present: (B,) bool.
        voxels: (B, V, 6) what was measured in them.
        cells: (B, V) int64 flat indices in the grid of 40^3.
        mask: (B, V) bool, False for padding.
        points: (B, 1024, 3) metres, some of the scan's.
        cloud_present: (B,) bool.
    """

    maps: Tensor
    image_present: Tensor
    voxels: Tensor
    cells: Tensor
    mask: Tensor
    points: Tensor
    cloud_present: Tensor

    def to(self, device: torch.device) -> Self:
        """The batch on another device."""
        return type(self)(*(part.to(device) for part in self))


class PlaceNetwork(nn.Module, ABC):
    """Describes places.

    Attributes:
        reads: what of a frame it reads.
        length: of its descriptor.
        weight_image, weight_cloud: what the descriptors of one modality weigh in its loss, 0 without them.
    """

    reads: ClassVar[frozenset[Sense]]
    length: int
    weight_image: float = 0.0
    weight_cloud: float = 0.0

    @abstractmethod
    def forward(self, batch: PlaceInput) -> dict[str, Tensor]:
        """Descriptors (B, D): "descriptor", and of networks of both modalities "image" and "cloud".

        A missing modality leaves zeros; lengths are free.
        """

    @property
    def trunk(self) -> ImageTrunk | None:
        """Of its image branch."""
        return next((module for module in self.modules() if isinstance(module, ImageTrunk)), None)


class ImageTrunk(nn.Module):
    """EfficientNet-Lite0 to stride 16, its early stages frozen."""

    def __init__(self) -> None:
        super().__init__()
        self.network = EfficientNetLite0(DEPTH)
        self.network.requires_grad_(False)
        self.network.stages[-1].requires_grad_(True)

    def early(self, image: Tensor) -> Tensor:
        """(B, 1, 160, 224) standardised to maps (B, 80, 10, 14)."""
        x = F.relu6(self.network.stem(image * CONTRAST))
        for stage in self.network.stages[:-1]:
            x = stage(x)
        return x

    def late(self, maps: Tensor) -> Tensor:
        """Maps (B, 80, 10, 14) to (B, 112, 10, 14)."""
        found: Tensor = self.network.stages[-1](maps.contiguous(memory_format=torch.channels_last))
        return found


class Gem(nn.Module):
    """Generalised mean [Radenović 2019] over a map."""

    def __init__(self, power: float = 3.0) -> None:
        super().__init__()
        self.power = nn.Parameter(torch.tensor(power))

    def forward(self, maps: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C)."""
        raised = maps.float().clamp(min=1e-6) ** self.power
        return raised.mean(dim=(2, 3)) ** (1 / self.power)


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
    """Return the inputs that a network reads; a blank image counts as missing, and the scan is levelled."""
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


def count_parameters(network: nn.Module) -> int:
    """Return the number of trainable parameters."""
    return sum(parameter.numel() for parameter in network.parameters())
