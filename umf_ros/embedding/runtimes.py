"""Inference runtimes: OpenVINO where a model lies beside the weights, torch otherwise; torch is imported when needed.

`umf export` writes the models. Nothing is converted or quantised here.
"""

from __future__ import annotations

import hashlib
import os
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError, WeightsError, reading
from umf_ros.core.limits import open_archive
from umf_ros.embedding import FeatureRequest
from umf_ros.embedding.inputs import blank_input
from umf_ros.networks.config import XFEAT_OUTPUTS, read_config

Arrays = Sequence[NDArray[Any]]
Outputs = dict[str, NDArray[np.float32]]
XFEAT_SHAPE = 1, 1, 384, 512
OUTPUTS = ("descriptor", "image_local", "image_saliency", "cloud_local", "cloud_saliency")
"""Distinct from the names of inputs: OpenVINO renames a tensor whose name is taken."""
SCENE_MAP = "scene_map"
"""Deepest map (C, H / 16, W / 16) of the scene descriptor's trunk, of a network that has one."""
SCAN_TOKENS = "scan_tokens"
"""Tokens (T, C) of the occupied cells of a scan, before the fusion and without their positions."""
SUPERS = ("super_image", "super_image_strength", "super_cloud", "super_cloud_strength")
MODEL_SUFFIX = ".openvino"
"""Suffix of the zip archive of `model.xml` and `model.bin` beside a weights file."""
FACTS = "umf_ros"
"""Section of a model's `rt_info`: `precision`, and `weights`, the SHA-256 of the weights it was made from."""

_LOADING = threading.Lock()


class OpenVinoRuntime:
    """OpenVINO on the CPU; layers that are not quantised run in single precision.

    Args:
        weights: the model lies beside this file.
        outputs: names of the outputs to compute.
        threads: number of CPU threads.

    Attributes:
        precision: "float32" or "int8".
        file: the outputs depend on its content.

    Raises:
        WeightsError: the model is damaged, or was made from other weights.
    """

    def __init__(self, weights: Path, outputs: tuple[str, ...], threads: int) -> None:
        path = weights.with_suffix(MODEL_SUFFIX)
        with reading(path, WeightsError, "is damaged"):
            with open_archive(path) as archive:
                model = openvino_core().read_model(archive.read("model.xml"), archive.read("model.bin"))
            _expose(model, {SCENE_MAP, SCAN_TOKENS} & set(outputs))
            self.precision, made_from = (model.get_rt_info([FACTS, name]).value for name in ("precision", "weights"))
        if made_from != hashlib.sha256(weights.read_bytes()).hexdigest():
            raise WeightsError(f"{path} was made from other weights; delete it, or make it again with umf export")
        for result in model.get_results():
            if result.input(0).get_source_output().get_names().isdisjoint(outputs):
                model.remove_result(result)
        self.file = weights if self.precision == "float32" else path
        # half precision changes similarities by more than a threshold tolerates
        options: dict[str, Any] = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": threads}
        # pinned threads of two networks share one core
        options |= {"NUM_STREAMS": 1, "PERFORMANCE_HINT": "LATENCY", "ENABLE_CPU_PINNING": False}
        self._model = openvino_core().compile_model(model, "CPU", options | _cache_options())

    def run(self, inputs: Arrays) -> Outputs:
        """Return the outputs of a batch of one by name, without the batch axis."""
        found = self._model(list(inputs))
        return {port.any_name: found[port][0].astype(np.float32) for port in self._model.outputs}


class TorchRuntime:
    """Torch, imported when it is used; half precision on a GPU, single precision on a CPU.

    Args:
        weights: file of the UMF network, or for `XFEAT_OUTPUTS` of XFeat.
        outputs: names of the outputs to compute.
        device: torch device.
        threads: number of CPU threads.

    Attributes:
        precision: "float32" or "float16".
        file: the outputs depend on its content.

    Raises:
        WeightsError: the weights cannot be used.
        ConfigError: torch is not installed, or does not support the device.
    """

    def __init__(self, weights: Path, outputs: tuple[str, ...], device: str, threads: int) -> None:
        try:
            import torch
        except ModuleNotFoundError:
            raise ConfigError(f"torch is not installed: {weights.name} needs pip install 'umf_ros[torch]'") from None

        from umf_ros.networks.umf import FlatUmf
        from umf_ros.networks.weights import load_weights
        from umf_ros.networks.xfeat import load_xfeat

        self.file, self._outputs, self._torch = weights, outputs, torch
        network = load_xfeat(weights) if outputs == XFEAT_OUTPUTS else FlatUmf(load_weights(weights), outputs)
        if device == "cpu":
            torch.set_num_threads(threads)
        try:
            self._device = torch.device(device)
            self._network = network.eval().to(self._device)
        except (RuntimeError, AssertionError) as error:
            raise ConfigError(f"embedding.device: cannot use {device!r}: {str(error).splitlines()[0]}") from None
        self.precision = "float32" if self._device.type == "cpu" else "float16"

    def run(self, inputs: Arrays) -> Outputs:
        """Return the outputs of a batch of one by name, without the batch axis."""
        half = self._torch.autocast(self._device.type, self._torch.float16, enabled=self.precision == "float16")
        with self._torch.inference_mode(), half:
            found = self._network(*(self._torch.from_numpy(array).to(self._device) for array in inputs))
        return {name: value[0].float().cpu().numpy() for name, value in zip(self._outputs, found, strict=True)}


