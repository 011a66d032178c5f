"""The layout of a view, as told by a trunk that has seen photographs.

Maps of an image classifier, averaged over a coarse grid, tell places apart that no simulation resembles. What all
cells of a view have in common is light and surface rather than place: it is taken away before the projection.

The result has no unit length. Its projection whitens what simulated views have in common, so that a view unlike all
of them comes out long, the more so as lengths are squared: photographs are two to three times as long as simulated
views, and there the scene outweighs the part of the descriptor that has seen nothing but simulations.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.networks.efficientnet import STAGES, EfficientNetLite0

GRID = (3, 5)
"""Rows and columns: finer, and a turned head is another place."""
DEPTH = 5
"""Stages of the trunk; the later ones know what a thing is rather than how it looks."""


class SceneDescriptor(nn.Module):
    """EfficientNet-Lite0 up to stride 16, pooled, centred and projected; its trunk is not trained with the rest."""

    def __init__(self, length: int) -> None:
        super().__init__()
        self.trunk = EfficientNetLite0(DEPTH)
        self.trunk.requires_grad_(False)
        channels = STAGES[DEPTH - 1].channels
        self.projection = nn.Linear(GRID[0] * GRID[1] * channels, length, bias=False)

    def pool(self, image: Tensor) -> Tensor:
        """Maps (B, C, 3, 5) of a standardised image (B, 1, H, W), without what the cells share."""
        cells = F.adaptive_avg_pool2d(self.trunk(image)[-1], GRID)
        return cells - cells.mean(dim=(2, 3), keepdim=True)

    def project(self, cells: Tensor) -> Tensor:
        """(B, C * 15) pooled maps to (B, length)."""
        scene: Tensor = self.projection(cells)
        return scene * scene.norm(dim=1, keepdim=True)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 1, H, W) to (B, length), short where the view resembles those it was fitted to."""
        return self.project(self.pool(image).flatten(1))
