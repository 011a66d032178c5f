"""Encoders of images and of voxelised scans."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.networks.config import CELLS, FEATURES, NetworkConfig
from umf_ros.networks.efficientnet import EfficientNetLite0

RESNET_DEPTHS = {"resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3), "resnet50": (3, 4, 6, 3)}


def conv_norm(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Sequential:
    """Return the convolution without bias, and batch normalisation."""
    conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs))


class ResidualBlock(nn.Module):
    """Residual block [He 2016]: basic (two 3x3), or a bottleneck (1x1, 3x3, 1x1 with four times the width)."""

    def __init__(self, inputs: int, width: int, stride: int, bottleneck: bool) -> None:
        super().__init__()
        outputs = 4 * width if bottleneck else width
        if bottleneck:
            layers = [conv_norm(inputs, width, 1), conv_norm(width, width, 3, stride), conv_norm(width, outputs, 1)]
        else:
            layers = [conv_norm(inputs, width, 3, stride), conv_norm(width, width, 3)]
        self.layers = nn.ModuleList(layers)
        same = stride == 1 and inputs == outputs
        self.shortcut = nn.Identity() if same else conv_norm(inputs, outputs, 1, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to (B, C', H / stride, W / stride)."""
        y = x
        for number, layer in enumerate(self.layers):
            y = layer(y)
            if number < len(self.layers) - 1:
                y = F.relu(y)
        return F.relu(y + self.shortcut(x))


