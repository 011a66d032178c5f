"""The network in OpenVINO's own format: for other programs, and so that a node starts faster."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from umf_ros.core.errors import OutputError

if TYPE_CHECKING:
    from torch import nn

FORMAT = 2
"""Of what is kept; another number makes all anew."""


def import_openvino() -> Any:
    """OpenVINO without its telemetry, which at every import starts a process that sends a message to its makers."""
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]  # absent: OpenVINO provides for that
    import openvino

    return openvino


def convert(flat: nn.Module, example: dict[str, Any]) -> Any:
    """OpenVINO model of a network with tensors for arguments, at the shapes of the example (by input name)."""
    model = import_openvino().convert_model(flat, example_input=tuple(example.values()))
    shapes = [tuple(tensor.shape) for tensor in example.values()]
    model.reshape(dict(zip(model.inputs, shapes, strict=True)))
    for port, name in zip(model.inputs, example, strict=True):
        port.get_tensor().set_names({name})
    return model


def save(model: Any, path: Path) -> None:
    """Write a model as `path` (.xml) and its weights beside it (.bin).

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
        raise OutputError(f"cannot write {path}: {' '.join(str(error).split())[:200]}") from None


@cache
def openvino_core() -> Any:
    """OpenVINO's core: one for the whole process, and never destroyed.

    Its CPU plugin gives the thread a stack for signals and takes it back when it is unloaded; whoever gets Ctrl-C
    after a second core came and went dies of it.
    """
    return import_openvino().Core()


def kept_or_made(path: Path, make: Callable[[], Any]) -> Any:
    """The model kept at `path`; where there is none, or a damaged one, a new one, which is then kept there."""
    if path.is_file():
        with suppress(RuntimeError):
            return openvino_core().read_model(path)
    model = make()
    with suppress(OutputError):  # a read-only home only costs time
        save(model, path)
    return model


def cached(weights: Path, outputs: tuple[str, ...] = ()) -> Path:
    """Where the converted model of a weights file is kept: another file for other outputs, weights or OpenVINO."""
    digest = hashlib.sha256(weights.read_bytes())
    digest.update(f"{import_openvino().__version__} {' '.join(outputs)} {FORMAT}".encode())
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "umf_ros" / f"{digest.hexdigest()[:20]}.xml"
