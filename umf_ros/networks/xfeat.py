"""XFeat [Potje 2024]: key points and local descriptors of images."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from umf_ros.core.errors import WeightsError
from umf_ros.networks.config import XFEAT_CELL

DESCRIPTOR = 64


class XFeat(nn.Module):
    """Descriptors, key points and reliability of a grey image [Potje 2024, fig. 3].

    A convolutional pyramid with its three deepest levels fused at an eighth of the resolution gives descriptors. A
    separate branch on squares of eight by eight pixels gives key points. Batch normalisation is folded into the
    convolutions.
    """

    def __init__(self) -> None:
        super().__init__()
        self.skip = nn.Conv2d(1, 24, 1)
        self.shallow = nn.Sequential(*_conv(1, 4), *_conv(4, 8, 3, 2), *_conv(8, 8), *_conv(8, 24, 3, 2))
        self.quarter = nn.Sequential(*_conv(24, 24), *_conv(24, 24))
        self.eighth = nn.Sequential(*_conv(24, 64, 3, 2), *_conv(64, 64), *_conv(64, 64, 1))
        self.sixteenth = nn.Sequential(*_conv(64, 64, 3, 2), *_conv(64, 64), *_conv(64, 64))
        self.thirtysecond = nn.Sequential(*_conv(64, 128, 3, 2), *_conv(128, 128), *_conv(128, 128), *_conv(128, 64, 1))
        self.fusion = nn.Sequential(*_conv(64, 64), *_conv(64, 64), nn.Conv2d(64, DESCRIPTOR, 1))
        self.reliability = nn.Sequential(*_conv(64, 64, 1), *_conv(64, 64, 1), nn.Conv2d(64, 1, 1), nn.Sigmoid())
        self.corners = nn.Sequential(
            *_conv(XFEAT_CELL**2, 64, 1), *_conv(64, 64, 1), *_conv(64, 64, 1), nn.Conv2d(64, XFEAT_CELL**2 + 1, 1)
        )

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the maps of an image.

        Args:
            image: (1, 1, H, W) grey values of any scale; H and W are multiples of 32.

        Returns:
            Descriptors (1, 64, H / 8, W / 8) of unit length; probability (1, 1, H, W) that a pixel is a key point;
            reliability (1, 1, H / 8, W / 8) of the descriptors, 0 to 1.
        """
        mean = image.mean((2, 3), keepdim=True)
        image = image - mean
        image = image / (image.square().mean((2, 3), keepdim=True) + 1e-5).sqrt()
        quarter = self.quarter(self.shallow(image) + self.skip(functional.avg_pool2d(image, 4)))
        eighth = self.eighth(quarter)
        sixteenth = self.sixteenth(eighth)
        deep = [sixteenth, self.thirtysecond(sixteenth)]
        raised = [functional.interpolate(level, eighth.shape[-2:], mode="bilinear") for level in deep]
        features = self.fusion(eighth + raised[0] + raised[1])
        # the last of the 65 classes is a square without key point
        corners = self.corners(functional.pixel_unshuffle(image, XFEAT_CELL)).softmax(1)[:, : XFEAT_CELL**2]
        return (
            functional.normalize(features, dim=1),
            functional.pixel_shuffle(corners, XFEAT_CELL),
            self.reliability(features),
        )


def load_xfeat(path: Path) -> XFeat:
    """Return the network with the weights of a file, in single precision and evaluation mode.

    Raises:
        WeightsError: missing, truncated or foreign file.
    """
    network = XFeat()
    try:
        network.load_state_dict({name: value.float() for name, value in load_file(path).items()})
    except (OSError, SafetensorError, RuntimeError, ValueError) as error:
        raise WeightsError(f"{path} does not hold weights of XFeat: {' '.join(str(error).split())[:200]}") from None
    return network.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


def _conv(inputs: int, outputs: int, side: int = 3, stride: int = 1) -> tuple[nn.Module, nn.Module]:
    return nn.Conv2d(inputs, outputs, side, stride, side // 2), nn.ReLU()
