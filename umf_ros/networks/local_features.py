"""Local features [UMF 4.4] and super-features [UMF 4.3].

Local features come from two transformer layers; the attention they receive is their saliency. Super-features are an
ordered set of learned templates that aggregate local features, after the equations of [Weinzaepfel 2022].
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from umf_ros.networks.config import NetworkConfig
from umf_ros.networks.fusion import Block, cell_positions, received, sine_encoding

WINDOW = 8
HEADS = 4


@dataclass(frozen=True, slots=True)
class LocalMap:
    """Local features of one modality.

    Attributes:
        tokens: (B, N, C) features after the transformer layers.
        descriptors: (B, N, D) float32, L2-normalised.
        saliency: (B, N) float32, attention received averaged over the layers; 1 is the fair share.
        mask: (B, N) bool, False where there is no feature.
    """

    tokens: Tensor
    descriptors: Tensor
    saliency: Tensor
    mask: Tensor


class ImageLocal(nn.Module):
    """Attention within windows, then between equal positions of all windows."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.positions: Tensor
        self.rows, self.columns = config.image_size[0] // 4, config.image_size[1] // 4
        width = config.local
        positions = sine_encoding(cell_positions(self.rows, self.columns), width)
        self.register_buffer("positions", positions.view(self.rows, self.columns, width), persistent=False)
        self.near, self.far = Block(width, HEADS, 2 * width), Block(width, HEADS, 2 * width)
        self.norm = nn.LayerNorm(width)
        self.descriptor = nn.Linear(width, config.image_local)

    def forward(self, fine: Tensor) -> LocalMap:
        """Return local features of a fine map (B, C, H/4, W/4); N = H/4 * W/4, row by row."""
        batch, width = fine.shape[:2]
        tokens = fine.permute(0, 2, 3, 1) + self.positions.to(fine.dtype)
        windows = tokens.view(batch, self.rows // WINDOW, WINDOW, self.columns // WINDOW, WINDOW, width)
        windows = windows.transpose(2, 3)
        within = windows.reshape(-1, WINDOW * WINDOW, width)
        within, near_map = self.near(within)
        count = self.rows * self.columns // WINDOW**2
        across = within.view(batch, count, WINDOW * WINDOW, width).transpose(1, 2).reshape(-1, count, width)
        across, far_map = self.far(across)
        near = received(near_map).view(batch, count, WINDOW * WINDOW)
        far = received(far_map).view(batch, WINDOW * WINDOW, count).transpose(1, 2)
        tokens = self._unfold(across.view(batch, WINDOW * WINDOW, count, width).transpose(1, 2))
        saliency = self._unfold(((near + far) / 2).unsqueeze(-1)).squeeze(-1)
        mask = torch.ones_like(saliency, dtype=torch.bool)
        return LocalMap(tokens, _describe(self, tokens), saliency, mask)

    def _unfold(self, windows: Tensor) -> Tensor:
        """Reshape (B, windows, cells, C) to (B, N, C), row by row."""
        batch, channels = windows.shape[0], windows.shape[-1]
        grid = windows.reshape(batch, self.rows // WINDOW, self.columns // WINDOW, WINDOW, WINDOW, channels)
        return grid.transpose(2, 3).reshape(batch, self.rows * self.columns, channels)


class CloudLocal(nn.Module):
    """Two layers of attention among the occupied voxels."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width = config.local
        self.blocks = nn.ModuleList(Block(width, HEADS, 2 * width) for _ in range(2))
        self.norm = nn.LayerNorm(width)
        self.descriptor = nn.Linear(width, config.cloud_local)

    def forward(self, fine: Tensor, positions: Tensor, mask: Tensor) -> LocalMap:
        """Return local features of occupied voxels.

        Args:
            fine: (B, V, C) features.
            positions: (B, V, C) position encodings of the voxels.
            mask: (B, V) bool, False beyond the voxels of a scan.
        """
        tokens = fine + positions.to(fine.dtype)
        shares = []
        for block in self.blocks:
            tokens, weights = block(tokens, mask=mask)
            shares.append(received(weights, mask, mask))
        saliency = (shares[0] + shares[1]) / 2 * mask.float()
        return LocalMap(tokens, _describe(self, tokens), saliency, mask)


def _describe(head: ImageLocal | CloudLocal, tokens: Tensor) -> Tensor:
    return nn.functional.normalize(head.descriptor(head.norm(tokens)).float(), dim=-1)


@dataclass(frozen=True, slots=True)
class SuperMap:
    """Super-features of a batch.

    Attributes:
        descriptors: (B, S, D) float32, L2-normalised; the column is the feature's ID.
        strength: (B, S) float32, norm before the normalisation.
        attention: (B, S, N) float32, attention of the last iteration, with sum one over N.
    """

    descriptors: Tensor
    strength: Tensor
    attention: Tensor


class IterativeAttention(nn.Module):
    """Local iterative transformer (LIT): templates compete for the local features in every iteration."""

    def __init__(self, inputs: int, count: int, outputs: int, iterations: int) -> None:
        super().__init__()
        self.iterations = iterations
        self.templates = nn.Parameter(torch.randn(count, inputs) * inputs**-0.5)
        self.norm_inputs, self.norm_templates = nn.LayerNorm(inputs), nn.LayerNorm(inputs)
        self.norm_update, self.norm_output = nn.LayerNorm(inputs), nn.LayerNorm(inputs)
        self.key, self.value = nn.Linear(inputs, inputs, bias=False), nn.Linear(inputs, inputs, bias=False)
        self.query = nn.Linear(inputs, inputs, bias=False)
        self.update = nn.Sequential(nn.Linear(inputs, 2 * inputs), nn.GELU(), nn.Linear(2 * inputs, inputs))
        self.output = nn.Linear(inputs, outputs)

    def forward(self, tokens: Tensor, mask: Tensor) -> SuperMap:
        """Aggregate tokens (B, N, C) with mask (B, N) to super-features."""
        inputs = self.norm_inputs(tokens)
        key, value = self.key(inputs), self.value(inputs)
        templates = self.templates.expand(tokens.shape[0], -1, -1).to(tokens.dtype)
        attention = tokens.new_zeros(())
        for _ in range(self.iterations):
            query = self.query(self.norm_templates(templates))
            scores = (query @ key.transpose(1, 2)).float() * query.shape[-1] ** -0.5
            shares = scores.softmax(dim=1) * mask[:, None].float()
            attention = shares / (shares.sum(-1, keepdim=True) + 1e-6)
            templates = templates + attention.to(value.dtype) @ value
            templates = templates + self.update(self.norm_update(templates))
        features = self.output(self.norm_output(templates)).float()
        strength = features.norm(dim=-1)
        return SuperMap(features / strength.clamp(min=1e-6).unsqueeze(-1), strength, attention)
