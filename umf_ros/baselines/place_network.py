"""What the networks of other methods have in common: what they read, and the trunk of those that see.

The thesis compares with NetVLAD, PointNet++, MinkLoc++ and AdaFusion [UMF 5.3.1]. Their image branches begin with
networks trained on photographs (VGG-16, ResNet-18); here all begin with the first stages of EfficientNet-Lite0, the
only such weights with a licence like ours. As NetVLAD does, the early stages stay and the last one learns on.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Literal, NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.networks.efficientnet import CONTRAST, STAGES, EfficientNetLite0

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
