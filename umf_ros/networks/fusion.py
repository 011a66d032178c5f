"""Attention blocks and the transformer that fuses image and voxel tokens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from umf_ros.networks.config import NetworkConfig

MASKED = -1e4


class Attention(nn.Module):
    """Multi-head attention [UMF 4.1] that also returns the attention maps."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.output = nn.Linear(width, width)

    def forward(self, queries: Tensor, keys: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the attended values and the attention maps.

        Args:
            queries: (B, N, C).
            keys: (B, M, C).
            mask: (B, M) bool, True where a key exists; None for all.

        Returns:
            (B, N, C), and the attention maps (B, heads, N, M), rows summing to one.
        """
        batch, count, width = queries.shape
        query = self.query(queries).view(batch, count, self.heads, -1).transpose(1, 2)
        key, value = self.key_value(keys).view(batch, keys.shape[1], 2, self.heads, -1).permute(2, 0, 3, 1, 4).unbind(0)
        scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
        if mask is not None:
            scores = scores + (~mask)[:, None, None].to(scores.dtype) * MASKED
        weights = scores.softmax(dim=-1)
        mixed = (weights.to(value.dtype) @ value).transpose(1, 2).reshape(batch, count, width)
        return self.output(mixed), weights


class Block(nn.Module):
    """Pre-norm transformer block: attention and feed-forward, both residual."""

    def __init__(self, width: int, heads: int, feedforward: int, cross: bool = False) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.norm_keys = nn.LayerNorm(width) if cross else None
        self.attention = Attention(width, heads)
        layers = nn.LayerNorm(width), nn.Linear(width, feedforward), nn.GELU(), nn.Linear(feedforward, width)
        self.feedforward = nn.Sequential(*layers)

    def forward(self, tokens: Tensor, keys: Tensor | None = None, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return tokens (B, N, C) after attention to `keys` (B, M, C), or to themselves, and the attention maps."""
        queries = self.norm(tokens)
        if keys is None or self.norm_keys is None:
            update, weights = self.attention(queries, queries, mask)
        else:
            update, weights = self.attention(queries, self.norm_keys(keys), mask)
        tokens = tokens + update
        return tokens + self.feedforward(tokens), weights


def received(weights: Tensor, query_mask: Tensor | None = None, key_mask: Tensor | None = None) -> Tensor:
    """Return the attention that each key received; 1 is the fair share.

    Args:
        weights: (B, heads, N, M) attention maps.
        query_mask: (B, N) bool, queries that count.
        key_mask: (B, M) bool, keys that exist.

    Returns:
        (B, M) float32.
    """
    if query_mask is None or key_mask is None:
        return weights.float().mean(dim=(1, 2)) * weights.shape[-1]
    share = query_mask.to(weights.dtype) / query_mask.sum(1, keepdim=True).clamp(min=1)
    attention = (share[:, None, None] @ weights).squeeze(2).float().mean(1)
    return attention * key_mask.float().sum(1, keepdim=True).clamp(min=1)


def sine_encoding(positions: Tensor, channels: int) -> Tensor:
    """Encode positions in [0, 1] by sines and cosines of rising wavelength.

    Args:
        positions: (..., A), one column per axis.
        channels: length of the encoding, zero beyond the whole sine-cosine pairs of A axes.

    Returns:
        (..., channels).
    """
    axes = positions.shape[-1]
    pairs = channels // (2 * axes)
    wavelengths = 100.0 ** (torch.arange(pairs, device=positions.device, dtype=positions.dtype) / max(pairs, 1))
    phase = (positions * 2 * math.pi).unsqueeze(-1) * (4.0 / wavelengths)
    code = torch.stack([phase.sin(), phase.cos()], dim=-1).flatten(-3)
    return torch.nn.functional.pad(code, (0, channels - code.shape[-1]))


def cell_positions(*shape: int) -> Tensor:
    """Return (N, A) centres of the cells of a map or grid of A axes, the last of them fastest, in [0, 1]."""
    axes = [(torch.arange(size) + 0.5) / size for size in shape]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(shape))


