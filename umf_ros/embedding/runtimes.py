"""Inference runtimes: OpenVINO where it is installed, torch otherwise; torch is imported only when it is needed."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError, OutputError, WeightsError, one_line
from umf_ros.embedding.embedder import FeatureRequest
from umf_ros.embedding.inputs import blank_input
from umf_ros.networks.config import read_config

if TYPE_CHECKING:
    from torch import nn

Arrays = Sequence[NDArray[Any]]
XFEAT_SHAPE = 1, 1, 384, 512
XFEAT_BLANK = np.zeros(XFEAT_SHAPE, np.float32)
OUTPUTS = ("descriptor", "image", "image_saliency", "cloud", "cloud_saliency")
SUPERS = ("super_image", "super_image_strength", "super_cloud", "super_cloud_strength")
CACHE_FORMAT = 2
"""Version of the cached models; another number converts all of them again."""


class Runtime(Protocol):
    """Runs a network."""

    def run(self, inputs: Arrays) -> list[NDArray[np.float32]]:
        """Return the outputs of a batch of one, without the batch axis."""
        ...


class OpenVinoRuntime:
    """OpenVINO on the CPU, in single precision.

    Args:
        model: OpenVINO model.
        threads: number of CPU threads.
    """

    def __init__(self, model: Any, threads: int) -> None:
        # half precision changes similarities by more than a threshold tolerates
        options: dict[str, Any] = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": threads}
        options |= {"NUM_STREAMS": 1, "PERFORMANCE_HINT": "LATENCY"}
        self._model = openvino_core().compile_model(model, "CPU", options)

    def run(self, inputs: Arrays) -> list[NDArray[np.float32]]:
        """See `Runtime`."""
        found = self._model(list(inputs))
        return [found[port][0].astype(np.float32) for port in self._model.outputs]


def outputs_of(asked: FeatureRequest) -> tuple[str, ...]:
    """Return the names of the network outputs that are needed; the others are not computed."""
    own = tuple(name for name in OUTPUTS if asked.image or not name.startswith("image"))
    return own + (SUPERS if asked.supers else ())


def make_runtime(weights: Path, settings: EmbeddingSettings, asked: FeatureRequest) -> Runtime:
    """Return the runtime of the UMF network; its outputs are in the order of `outputs_of(asked)`.

    Args:
        weights: safetensors file of the network.
        settings: runtime ("auto" prefers OpenVINO on a CPU), device and threads (0: number of cores).
        asked: local features to compute.

    Raises:
        WeightsError: the weights cannot be used.
        ConfigError: OpenVINO is requested but not installed, or does not run on the device.
    """
    outputs = outputs_of(asked)

    def load() -> nn.Module:
        from umf_ros.embedding.torch_runtimes import load_flat

        return load_flat(weights, outputs)

    runtime = _make(weights, settings, outputs, load, lambda: convert_umf(weights, outputs))
    warm_up(weights, lambda: runtime.run(blank_input(read_config(weights))))
    return runtime


def make_xfeat_runtime(weights: Path, settings: EmbeddingSettings) -> Runtime:
    """Return the runtime of XFeat, for images (1, 1, H, W) whose sides are multiples of 32 pixels.

    Its outputs are descriptors (64, H / 8, W / 8), key points (1, H, W) and reliability (1, H / 8, W / 8).

    Raises:
        WeightsError: the weights cannot be used.
        ConfigError: as `make_runtime`.
    """

    def load() -> nn.Module:
        from umf_ros.networks.xfeat import load_xfeat

        return load_xfeat(weights)

    runtime = _make(weights, settings, (), load, lambda: _convert_xfeat(load()))
    warm_up(weights, lambda: runtime.run([XFEAT_BLANK]))
    return runtime


def warm_up(weights: Path, infer: Callable[[], object]) -> None:
    """Run the first inference in the thread that makes the runtime, before any other thread uses the library.

    OpenVINO's binding initialises itself at its first inference; two threads that do so at the same moment deadlock.

    Raises:
        WeightsError: the network cannot be run.
    """
    try:
        infer()
    except Exception as error:
        raise WeightsError(f"{weights} cannot be run: {one_line(error)}") from None


def import_openvino() -> Any:
    """Return the module OpenVINO without its telemetry, which starts a process and sends a message at every import."""
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]  # OpenVINO allows for its absence
    import openvino

    return openvino


@cache
def openvino_core() -> Any:
    """Return OpenVINO's core: one for the whole process, never destroyed.

    Its CPU plugin installs a stack for signal handlers and removes it when it is unloaded; a process in which a second
    core was created and destroyed crashes at Ctrl-C.
    """
    return import_openvino().Core()


def convert(network: nn.Module, example: dict[str, Any]) -> Any:
    """Return the OpenVINO model of a network, with named inputs of the shapes of the example tensors."""
    model = import_openvino().convert_model(network, example_input=tuple(example.values()))
    shapes = [tuple(tensor.shape) for tensor in example.values()]
    model.reshape(dict(zip(model.inputs, shapes, strict=True)))
    for port, name in zip(model.inputs, example, strict=True):
        port.get_tensor().set_names({name})
    return model


def convert_umf(weights: Path, outputs: tuple[str, ...]) -> Any:
    """Return the OpenVINO model of the UMF network with the given outputs.

    Raises:
        WeightsError: the weights cannot be used.
    """
    from umf_ros.embedding.torch_runtimes import load_flat, to_tensors

    return convert(load_flat(weights, outputs), to_tensors(blank_input(read_config(weights)))._asdict())


def _convert_xfeat(network: nn.Module) -> Any:
    import torch

    model = convert(network, {"image": torch.zeros(XFEAT_SHAPE)})
    model.reshape([1, 1, -1, -1])
    return model


def save_model(model: Any, path: Path) -> None:
    """Write an OpenVINO model as `path` (.xml) and its weights beside it (.bin).

    Raises:
        OutputError: the files cannot be written.
    """
    unfinished = path.with_name(f"{path.stem}.{os.getpid()}.xml")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        import_openvino().save_model(model, unfinished, compress_to_fp16=False)
        unfinished.with_suffix(".bin").replace(path.with_suffix(".bin"))
        unfinished.replace(path)
    except (OSError, RuntimeError) as error:
        raise OutputError(f"cannot write {path}: {one_line(error)}") from None


def load_or_convert(path: Path, make: Callable[[], Any]) -> Any:
    """Return the OpenVINO model at `path`; convert it and save it there if it is missing or damaged."""
    if path.is_file():
        with suppress(RuntimeError):
            return openvino_core().read_model(path)
    model = make()
    with suppress(OutputError):  # a read-only home directory only costs time
        save_model(model, path)
    return model


def cache_path(weights: Path, outputs: tuple[str, ...] = ()) -> Path:
    """Return the path of the cached model; it depends on the weights, the outputs and the version of OpenVINO."""
    digest = hashlib.sha256(weights.read_bytes())
    digest.update(f"{import_openvino().__version__} {' '.join(outputs)} {CACHE_FORMAT}".encode())
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "umf_ros" / f"{digest.hexdigest()[:20]}.xml"


def _make(
    weights: Path,
    settings: EmbeddingSettings,
    outputs: tuple[str, ...],
    load: Callable[[], nn.Module],
    convert_weights: Callable[[], Any],
) -> Runtime:
    threads = settings.threads or len(os.sched_getaffinity(0))
    if _wants_openvino(settings):
        return OpenVinoRuntime(load_or_convert(cache_path(weights, outputs), convert_weights), threads)
    from umf_ros.embedding.torch_runtimes import TorchRuntime

    return TorchRuntime(load(), settings.device, threads)


def _wants_openvino(settings: EmbeddingSettings) -> bool:
    installed, on_cpu = find_spec("openvino") is not None, settings.device == "cpu"
    if settings.runtime == "openvino" and not (installed and on_cpu):
        why = "it is not installed" if not installed else f"it does not run on {settings.device!r} here"
        raise ConfigError(f"embedding.runtime: cannot use openvino: {why}")
    return settings.runtime != "torch" and on_cpu and installed
