"""Random weights of EfficientNet-Lite0 under their published names."""

from __future__ import annotations

import torch
from torch import Tensor

from umf_ros.networks.efficientnet import STAGES


def published_tensors() -> dict[str, Tensor]:
    """Random weights under the names of the published checkpoint."""
    generator = torch.Generator().manual_seed(0)
    found: dict[str, Tensor] = {}

    def add(conv: str, norm: str, *shape: int) -> None:
        fan = shape[1] * shape[2] * shape[3]
        found[f"{conv}.weight"] = torch.randn(shape, generator=generator) * (2 / fan) ** 0.5
        for name, spread in (("weight", 0.2), ("running_var", 0.3)):
            found[f"{norm}.{name}"] = 1 + spread * torch.rand(shape[0], generator=generator)
        for name in ("bias", "running_mean"):
            found[f"{norm}.{name}"] = 0.1 * torch.randn(shape[0], generator=generator)

    add("_conv_stem", "_bn0", 32, 3, 3, 3)
    inputs, number = 32, 0
    for kernel, _, expansion, channels, count in STAGES:
        for _ in range(count):
            of, hidden = f"_blocks.{number}.", inputs * expansion
            if expansion > 1:
                add(f"{of}_expand_conv", f"{of}_bn0", hidden, inputs, 1, 1)
            add(f"{of}_depthwise_conv", f"{of}_bn1", hidden, 1, kernel, kernel)
            add(f"{of}_project_conv", f"{of}_bn2", channels, hidden, 1, 1)
            inputs, number = channels, number + 1
    return found