Runtime = OpenVinoRuntime | TorchRuntime


def outputs_of(asked: FeatureRequest) -> tuple[str, ...]:
    """Return the names of the network outputs that are needed; the others are not computed."""
    own = tuple(name for name in OUTPUTS if asked.image or not name.startswith("image"))
    return own + (SUPERS if asked.supers else ())


def make_runtime(weights: Path, settings: EmbeddingSettings, outputs: tuple[str, ...]) -> Runtime:
    """Return the runtime of the UMF network, or for `XFEAT_OUTPUTS` of XFeat.

    XFeat reads images (1, 1, H, W) whose sides are multiples of 32 pixels. Its outputs are descriptors
    (64, H / 8, W / 8), corners (1, H, W), the probabilities of key points, and reliability (1, H / 8, W / 8).

    One thread loads at a time, up to the first inference. OpenVINO's binding initialises itself in that inference, and
    two threads that do so at once deadlock; while it reads a model it sets the locale of the process to C, and two
    threads that do so at once leave it there; an import during another one fails.

    Args:
        weights: safetensors file of the network.
        settings: runtime ("auto" prefers OpenVINO on a CPU), device and threads (0: half of the cores, for
            two networks run side by side).
        outputs: names of the outputs to compute.

    Raises:
        WeightsError: the weights or the model beside them cannot be used.
        ConfigError: OpenVINO is requested, but is not installed, has no model, or does not run on the device.
    """
    of_xfeat = outputs == XFEAT_OUTPUTS
    blank: Arrays = [np.zeros(XFEAT_SHAPE, np.float32)] if of_xfeat else blank_input(read_config(weights))
    threads = settings.threads or max(1, len(os.sched_getaffinity(0)) // 2)
    runtime: Runtime
    with _LOADING:
        if _wants_openvino(weights, settings):
            runtime = OpenVinoRuntime(weights, outputs, threads)
        else:
            runtime = TorchRuntime(weights, outputs, settings.device, threads)
        with reading(weights, WeightsError, "cannot be run"):
            runtime.run(blank)
    return runtime


def name_outputs(weights: Path, runtime: Runtime, preprocessing: bytes = b"") -> str:
    """Return a name of a runtime's outputs, which differs with the weights, the precision and the preprocessing."""
    mark = "" if runtime.precision == "float32" else f"-{runtime.precision}"
    return f"{weights.stem}{mark}-{hashlib.sha256(runtime.file.read_bytes() + preprocessing).hexdigest()[:8]}"


def import_openvino() -> Any:
    """Return the module OpenVINO without its telemetry, which starts a process and sends a message at every import.

    Its converter, most of the time of the import, is left out as well; `openvino.tools.ovc` can be imported afterwards.
    """
    for name in ("openvino.tools.ovc", "openvino_telemetry"):  # OpenVINO allows for their absence
        sys.modules.setdefault(name, None)  # type: ignore[arg-type]
    import openvino

    if sys.modules["openvino.tools.ovc"] is None:
        del sys.modules["openvino.tools.ovc"]
    return openvino


@cache
def openvino_core() -> Any:
    """Return OpenVINO's core: one for the whole process, never destroyed.

    Its CPU plugin installs a stack for signal handlers and removes it when it is unloaded; a process in which a second
    core was created and destroyed crashes at Ctrl-C.
    """
    return import_openvino().Core()


def _expose(model: Any, names: set[str]) -> None:
    """Make the scene map, and the tokens of the scan, outputs of a model that was exported without them."""
    for op in model.get_ops():
        pools = op.get_type_name() == "AdaptiveAvgPool"
        if pools or op.get_friendly_name().endswith(".cloud_tokens/aten::layer_norm/Add"):
            name, source = (SCENE_MAP, op.input_value(0)) if pools else (SCAN_TOKENS, op.output(0))
            if name in names and not any(name in port.get_names() for port in model.outputs):
                source.get_tensor().set_names({name})
                model.add_outputs(source)


def _cache_options() -> dict[str, str]:
    """Return OpenVINO's option to keep compiled models, if there is a folder for them; it ignores damaged ones."""
    with suppress(OSError, RuntimeError):  # RuntimeError: no home
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "umf_ros"
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return {"CACHE_DIR": str(folder)}
    return {}


def _wants_openvino(weights: Path, settings: EmbeddingSettings) -> bool:
    missing = {
        "it is not installed": find_spec("openvino") is None,
        f"it does not run on {settings.device!r} here": settings.device != "cpu",
        f"{weights.with_suffix(MODEL_SUFFIX).name} is not beside the weights; make it with umf export": (
            not weights.with_suffix(MODEL_SUFFIX).is_file()
        ),
    }
    why = next((reason for reason, found in missing.items() if found), None)
    if settings.runtime == "openvino" and why:
        raise ConfigError(f"embedding.runtime: cannot use openvino: {why}")
    return settings.runtime != "torch" and not why
