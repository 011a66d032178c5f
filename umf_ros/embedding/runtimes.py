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

from umf_ros.config import EmbeddingSettings
from umf_ros.embedding.export import cached, convert, kept_or_made, openvino_core
from umf_ros.embedding.inputs import blank_input
from umf_ros.errors import ConfigError
from umf_ros.frames import Points
from umf_ros.networks.umf import UMF, NetworkInput, NetworkOutput
from umf_ros.networks.xfeat import XFeat, load_xfeat

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
        model = kept_or_made(
            cached(weights, super_features),
            lambda: convert(Flat(network.eval(), super_features), blank_input(network.config)._asdict()),
        )
        self._model = _compiled(model, threads)

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
    if _wants_openvino(runtime, device):
        return OpenVinoRuntime(network, weights, count, super_features)
    return TorchRuntime(network, device, count, super_features)


class XFeatTorchRuntime:
    """XFeat in plain torch, on the threads that the other network has."""

    def __init__(self, network: XFeat, device: str) -> None:
        self._device = torch.device(device)
        self._network = network.to(self._device)

    def run(self, image: Points) -> tuple[Points, Points, Points]:
        """Descriptors (64, H / 8, W / 8), key points (H, W) and reliability (H / 8, W / 8) of an image (H, W)."""
        with torch.inference_mode():
            found = self._network(torch.from_numpy(image)[None, None].to(self._device))
        descriptors, corners, reliability = (value[0].cpu().numpy() for value in found)
        return descriptors, corners[0], reliability[0]


class XFeatOpenVinoRuntime:
    """XFeat in OpenVINO, for images of any size that is a multiple of 32 pixels."""

    def __init__(self, network: XFeat, weights: Path, threads: int) -> None:
        def make() -> Any:
            model = convert(network, {"image": torch.zeros(1, 1, 384, 512)})
            model.reshape([1, 1, -1, -1])
            return model

        self._model = _compiled(kept_or_made(cached(weights, False), make), threads)

    def run(self, image: Points) -> tuple[Points, Points, Points]:
        """As the other's."""
        found = self._model([image[None, None]])
        descriptors, corners, reliability = (np.array(found[port][0]) for port in self._model.outputs)
        return descriptors, corners[0], reliability[0]


XFeatRuntime = XFeatTorchRuntime | XFeatOpenVinoRuntime


def make_xfeat_runtime(weights: Path, settings: EmbeddingSettings) -> XFeatRuntime:
    """What runs XFeat: the same runtime that runs the network of these settings.

    Raises:
        WeightsError: the weights cannot be used.
        ConfigError: as `make_runtime`.
    """
    network = load_xfeat(weights)
    if _wants_openvino(settings.runtime, settings.device):
        return XFeatOpenVinoRuntime(network, weights, settings.threads or len(os.sched_getaffinity(0)))
    return XFeatTorchRuntime(network, settings.device)


def _wants_openvino(runtime: str, device: str) -> bool:
    installed = find_spec("openvino") is not None
    if runtime == "openvino" and (not installed or device != "cpu"):
        why = "it is not installed" if not installed else f"it does not run on {device!r} here"
        raise ConfigError(f"embedding.runtime: cannot use openvino: {why}")
    return runtime != "torch" and device == "cpu" and installed


def _compiled(model: Any, threads: int) -> Any:
    # single precision: half of it moves similarities by more than a threshold can bear
    options: dict[str, Any] = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": threads}
    options |= {"NUM_STREAMS": 1, "PERFORMANCE_HINT": "LATENCY"}
    return openvino_core().compile_model(model, "CPU", options)


def _named(values: list[NDArray[np.float32]]) -> Outputs:
    return dict(zip((*OUTPUTS, *SUPERS), values, strict=False))
