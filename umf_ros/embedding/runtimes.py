"""What runs the network: torch, or OpenVINO where it is installed."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from umf_ros.embedding.export import cached, convert, kept_or_made
from umf_ros.embedding.inputs import blank_input
from umf_ros.errors import ConfigError
from umf_ros.networks.umf import UMF, NetworkInput, NetworkOutput

Outputs = dict[str, NDArray[np.float32]]


OUTPUTS = ("descriptor", "image", "image_saliency", "cloud", "cloud_saliency")
SUPERS = ("super_image", "super_image_strength", "super_cloud", "super_cloud_strength")


class Flat(nn.Module):
    """The network with tensors for arguments and results, as an exporter needs it."""

    def __init__(self, network: UMF, super_features: bool) -> None:
        super().__init__()
        self.network = network
        self.super_features = super_features

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The fields of `NetworkInput` in order, to `OUTPUTS` (and `SUPERS`)."""
        found: NetworkOutput = self.network(NetworkInput(*inputs), super_features=self.super_features)
        image, cloud = found.image, found.cloud
        flat = (found.descriptor, image.descriptors, image.saliency, cloud.descriptors, cloud.saliency)
        if found.super_image is None or found.super_cloud is None:
            return flat
        supers = found.super_image, found.super_cloud
        return (*flat, *(part for each in supers for part in (each.descriptors, each.strength)))


class TorchRuntime:
    """Plain torch, in single precision.

    Raises:
        ConfigError: torch does not know the device.
    """

    def __init__(self, network: UMF, device: str, threads: int, super_features: bool) -> None:
        if device == "cpu":
            torch.set_num_threads(threads)
        try:
            self._device = torch.device(device)
            self._flat = Flat(network.eval().to(self._device), super_features)
        except (RuntimeError, AssertionError) as error:
            raise ConfigError(f"embedding.device: cannot use {device!r}: {str(error).splitlines()[0]}") from None

    def run(self, batch: NetworkInput) -> Outputs:
        """Outputs of a batch of one by name, as in `OUTPUTS`, without the batch axis."""
        with torch.inference_mode():
            found = self._flat(*batch.to(self._device))
        return _named([value[0].float().cpu().numpy() for value in found])


class OpenVinoRuntime:
    """OpenVINO on the CPU; the network is converted at the first start and kept in the user's cache."""

    def __init__(self, network: UMF, weights: Path, threads: int, super_features: bool) -> None:
        import openvino

        model = kept_or_made(
            cached(weights, super_features),
            lambda: convert(Flat(network.eval(), super_features), blank_input(network.config)._asdict()),
        )
        # single precision: half of it moves similarities by more than a threshold can bear
        options: dict[str, Any] = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": threads}
        options |= {"NUM_STREAMS": 1, "PERFORMANCE_HINT": "LATENCY"}
        self._model = openvino.Core().compile_model(model, "CPU", options)

    def run(self, batch: NetworkInput) -> Outputs:
        """As the other's."""
        found = self._model([tensor.numpy() for tensor in batch])
        return _named([found[port][0].astype(np.float32) for port in self._model.outputs])


Runtime = TorchRuntime | OpenVinoRuntime


def make_runtime(runtime: str, network: UMF, weights: Path, device: str, threads: int, super_features: bool) -> Runtime:
    """The runtime by name; "auto" prefers OpenVINO on a CPU where it is installed.

    Args:
        runtime: auto, torch or openvino.
        network: to run.
        weights: where the network was loaded from.
        device: torch device; OpenVINO runs on the CPU only.
        threads: 0: as many as there are cores.
        super_features: whether to compute them.

    Raises:
        ConfigError: OpenVINO is wanted but not installed or not possible on the device.
    """
    count = threads or len(os.sched_getaffinity(0))
    installed = find_spec("openvino") is not None
    if runtime == "openvino" and (not installed or device != "cpu"):
        why = "it is not installed" if not installed else f"it does not run on {device!r} here"
        raise ConfigError(f"embedding.runtime: cannot use openvino: {why}")
    if runtime == "torch" or device != "cpu" or not installed:
        return TorchRuntime(network, device, count, super_features)
    return OpenVinoRuntime(network, weights, count, super_features)


def _named(values: list[NDArray[np.float32]]) -> Outputs:
    return dict(zip((*OUTPUTS, *SUPERS), values, strict=False))
