"""Masked image modelling of a convolutional encoder (thesis 4.5.1, figure 4.5; SparK)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.lab.training.pretraining.masks import PATCH
from umf_ros.lab.training.pretraining.sparse import hide, sparse, spread
from umf_ros.networks.image_encoder import Backbone

NOISE = 0.01
"""Variance, in images of unit variance, that is not worth painting: a black sky would be amplified to snow."""


class ImageReconstruction(nn.Module):
    """The encoder under a U-shaped decoder that paints the hidden patches.

    Args:
        backbone: four stages at strides 4, 8, 16 and 32; trained in place.
        width: channels of the decoder at stride 32, halved with every doubling of resolution, 16 at least.
    """

    def __init__(self, backbone: Backbone, width: int) -> None:
        super().__init__()
        self.backbone = backbone
        widths = [max(width >> level, 16) for level in range(6)]
        deepest_first = list(reversed(backbone.channels))
        # what stands in for a hidden place, for every scale
        self.mask_tokens = nn.ParameterList(nn.Parameter(torch.randn(count) * 0.02) for count in deepest_first)
        self.projections = nn.ModuleList(
            nn.Conv2d(count, wide, 1 if level == 0 else 3, padding=0 if level == 0 else 1)
            for level, (count, wide) in enumerate(zip(deepest_first, widths[:4], strict=True))
        )
        self.blocks = nn.ModuleList(_double(*widths[level : level + 2]) for level in range(5))
        self.head = nn.Conv2d(widths[5], 1, 1)

    def forward(self, image: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
        """Paint the hidden patches.

        Args:
            image: (B, 1, H, W).
            visible: (B, 1, H/32, W/32) bool.

        Returns:
            The loss, and the painting (B, 1, H, W), each patch with zero mean and unit variance.
        """
        painting = self._paint(image, visible).float()
        predicted, wanted = patches(painting), normalised(patches(image.float()))
        error = (predicted - wanted).square().mean(dim=2)
        hidden = ~visible.flatten(1)
        return (error * hidden).sum() / hidden.sum().clamp(min=1), painting

    def _paint(self, image: Tensor, visible: Tensor) -> Tensor:
        with sparse(self.backbone, visible):
            maps = self.backbone(hide(image, visible))
        x = torch.zeros((), device=image.device)
        for level, found in enumerate(reversed(maps)):
            filled = torch.where(spread(visible, found.shape[2]), found, self.mask_tokens[level].view(1, -1, 1, 1))
            x = self.blocks[level](x + self.projections[level](filled))
        return self.head(self.blocks[4](x))


def _double(inputs: int, outputs: int) -> nn.Sequential:
    """Twice the resolution."""
    return nn.Sequential(
        nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(),
    )


def patches(image: Tensor) -> Tensor:
    """(B, patches, pixels) of images (B, 1, H, W), row by row."""
    return F.unfold(image, PATCH, stride=PATCH).transpose(1, 2)


def unpatch(flat: Tensor, size: tuple[int, int]) -> Tensor:
    """Inverse of `patches`."""
    return F.fold(flat.transpose(1, 2), size, PATCH, stride=PATCH)


def normalised(flat: Tensor) -> Tensor:
    """Each patch with zero mean and unit variance, or less where there is nothing but noise."""
    return (flat - flat.mean(dim=2, keepdim=True)) / _contrast(flat)


def _contrast(flat: Tensor) -> Tensor:
    return (flat.var(dim=2, keepdim=True) + NOISE).sqrt()


def repainted(image: Tensor, painting: Tensor, visible: Tensor) -> Tensor:
    """The image with its hidden patches painted, in the brightness and contrast they had."""
    flat = patches(image.float())
    painted = patches(painting) * _contrast(flat) + flat.mean(dim=2, keepdim=True)
    size = (image.shape[2], image.shape[3])
    return unpatch(torch.where(visible.flatten(1)[..., None], flat, painted), size)
