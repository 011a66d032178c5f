"""From a frame to a descriptor and local features.

A new method is one file here, `NAME_embedder.py`, with a function `make` that gives an `Embedder`; it is then known
to `embedding.method`, to `--embedder` and to the evaluation. Its imports wait until it is asked for.
"""

from __future__ import annotations

import pkgutil
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from umf_ros.core.errors import ConfigError, either

if TYPE_CHECKING:
    from umf_ros.core.config import EmbeddingSettings
    from umf_ros.embedding.embedder import Embedder

SUFFIX = "_embedder"
DEFAULT = "umf"
OWN_FEATURES = "umf"


def find_methods() -> tuple[str, ...]:
    """Names of the methods that have a file here, the default first."""
    folders = [*__path__, str(Path(__file__).parents[1] / "baselines")]
    names = (module.name for module in pkgutil.iter_modules(folders) if module.name.endswith(SUFFIX))
    return tuple(sorted((name.removesuffix(SUFFIX) for name in names), key=lambda name: (name != DEFAULT, name)))


METHODS = find_methods()
CHOICES = either(METHODS)
"""For help texts."""


def make_embedder(settings: EmbeddingSettings, super_features: bool = False, features: str = OWN_FEATURES) -> Embedder:
    """The embedder that the settings name.

    Args:
        settings: method, weights, runtime, device and threads.
        super_features: whether the network's super-features are wanted too.
        features: local features of images: "umf", what the embedder gives itself, or "xfeat".

    Raises:
        ConfigError: unknown method or device.
        WeightsError: the weights cannot be used.
    """
    if settings.method not in METHODS:
        raise ConfigError(f"embedding.method: unknown method {settings.method!r}; known: {', '.join(METHODS)}")
    from umf_ros.embedding.embedder import FeatureRequest

    asked = FeatureRequest(image=features == OWN_FEATURES, supers=super_features)
    package = __name__ if settings.method == DEFAULT else "umf_ros.baselines"
    embedder: Embedder = import_module(f"{package}.{settings.method}{SUFFIX}").make(settings, asked)
    if asked.image:
        return embedder
    from umf_ros.embedding.image_features import with_xfeat

    return with_xfeat(embedder, settings)
