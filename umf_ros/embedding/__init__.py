"""From a frame to a descriptor and local features."""

from __future__ import annotations

from typing import TYPE_CHECKING

from umf_ros.errors import ConfigError

if TYPE_CHECKING:
    from umf_ros.config import Embedding
    from umf_ros.embedding.embedder import Embedder

METHODS = ("umf", "thumbnail", "scan_context")
PUBLISHED = ("lite0-cells", "lite0-mean")
"""Methods that need published weights (`embedding.weights`)."""


def make_embedder(settings: Embedding, super_features: bool = False) -> Embedder:
    """The embedder that the settings name.

    Args:
        settings: method, weights, runtime, device and threads.
        super_features: whether the network's super-features are wanted too.

    Raises:
        ConfigError: unknown method or device.
        WeightsError: the weights cannot be used.
    """
    if settings.method == "umf":
        from pathlib import Path

        from umf_ros.embedding.umf_embedder import UmfEmbedder

        weights = Path(settings.weights) if settings.weights else None
        return UmfEmbedder(weights, settings.runtime, settings.device, settings.threads, super_features)
    if settings.method in METHODS:
        from umf_ros.embedding.baselines import ScanContextEmbedder, ThumbnailEmbedder

        return ThumbnailEmbedder() if settings.method == "thumbnail" else ScanContextEmbedder()
    if settings.method in PUBLISHED:
        return _published(settings)
    raise ConfigError(
        f"embedding.method: unknown method {settings.method!r}; known: {', '.join((*METHODS, *PUBLISHED))}"
    )


def _published(settings: Embedding) -> Embedder:
    from pathlib import Path

    from umf_ros.embedding.lite0 import Lite0Embedder

    if not settings.weights:
        raise ConfigError(f"embedding.method {settings.method}: embedding.weights must name the published weights")
    return Lite0Embedder(Path(settings.weights), "mean" if settings.method == "lite0-mean" else "cells")
