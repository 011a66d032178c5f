"""Attention between sets of tokens, with masks."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

MASKED = -1e4


class Attention(nn.Module):
    """Multi-head attention [UMF 4.1] that can also say where it looked."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.output = nn.Linear(width, width)

    def forward(self, queries: Tensor, keys: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Attend.

        Args:
            queries: (B, N, C).
            keys: (B, M, C).
            mask: (B, M) bool, True where a key exists; None: everywhere.

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
        self.feedforward = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, feedforward), nn.GELU(), nn.Linear(feedforward, width)
        )

    def forward(self, tokens: Tensor, keys: Tensor | None = None, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Tokens (B, N, C) after attending to `keys` (B, M, C), or to themselves; and the attention maps."""
        queries = self.norm(tokens)
        if keys is None or self.norm_keys is None:
            update, weights = self.attention(queries, queries, mask)
        else:
            update, weights = self.attention(queries, self.norm_keys(keys), mask)
        tokens = tokens + update
        return tokens + self.feedforward(tokens), weights


def received(weights: Tensor, query_mask: Tensor | None = None, key_mask: Tensor | None = None) -> Tensor:
    """How much each key was looked at, 1 being its fair share.

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
    looked = (share[:, None, None] @ weights).squeeze(2).float().mean(1)
    return looked * key_mask.float().sum(1, keepdim=True).clamp(min=1)


def sine_encoding(positions: Tensor, channels: int) -> Tensor:
    """Encode positions in [0, 1] by sines and cosines of rising wavelength.

    Args:
        positions: (..., A), one column per axis.
        channels: length of the encoding; what A axes of whole sine-cosine pairs leave over is zero.

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
    """(N, A) centres of the cells of a map or grid of A axes, the last of them fastest, in [0, 1]."""
    axes = [(torch.arange(size) + 0.5) / size for size in shape]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(shape))