class VoxelPositions(nn.Module):
    """Position encodings of the cells of a cubic grid, from one table per axis; one of all cells takes megabytes."""

    def __init__(self, cells: int, channels: int) -> None:
        super().__init__()
        self.cells, self.channels = cells, channels
        self.axis: Tensor
        self.register_buffer("axis", sine_encoding(cell_positions(cells), channels // 6 * 2), persistent=False)

    def forward(self, index: Tensor) -> Tensor:
        """Return the encodings (..., channels) of cells with flat indices (...)."""
        x, y, z = index // self.cells**2, index // self.cells % self.cells, index % self.cells
        code = torch.cat([self.axis[x], self.axis[y], self.axis[z]], dim=-1)
        return nn.functional.pad(code, (0, self.channels - code.shape[-1]))


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
    """Learned token in place of a missing modality."""

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
    """Self-attention within and then cross-attention between the modalities, in both directions."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        sizes = config.tokens, config.heads, config.feedforward
        self.image_self, self.cloud_self = Block(*sizes), Block(*sizes)
        self.image_cross, self.cloud_cross = Block(*sizes, cross=True), Block(*sizes, cross=True)

    def forward(self, image: Tokens, cloud: Tokens) -> tuple[Tokens, Tokens]:
        """Return both sets of tokens after the layer."""
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
        """Map (B, N, C) to (B, C)."""
        weight = tokens.mask.unsqueeze(-1).float()
        powered = tokens.values.float().clamp(min=1e-4).pow(self.exponent) * weight
        return (powered.sum(1) / weight.sum(1)).pow(1 / self.exponent)


class Fused(NamedTuple):
    """Descriptors of a batch.

    Attributes:
        descriptor: (B, D) float32, L2-normalised: both halves, weighted.
        image, cloud: (B, D/2) float32, L2-normalised halves, the scene descriptor is part of the image half;
            undefined for an absent modality.
        weights: (B, 2) share of the image and of the cloud in the descriptor, summing to one.
    """

    descriptor: Tensor
    image: Tensor
    cloud: Tensor
    weights: Tensor


class Fusion(nn.Module):
    """Fusion transformer, GeM pooling and fully connected layer per modality, and their weighted union.

    Each modality fills its half of the descriptor, with a weight computed for each frame (adaptive weights [UMF 3.9]).
    A missing modality has weight zero, so that similarity to a complete frame depends on the common modality.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.layers = nn.ModuleList(FusionLayer(config) for _ in range(config.layers))
        self.image_norm, self.cloud_norm = nn.LayerNorm(config.tokens), nn.LayerNorm(config.tokens)
        self.image_pool, self.cloud_pool = GeneralisedMean(), GeneralisedMean()
        half = config.descriptor // 2
        self.image_head, self.cloud_head = nn.Linear(config.tokens, half), nn.Linear(config.tokens, half)
        self.weigh = nn.Linear(2 * config.tokens, 2)

    def pool(self, image: Tokens, cloud: Tokens) -> tuple[Tensor, Tensor]:
        """Return the pooled tokens (B, C) of the image and of the cloud, the input of the heads."""
        for layer in self.layers:
            image, cloud = layer(image, cloud)
        pooled_image = self.image_pool(Tokens(self.image_norm(image.values), image.mask))
        pooled_cloud = self.cloud_pool(Tokens(self.cloud_norm(cloud.values), cloud.mask))
        return pooled_image, pooled_cloud

    def describe(
        self, image: Tensor, cloud: Tensor, image_present: Tensor, cloud_present: Tensor, scene: Tensor | None = None
    ) -> Fused:
        """Return the descriptors of pooled tokens.

        Args:
            image: (B, C) pooled image tokens.
            cloud: (B, C) pooled cloud tokens.
            image_present: (B,) bool.
            cloud_present: (B,) bool.
            scene: (B, S) scene descriptors or None; their length is their weight beside the image half.
        """
        with torch.autocast(image.device.type, enabled=False):
            image_half = nn.functional.normalize(self.image_head(image.float()), dim=-1)
            if scene is not None:
                image_half = nn.functional.normalize(torch.cat([image_half, scene.float()], dim=-1), dim=-1)
            cloud_half = nn.functional.normalize(self.cloud_head(cloud.float()), dim=-1)
            scores = self.weigh(torch.cat([image, cloud], dim=-1).float())
            present = torch.stack([image_present, cloud_present], dim=-1)
            # without any modality both weights stay, as the descriptor must be finite
            present = present | ~present.any(dim=-1, keepdim=True)
            weights = (scores + (~present).to(scores.dtype) * MASKED).softmax(dim=-1)
            # positive, as the gradient of the square root must stay finite
            shares = (weights + 1e-12).sqrt()
            descriptor = torch.cat([image_half * shares[:, :1], cloud_half * shares[:, 1:]], dim=-1)
            return Fused(nn.functional.normalize(descriptor, dim=-1), image_half, cloud_half, weights)
