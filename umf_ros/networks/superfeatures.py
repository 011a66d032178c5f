"""Super-features: an ordered set of learned templates that gather local features [UMF 4.3].

Written from the equations of [Weinzaepfel 2022].
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True, slots=True)
class SuperMap:
    """Super-features of a batch.

    Attributes:
        descriptors: (B, S, D) float32, L2-normalised; the column is the feature's ID.
        strength: (B, S) float32, norm before the normalisation.
        attention: (B, S, N) float32, where each looked after the last round, summing to one over N.
    """

    descriptors: Tensor
    strength: Tensor
    attention: Tensor


class IterativeAttention(nn.Module):
    """Local iterative transformer (LIT): templates compete for the local features, round after round."""

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
        """Gather tokens (B, N, C), of which those with mask (B, N) exist, into the super-features."""
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
