"""What runs the networks in torch, and what an exporter makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from umf_ros.core.errors import ConfigError
from umf_ros.core.frames import Points
from umf_ros.embedding.export import convert
from umf_ros.embedding.inputs import InputArrays, blank_input
from umf_ros.networks.umf import UMF, NetworkInput, NetworkOutput
from umf_ros.networks.weights import load_weights
from umf_ros.networks.xfeat import load_xfeat


def to_tensors(batch: InputArrays) -> NetworkInput:
    """The batch as the network reads it."""
    return NetworkInput(*(torch.from_numpy(array) for array in batch))


class Flat(nn.Module):
    """The network with tensors for arguments and results, as an exporter needs it.

    Args:
        network: to run.
        outputs: names of the results, as in `runtimes.OUTPUTS` and `SUPERS`.
    """

    def __init__(self, network: UMF, outputs: tuple[str, ...]) -> None:
        super().__init__()
        self.network = network
        self.outputs = outputs

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The fields of `NetworkInput` in order, to the outputs."""
        found: NetworkOutput = self.network(NetworkInput(*inputs), super_features="super_image" in self.outputs)
        named: dict[str, Tensor] = {
            "descriptor": found.descriptor,
            "image": found.image.descriptors,
            "image_saliency": found.image.saliency,
            "cloud": found.cloud.descriptors,
            "cloud_saliency": found.cloud.saliency,
        }
        for name in ("super_image", "super_cloud"):
            supers = getattr(found, name)
            if supers is not None:
                named |= {name: supers.descriptors, f"{name}_strength": supers.strength}
        return tuple(named[name] for name in self.outputs)


class TorchRuntime:
    """Plain torch, in single precision.

    Raises:
        ConfigError: torch does not know the device.
    """

    def __init__(self, network: UMF, device: str, threads: int, outputs: tuple[str, ...]) -> None:
        if device == "cpu":
            torch.set_num_threads(threads)
        try:
            self._device = torch.device(device)
            self._flat = Flat(network.eval().to(self._device), outputs)
        except (RuntimeError, AssertionError) as error:
            raise ConfigError(f"embedding.device: cannot use {device!r}: {str(error).splitlines()[0]}") from None

    def run(self, batch: InputArrays) -> dict[str, Points]:
        """Outputs of a batch of one by name, without the batch axis."""
        with torch.inference_mode():
            found = self._flat(*to_tensors(batch).to(self._device))
        return {name: value[0].float().cpu().numpy() for name, value in zip(self._flat.outputs, found, strict=True)}


class XFeatTorchRuntime:
    """XFeat in plain torch, on the threads that the other network has."""

    def __init__(self, weights: Path, device: str) -> None:
        self._device = torch.device(device)
        self._network = load_xfeat(weights).to(self._device)

    def run(self, image: Points) -> tuple[Points, Points, Points]:
        """Descriptors (64, H / 8, W / 8), key points (H, W) and reliability (H / 8, W / 8) of an image (H, W)."""
        with torch.inference_mode():
            found = self._network(torch.from_numpy(image)[None, None].to(self._device))
        descriptors, corners, reliability = (value[0].cpu().numpy() for value in found)
        return descriptors, corners[0], reliability[0]


def converted(weights: Path, outputs: tuple[str, ...]) -> Any:
    """The network of a weights file as an OpenVINO model with some outputs.

    Raises:
        WeightsError: the weights cannot be used.
    """
    network = load_weights(weights)
    return convert(Flat(network, outputs), to_tensors(blank_input(network.config))._asdict())


def converted_xfeat(weights: Path) -> Any:
    """XFeat as an OpenVINO model for images of any size that is a multiple of 32 pixels.

    Raises:
        WeightsError: the weights cannot be used.
    """
    model = convert(load_xfeat(weights), {"image": torch.zeros(1, 1, 384, 512)})
    model.reshape([1, 1, -1, -1])
    return model