class Backbone(nn.Module):
    """A stem and four stages at strides 4, 8, 16 and 32."""

    def __init__(self, name: str, width: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(conv_norm(1, width, 7, 2), nn.ReLU(), nn.MaxPool2d(3, 2, 1))
        self.channels: list[int] = []
        stages = []
        inputs = width
        for level in range(4):
            stage, inputs = _stage(name, inputs, width * 2**level, level)
            stages.append(stage)
            self.channels.append(inputs)
        self.stages = nn.ModuleList(stages)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Map (B, 1, H, W) to the maps of the four stages, finest first."""
        x = self.stem(image)
        maps = []
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        return maps


def _stage(name: str, inputs: int, width: int, level: int) -> tuple[nn.Sequential, int]:
    stride = 1 if level == 0 else 2
    blocks: list[nn.Module] = []
    bottleneck = name == "resnet50"
    for number in range(RESNET_DEPTHS[name][level]):
        blocks.append(ResidualBlock(inputs, width, stride if number == 0 else 1, bottleneck))
        inputs = 4 * width if bottleneck else width
    return nn.Sequential(*blocks), inputs


class FeaturePyramid(nn.Module):
    """Top-down pyramid over a backbone's stages: a coarse map for fusion, a fine one for local features."""

    def __init__(self, channels: Sequence[int], pyramid: int, coarse: int, fine: int) -> None:
        super().__init__()
        self.laterals = nn.ModuleList(nn.Conv2d(count, pyramid, 1) for count in channels)
        self.coarse = nn.Conv2d(pyramid, coarse, 3, padding=1)
        self.fine = nn.Conv2d(pyramid, fine, 3, padding=1)

    def forward(self, maps: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the coarse map (B, coarse, H/16, W/16) and fine map (B, fine, H/4, W/4)."""
        top = self.laterals[3](maps[3])
        merged = []
        for level in (2, 1, 0):
            up = F.interpolate(top, scale_factor=2.0, mode="bilinear", align_corners=False)
            top = self.laterals[level](maps[level]) + up
            merged.append(top)
        return self.coarse(merged[0]), self.fine(merged[2])


class ImageEncoder(nn.Module):
    """Backbone and pyramid."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        lite = config.backbone == "efficientnet_lite0"
        self.backbone = EfficientNetLite0() if lite else Backbone(config.backbone, config.width)
        self.pyramid = FeaturePyramid(self.backbone.channels, config.pyramid, config.tokens, config.local)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return the coarse (B, tokens, H/16, W/16) and fine (B, local, H/4, W/4) maps of an image (B, 1, H, W)."""
        return self.pyramid(self.backbone(image))


def parent_and_child(voxels: Tensor) -> tuple[Tensor, Tensor]:
    """Return the flat index in the 20^3 grid and the number of the child (0 to 7) of flat indices in the 40^3 grid."""
    x, y, z = voxels // (CELLS * CELLS), voxels // CELLS % CELLS, voxels % CELLS
    half = CELLS // 2
    return (x // 2 * half + y // 2) * half + z // 2, x % 2 * 4 + y % 2 * 2 + z % 2


def take(cells: Tensor, index: Tensor) -> Tensor:
    """Return features (B, N, C) of the cells of a dense map (B, C, X, Y, Z) at flat indices (B, N)."""
    wanted = index.unsqueeze(1).expand(-1, cells.shape[1], -1)
    return cells.flatten(2).gather(2, wanted).transpose(1, 2)


def conv_block(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Return a 3-D convolution, batch normalisation, ReLU."""
    conv = nn.Conv3d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(conv, nn.BatchNorm3d(outputs), nn.ReLU())


class ResidualBlock3d(nn.Module):
    """Two convolutions beside a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        second = nn.Conv3d(channels, channels, 3, padding=1, bias=False)
        self.layers = nn.Sequential(conv_block(channels, channels), second, nn.BatchNorm3d(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, X, Y, Z) to the same shape; `x` is not negative."""
        return F.relu(x + self.layers(x))


class VoxelEncoder(nn.Module):
    """Encoder at 20^3, 10^3 and 5^3 cells with a top-down decoder."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        fine, middle, deep = config.voxel_channels
        self.stem = nn.Sequential(conv_block(FEATURES * 8, fine, 1), conv_block(fine, fine))
        self.down = _voxel_encoder_stage(fine, middle, config.voxel_blocks)
        self.bottom = _voxel_encoder_stage(middle, deep, config.voxel_blocks)
        self.up_middle = nn.Conv3d(deep, middle, 1)
        self.up_fine = nn.Conv3d(middle, fine, 1)
        self.coarse = nn.Conv3d(middle, config.tokens, 1)
        # a voxel's feature: its parent cell's, its own measurements, and its number as a child
        layers = nn.Linear(fine + FEATURES + 8, config.local), nn.GELU(), nn.Linear(config.local, config.local)
        self.fine = nn.Sequential(*layers)

    def forward(self, grid: Tensor, coarse_index: Tensor, fine_index: Tensor) -> tuple[Tensor, Tensor]:
        """Encode a grid and read it at the occupied voxels.

        Args:
            grid: (B, 20, 20, 20, 48) folded features of the voxels, x y z.
            coarse_index: (B, T) flat indices in the 10^3 grid.
            fine_index: (B, V) flat indices in the 40^3 grid.

        Returns:
            Coarse tokens (B, T, tokens) and fine features (B, V, local).
        """
        folded = grid.permute(0, 4, 1, 2, 3)  # channels last in memory
        fine = self.stem(folded)
        middle = self.down(fine)
        deep = self.bottom(middle)
        middle = middle + _double(self.up_middle(deep))
        coarse = take(self.coarse(middle), coarse_index)
        fine = fine + _double(self.up_fine(middle))
        return coarse, self._fine_features(fine, folded, fine_index)

    def _fine_features(self, cells: Tensor, folded: Tensor, index: Tensor) -> Tensor:
        parent, child = parent_and_child(index)
        context = take(cells, parent)
        family = take(folded, parent).unflatten(-1, (FEATURES, 8))
        own = family.gather(3, child[..., None, None].expand(-1, -1, FEATURES, 1)).squeeze(3).to(context.dtype)
        place = F.one_hot(child, 8).to(context.dtype)
        return self.fine(torch.cat([context, own, place], dim=-1))


def _voxel_encoder_stage(inputs: int, outputs: int, blocks: int) -> nn.Sequential:
    """Return a stage that halves the resolution."""
    further = (ResidualBlock3d(outputs) for _ in range(blocks))
    return nn.Sequential(conv_block(inputs, outputs, stride=2), conv_block(outputs, outputs), *further)


def _double(cells: Tensor) -> Tensor:
    return F.interpolate(cells, scale_factor=2.0, mode="nearest")
