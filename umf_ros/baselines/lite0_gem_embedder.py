"""The shipped stages of EfficientNet-Lite0 with a generalised mean, never trained by us."""

from __future__ import annotations

from pathlib import Path

import torch

from umf_ros.baselines.place_network import IMAGE_SIZE, LATE, Gem, ImageTrunk
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Embedding, Frame
from umf_ros.embedding.embedder import FeatureRequest, unit_descriptor
from umf_ros.embedding.inputs import is_blank, shrink, standardise
from umf_ros.networks.umf import count_parameters
from umf_ros.networks.weights import load_weights
from umf_ros.networks.weights_files import locate_weights

TRUNK_FROM = Path("umf_scene")


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


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> Lite0GemEmbedder:
    """With the trunk of the shipped weights."""
    return Lite0GemEmbedder()
