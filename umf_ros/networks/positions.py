"""Sine encodings of position [UMF 4.2] [Carion 2020], which keep the 2-D and 3-D layout of the tokens."""

from __future__ import annotations

import math

import torch
from torch import Tensor


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
