"""What runs the networks: OpenVINO where it is installed, or torch, which is imported only then."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError, WeightsError, one_line
from umf_ros.core.frames import Points
from umf_ros.embedding.embedder import FeatureRequest
from umf_ros.embedding.export import cached, kept_or_made, openvino_core
from umf_ros.embedding.inputs import InputArrays, blank_input
from umf_ros.networks.config import read_config

Outputs = dict[str, NDArray[np.float32]]
XFEAT_BLANK = np.zeros((384, 512), np.float32)


OUTPUTS = ("descriptor", "image", "image_saliency", "cloud", "cloud_saliency")
SUPERS = ("super_image", "super_image_strength", "super_cloud", "super_cloud_strength")


def outputs_of(asked: FeatureRequest) -> tuple[str, ...]:
    """Names of the network's outputs that are needed: the others are not computed."""
    own = tuple(name for name in OUTPUTS if asked.image or not name.startswith("image"))
    return own + (SUPERS if asked.supers else ())


class Runtime(Protocol):
    """Runs the UMF network."""

    def run(self, batch: InputArrays) -> Outputs:
        """Outputs of a batch of one by name, without the batch axis."""
        ...


class XFeatRuntime(Protocol):
    """Runs XFeat."""

    def run(self, image: Points) -> tuple[Points, Points, Points]:
        """Descriptors (64, H / 8, W / 8), key points (H, W) and reliability (H / 8, W / 8) of an image (H, W)."""
        ...


class OpenVinoRuntime:
    """OpenVINO on the CPU; the network is converted at the first start and kept in the user's cache."""

    def __init__(self, weights: Path, threads: int, outputs: tuple[str, ...]) -> None:
        def make() -> Any:
            from umf_ros.embedding.torch_runtimes import converted

            return converted(weights, outputs)

        self._model = _compiled(kept_or_made(cached(weights, outputs), make), threads)
        self._outputs = outputs
        warm_up(weights, lambda: self.run(blank_input(read_config(weights))))

    def run(self, batch: InputArrays) -> Outputs:
        """See `Runtime`."""
        found = self._model(list(batch))
        values = [found[port][0].astype(np.float32) for port in self._model.outputs]
        return dict(zip(self._outputs, values, strict=True))


def make_runtime(weights: Path, settings: EmbeddingSettings, asked: FeatureRequest) -> Runtime:
    """The runtime that the settings name; "auto" prefers OpenVINO on a CPU where it is installed.

    Args:
        weights: the file of the network.
        settings: runtime, device and threads (0: as many as there are cores); OpenVINO runs on the CPU only.
        asked: which local features are wanted.

    Raises:
        WeightsError: the weights cannot be used.
        ConfigError: OpenVINO is wanted but not installed or not possible on the device.
    """
    count, outputs = settings.threads or len(os.sched_getaffinity(0)), outputs_of(asked)
    if _wants_openvino(settings):
        return OpenVinoRuntime(weights, count, outputs)
    from umf_ros.embedding.torch_runtimes import TorchRuntime
    from umf_ros.networks.weights import load_weights

    runtime = TorchRuntime(load_weights(weights), settings.device, count, outputs)
    warm_up(weights, lambda: runtime.run(blank_input(read_config(weights))))
    return runtime


class XFeatOpenVinoRuntime:
    """XFeat in OpenVINO, for images of any size that is a multiple of 32 pixels."""

    def __init__(self, weights: Path, threads: int) -> None:
        def make() -> Any:
            from umf_ros.embedding.torch_runtimes import converted_xfeat

            return converted_xfeat(weights)

        self._model = _compiled(kept_or_made(cached(weights), make), threads)
        warm_up(weights, lambda: self.run(XFEAT_BLANK))

    def run(self, image: Points) -> tuple[Points, Points, Points]:
        """See `XFeatRuntime`."""
        found = self._model([image[None, None]])
        descriptors, corners, reliability = (np.array(found[port][0]) for port in self._model.outputs)
        return descriptors, corners[0], reliability[0]


def make_xfeat_runtime(weights: Path, settings: EmbeddingSettings) -> XFeatRuntime:
    """What runs XFeat: the same runtime that runs the network of these settings.

    Raises:
        WeightsError: the weights cannot be used.
        ConfigError: as `make_runtime`.
    """
    if _wants_openvino(settings):
        return XFeatOpenVinoRuntime(weights, settings.threads or len(os.sched_getaffinity(0)))
    from umf_ros.embedding.torch_runtimes import XFeatTorchRuntime

    runtime = XFeatTorchRuntime(weights, settings.device)
    warm_up(weights, lambda: runtime.run(XFEAT_BLANK))
    return runtime


def warm_up(weights: Path, infer: Callable[[], object]) -> None:
    """Run the first inference in the thread that makes the runtime, before any other thread uses the library.

    OpenVINO's binding initialises itself at its first inference; two threads that do so at the same moment wait for
    each other for ever.

    Raises:
        WeightsError: the network cannot be run.
    """
    try:
        infer()
    except Exception as error:
        raise WeightsError(f"{weights} cannot be run: {one_line(error)}") from None


def _wants_openvino(settings: EmbeddingSettings) -> bool:
    installed, on_cpu = find_spec("openvino") is not None, settings.device == "cpu"
    if settings.runtime == "openvino" and not (installed and on_cpu):
        why = "it is not installed" if not installed else f"it does not run on {settings.device!r} here"
        raise ConfigError(f"embedding.runtime: cannot use openvino: {why}")
    return settings.runtime != "torch" and on_cpu and installed


def _compiled(model: Any, threads: int) -> Any:
    # single precision: half of it moves similarities by more than a threshold can bear
    options: dict[str, Any] = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": threads}
    options |= {"NUM_STREAMS": 1, "PERFORMANCE_HINT": "LATENCY"}
    return openvino_core().compile_model(model, "CPU", options)
