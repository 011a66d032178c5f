"""EfficientNet-Lite0 [Tan 2019] and the scene descriptor built on it."""

from __future__ import annotations

from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor, nn

CONTRAST = 0.5
"""Standard deviation of the training images (ImageNet, (x - 127) / 128); inputs of this package have 1."""
STEM = 32


class Stage(NamedTuple):
    """Blocks of one width; the first block has the stride."""

    kernel: int
    stride: int
    expansion: int
    channels: int
    blocks: int


STAGES = (
    Stage(3, 1, 1, 16, 1),
    Stage(3, 2, 6, 24, 2),
    Stage(5, 2, 6, 40, 2),
    Stage(3, 2, 6, 80, 3),
    Stage(5, 1, 6, 112, 3),
    Stage(5, 2, 6, 192, 4),
    Stage(3, 1, 6, 320, 1),
)
ENDS = (1, 2, 4, 6)
"""Indices of the last stages at strides 4, 8, 16 and 32."""


class SamePadding(nn.Module):
    """Convolution with the padding of TensorFlow: an odd pixel goes to the right and to the bottom."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, groups=groups)
        self._kernel, self._stride = kernel, stride

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to (B, C', H / stride, W / stride), H and W being multiples of the stride."""
        total = self._kernel - self._stride
        before, after = total // 2, total - total // 2
        return self.conv(F.pad(x, (before, after, before, after)))


class LiteBlock(nn.Module):
    """Inverted residual block: expansion, depth-wise convolution, projection."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        hidden = inputs * expansion
        self.expand = nn.Conv2d(inputs, hidden, 1) if expansion > 1 else None
        self.depthwise = SamePadding(hidden, hidden, kernel, stride, groups=hidden)
        self.project = nn.Conv2d(hidden, outputs, 1)
        self._residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to (B, C', H / stride, W / stride)."""
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = self.project(F.relu6(self.depthwise(y)))
        return x + y if self._residual else y


class EfficientNetLite0(nn.Module):
    """EfficientNet-Lite0 without classifier, for one grey channel of zero mean and unit contrast.

    Args:
        depth: number of stages.
    """

    def __init__(self, depth: int = len(STAGES)) -> None:
        super().__init__()
        self.stem = SamePadding(1, STEM, 3, 2)
        self.stages = nn.ModuleList()
        inputs = STEM
        for kernel, stride, expansion, channels, count in STAGES[:depth]:
            blocks = [LiteBlock(inputs, channels, kernel, stride, expansion)]
            blocks += [LiteBlock(channels, channels, kernel, 1, expansion) for _ in range(count - 1)]
            self.stages.append(nn.Sequential(*blocks))
            inputs = channels
        self.channels = [STAGES[end].channels for end in ENDS if end < depth]
        for module in self.modules():
            # without normalisation, the default initialisation lets the signal vanish
            if isinstance(module, nn.Conv2d) and module.bias is not None:
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Map (B, 1, H, W) to the maps at strides 4, 8, 16 and 32, finest first, as far as the trunk goes."""
        x = F.relu6(self.stem(image * CONTRAST))
        maps = []
        for number, stage in enumerate(self.stages):
            x = stage(x)
            if number in ENDS:
                maps.append(x)
        return maps


GRID = (3, 5)
"""Rows and columns; a finer grid lowers recall between different headings."""
DEPTH = 5
"""Stages of the trunk; later stages encode object classes rather than appearance."""


class SceneDescriptor(nn.Module):
    """EfficientNet-Lite0 up to stride 16, pooled, centred and projected; the trunk is not trained."""

    def __init__(self, length: int) -> None:
        super().__init__()
        self.trunk = EfficientNetLite0(DEPTH)
        self.trunk.requires_grad_(False)
        channels = STAGES[DEPTH - 1].channels
        self.projection = nn.Linear(GRID[0] * GRID[1] * channels, length, bias=False)

    def pool(self, image: Tensor) -> Tensor:
        """Return maps (B, C, 3, 5) of a standardised image (B, 1, H, W), with the mean over the cells removed."""
        return self.pool_map(self.trunk(image)[-1])

    def pool_map(self, deepest: Tensor) -> Tensor:
        """Return maps (B, C, 3, 5) of the trunk's deepest map (B, C, H, W), with the mean over the cells removed."""
        cells = F.adaptive_avg_pool2d(deepest, GRID)
        return cells - cells.mean(dim=(2, 3), keepdim=True)

    def project(self, cells: Tensor) -> Tensor:
        """Map pooled maps (B, C * 15) to (B, length)."""
        scene: Tensor = self.projection(cells)
        return scene * scene.norm(dim=1, keepdim=True)

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, 1, H, W) to (B, length), shorter for views similar to the data it was fitted to."""
        return self.project(self.pool(image).flatten(1))
