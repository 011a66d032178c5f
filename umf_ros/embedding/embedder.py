"""Protocol of an embedder."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from umf_ros.core.frames import Embedding, Frame


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
