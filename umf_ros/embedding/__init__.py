"""Embedders: from a frame to a descriptor and local features.

The registry finds methods by name. Other packages add methods through the entry point group `umf_ros.embedders`: an
entry point names a function `make(settings, asked)` that returns an `Embedder`. A method is imported when it is used.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, NamedTuple, Protocol

from umf_ros.core.errors import ConfigError, either

if TYPE_CHECKING:
    from umf_ros.core.config import EmbeddingSettings
    from umf_ros.core.frames import Embedding, Frame

GROUP = "umf_ros.embedders"
DEFAULT = "umf"
OWN_FEATURES = "umf"
_MODULES = {
    DEFAULT: "umf_ros.embedding.umf",
    **dict.fromkeys(("thumbnail", "gradients", "solid", "scan_context"), "umf_ros.baselines.handcrafted"),
    "dbow2": "umf_ros.baselines.dbow2",
    **dict.fromkeys(("lite0", "lite0_mean", "lite0_gem"), "umf_ros.baselines.lite0"),
    **dict.fromkeys(("netvlad", "pointnet2", "adafusion"), "umf_ros.baselines.place_networks"),
    **dict.fromkeys(("minkloc_visual", "minkloc_lidar", "minkloc_fusion"), "umf_ros.baselines.place_networks"),
}
"""Modules of the methods that come with the package, each with a function `make`."""
_READS = {
    **dict.fromkeys(("thumbnail", "gradients", "dbow2", "lite0", "lite0_mean", "lite0_gem"), "images"),
    **dict.fromkeys(("netvlad", "minkloc_visual"), "images"),
    **dict.fromkeys(("solid", "scan_context", "pointnet2", "minkloc_lidar"), "scans"),
}
"""Input of the methods that read one alone; without it all frames have one descriptor."""


class FeatureRequest(NamedTuple):
    """Requested local features; others are not computed.

    Attributes:
        image: local features of the image.
        supers: super-features.
    """

    image: bool = True
    supers: bool = False


class Embedder(Protocol):
    """Protocol of a method that turns a frame into a global descriptor and local features."""

    name: str
    dimension: int

    def embed(self, frame: Frame) -> Embedding:
        """Embed one frame; either modality may be missing. Deterministic for one thread count."""
        ...


@cache
def find_methods() -> tuple[str, ...]:
    """Return the names of all methods, the default first."""
    others = {*_MODULES, *entry_points(group=GROUP).names} - {DEFAULT}
    return DEFAULT, *sorted(others)


def choices() -> str:
    """Return the names of all methods as a choice, for help texts."""
    return either(find_methods())


def check_inputs(method: str, source: object, images: bool, scans: bool) -> None:
    """Raise a `ConfigError` if a source has no input that a method reads."""
    reads = _READS.get(method)
    if (reads == "images" and not images) or (reads == "scans" and not scans):
        raise ConfigError(f"the embedding method {method} reads {reads} alone, and {source} has none")


def make_embedder(settings: EmbeddingSettings, super_features: bool = False, features: str = OWN_FEATURES) -> Embedder:
    """Return the embedder that the settings name.

    Args:
        settings: method, weights, runtime, device and threads.
        super_features: compute the super-features of the network too.
        features: local features of images: "umf" (from the embedder itself) or "xfeat".

    Raises:
        ConfigError: unknown method or device, or an entry point that cannot be loaded.
        WeightsError: the weights cannot be used.
    """
    method = settings.method
    if method not in find_methods():
        raise ConfigError(f"embedding.method: unknown method {method!r}; known: {', '.join(find_methods())}")
    asked = FeatureRequest(image=features == OWN_FEATURES, supers=super_features)
    if method in _MODULES:
        make = import_module(_MODULES[method]).make
    else:
        try:
            make = entry_points(group=GROUP)[method].load()
        except (ImportError, AttributeError) as error:
            raise ConfigError(f"embedding.method {method}: its entry point cannot be loaded: {error}") from None
    embedder: Embedder = make(settings, asked)
    if asked.image:
        return embedder
    from umf_ros.embedding.local_features import WithXFeat

    return WithXFeat(embedder, settings)
