"""What a weights file says of itself, read without torch."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import safe_open

from umf_ros.core.errors import WeightsError, one_line, shortened
from umf_ros.core.resources import find
from umf_ros.networks.config import NetworkConfig

SHIPPED = ("umf_scene", "umf_light")
DEFAULT = "umf_scene"


def locate_weights(weights: Path | None) -> Path:
    """A weights file: as given, one of the shipped by its name, or for None the shipped default."""
    name = DEFAULT if weights is None else str(weights)
    return find(f"models/{name}.safetensors") if name in SHIPPED else Path(name)


def read_config(path: Path) -> NetworkConfig:
    """The sizes of the network of a weights file.

    Raises:
        WeightsError: missing, truncated or foreign file, or of another architecture.
    """
    with open_weights(path, "numpy") as stream:
        return NetworkConfig.from_dict(parse_architecture(path, stream))


@contextmanager
def open_weights(path: Path, framework: str) -> Iterator[Any]:
    """An open weights file; whatever goes wrong while it is read is a `WeightsError`."""
    try:
        if not path.is_file():
            raise WeightsError(f"weights {shortened(path)} do not exist")
        with safe_open(path, framework=framework) as stream:
            yield stream
    except WeightsError:
        raise
    except Exception as error:  # shapes that do not fit, sizes that nobody has memory for
        raise WeightsError(f"{shortened(path)} is truncated or not a safetensors file: {one_line(error)}") from None


def parse_architecture(path: Path, stream: Any) -> dict[str, Any]:
    """What an open weights file states of its network.

    Raises:
        WeightsError: it states nothing, or nothing that can be read.
    """
    metadata = stream.metadata() or {}
    if "architecture" not in metadata:
        raise WeightsError(f"{path} holds weights of another architecture: it does not say which")
    try:
        return dict(json.loads(metadata["architecture"]))
    except (TypeError, ValueError, RecursionError):
        raise WeightsError(f"{path} holds weights of another architecture: it does not say which clearly") from None
