"""Inference in torch, and the network in the form that an exporter needs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from umf_ros.core.errors import ConfigError
from umf_ros.embedding.inputs import InputArrays
from umf_ros.networks.config import XFEAT_OUTPUTS
from umf_ros.networks.umf import UMF, NetworkInput, NetworkOutput
from umf_ros.networks.weights import load_weights
from umf_ros.networks.xfeat import load_xfeat


def to_tensors(batch: InputArrays) -> NetworkInput:
    """Return the batch as tensors."""
    return NetworkInput(*(torch.from_numpy(array) for array in batch))


class FlatUmf(nn.Module):
    """The UMF network with tensors as arguments and results.

    Args:
        network: the network.
        outputs: names of the results, as in `runtimes.OUTPUTS` and `SUPERS`.
    """

    def __init__(self, network: UMF, outputs: tuple[str, ...]) -> None:
        super().__init__()
        self.network = network
        self.outputs = outputs

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Map the fields of `NetworkInput`, in their order, to the outputs."""
        found: NetworkOutput = self.network(NetworkInput(*inputs), super_features="super_image" in self.outputs)
        named: dict[str, Tensor] = {
            "descriptor": found.descriptor,
            "image_local": found.image.descriptors,
            "image_saliency": found.image.saliency,
            "cloud_local": found.cloud.descriptors,
            "cloud_saliency": found.cloud.saliency,
        }
        for name in ("super_image", "super_cloud"):
            supers = getattr(found, name)
            if supers is not None:
                named |= {name: supers.descriptors, f"{name}_strength": supers.strength}
        return tuple(named[name] for name in self.outputs)


class TorchRuntime:
    """Inference in torch, in single precision; a `runtimes.Runtime`.

    Args:
        weights: file of the UMF network, or for `XFEAT_OUTPUTS` of XFeat.
        outputs: names of the outputs to compute.
        device: torch device.
        threads: number of CPU threads.

    Raises:
        WeightsError: the weights cannot be used.
        ConfigError: torch does not support the device.
    """

    precision = "float32"

    def __init__(self, weights: Path, outputs: tuple[str, ...], device: str, threads: int) -> None:
        self.file, self._outputs = weights, outputs
        network = load_xfeat(weights) if outputs == XFEAT_OUTPUTS else FlatUmf(load_weights(weights), outputs)
        if device == "cpu":
            torch.set_num_threads(threads)
        try:
            self._device = torch.device(device)
            self._network = network.eval().to(self._device)
        except (RuntimeError, AssertionError) as error:
            raise ConfigError(f"embedding.device: cannot use {device!r}: {str(error).splitlines()[0]}") from None

    def run(self, inputs: Sequence[NDArray[Any]]) -> dict[str, NDArray[np.float32]]:
        """Return the outputs of a batch of one; see `runtimes.Runtime`."""
        with torch.inference_mode():
            found = self._network(*(torch.from_numpy(array).to(self._device) for array in inputs))
        values = (value[0].float().cpu().numpy() for value in found)
        return dict(zip(self._outputs, values, strict=True))
