"""Fusion of image and voxel tokens [UMF 4.1, 4.2], and the pooling of the result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from umf_ros.networks.attention import MASKED, Block
from umf_ros.networks.config import NetworkConfig


@dataclass(frozen=True, slots=True)
class Tokens:
    """Tokens of one modality.

    Attributes:
        values: (B, N, C).
        mask: (B, N) bool, True where a token exists; at least one per row.
    """

    values: Tensor
    mask: Tensor


class AbsentToken(nn.Module):
    """Stands in for a modality that is missing, so that a rover in the dark degrades and does not die."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.token = nn.Parameter(torch.randn(width) * 0.02)

    def forward(self, tokens: Tokens, present: Tensor) -> Tokens:
        """Keep the rows where `present` (B,) bool; elsewhere the learned token alone remains."""
        keep = present[:, None]
        first = torch.arange(tokens.mask.shape[1], device=tokens.mask.device) == 0
        values = torch.where(keep[..., None], tokens.values, self.token.to(tokens.values.dtype))
        return Tokens(values, torch.where(keep, tokens.mask, first))


class FusionLayer(nn.Module):
    """Self-attention within, then cross-attention between the modalities, in both directions at once."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        sizes = config.tokens, config.heads, config.feedforward
        self.image_self, self.cloud_self = Block(*sizes), Block(*sizes)
        self.image_cross, self.cloud_cross = Block(*sizes, cross=True), Block(*sizes, cross=True)

    def forward(self, image: Tokens, cloud: Tokens) -> tuple[Tokens, Tokens]:
        """Both sets of tokens after the layer."""
        own_image, _ = self.image_self(image.values, mask=image.mask)
        own_cloud, _ = self.cloud_self(cloud.values, mask=cloud.mask)
        new_image, _ = self.image_cross(own_image, own_cloud, cloud.mask)
        new_cloud, _ = self.cloud_cross(own_cloud, own_image, image.mask)
        return Tokens(new_image, image.mask), Tokens(new_cloud, cloud.mask)


class GeneralisedMean(nn.Module):
    """GeM pooling [Radenović 2019] over the tokens that exist, with a learned exponent."""

    def __init__(self, exponent: float = 3.0) -> None:
        super().__init__()
        self.exponent = nn.Parameter(torch.tensor(exponent))

    def forward(self, tokens: Tokens) -> Tensor:
        """(B, N, C) to (B, C)."""
        weight = tokens.mask.unsqueeze(-1).float()
        powered = tokens.values.float().clamp(min=1e-4).pow(self.exponent) * weight
        return (powered.sum(1) / weight.sum(1)).pow(1 / self.exponent)


class Fused(NamedTuple):
    """Descriptors of a batch.

    Attributes:
        descriptor: (B, D) float32, L2-normalised: both halves, weighted.
        image, cloud: (B, D/2) float32, L2-normalised halves, the scene being part of the image's; without
            meaning where the modality is absent.
        weights: (B, 2) share of the image and of the cloud in the descriptor, summing to one.
    """

    descriptor: Tensor
    image: Tensor
    cloud: Tensor
    weights: Tensor


class Fusion(nn.Module):
    """Fusion transformer, GeM pooling and fully connected layer per modality, and their weighted union.

    Each modality fills its half of the descriptor. How much a half counts is decided frame by frame
    (adaptive weights [UMF 3.9]), and a missing modality counts nothing: similarity to a complete
    frame then rests on what both have.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.layers = nn.ModuleList(FusionLayer(config) for _ in range(config.layers))
        self.image_norm, self.cloud_norm = nn.LayerNorm(config.tokens), nn.LayerNorm(config.tokens)
        self.image_pool, self.cloud_pool = GeneralisedMean(), GeneralisedMean()
        half = config.descriptor // 2
        self.image_head, self.cloud_head = nn.Linear(config.tokens, half), nn.Linear(config.tokens, half)
        self.weigh = nn.Linear(2 * config.tokens, 2)

    def forward(
        self, image: Tokens, cloud: Tokens, image_present: Tensor, cloud_present: Tensor, scene: Tensor | None = None
    ) -> Fused:
        """Fuse tokens of which the absent rows (present: (B,) bool) hold the learned token alone.

        Args:
            image: its tokens.
            cloud: its tokens.
            image_present: (B,) bool.
            cloud_present: (B,) bool.
            scene: (B, S), of a network that has such a part; its length is its weight beside the image's half.
        """
        seen, felt = self.pool(image, cloud)
        return self.describe(seen, felt, image_present, cloud_present, scene)

    def pool(self, image: Tokens, cloud: Tokens) -> tuple[Tensor, Tensor]:
        """(B, C) of the image and of the cloud: all that the heads see of the tokens."""
        for layer in self.layers:
            image, cloud = layer(image, cloud)
        seen = self.image_pool(Tokens(self.image_norm(image.values), image.mask))
        felt = self.cloud_pool(Tokens(self.cloud_norm(cloud.values), cloud.mask))
        return seen, felt

    def describe(
        self, seen: Tensor, felt: Tensor, image_present: Tensor, cloud_present: Tensor, scene: Tensor | None = None
    ) -> Fused:
        """Descriptors of what was pooled; the other arguments as in `forward`."""
        with torch.autocast(seen.device.type, enabled=False):
            image_half = nn.functional.normalize(self.image_head(seen.float()), dim=-1)
            if scene is not None:
                image_half = nn.functional.normalize(torch.cat([image_half, scene.float()], dim=-1), dim=-1)
            cloud_half = nn.functional.normalize(self.cloud_head(felt.float()), dim=-1)
            scores = self.weigh(torch.cat([seen, felt], dim=-1).float())
            present = torch.stack([image_present, cloud_present], dim=-1)
            # with neither, both stay: the descriptor must be a number
            present = present | ~present.any(dim=-1, keepdim=True)
            weights = (scores + (~present).to(scores.dtype) * MASKED).softmax(dim=-1)
            # not quite zero: the root's slope must stay finite
            shares = (weights + 1e-12).sqrt()
            descriptor = torch.cat([image_half * shares[:, :1], cloud_half * shares[:, 1:]], dim=-1)
            return Fused(nn.functional.normalize(descriptor, dim=-1), image_half, cloud_half, weights)
