"""Protocol of an embedder."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from umf_ros.core.frames import Embedding, Frame


class FeatureRequest(NamedTuple):
    """Local features that an embedder is asked for; features that are not requested are not computed.

    Attributes:
        image: local features of the image.
        supers: super-features.
    """

    image: bool = True
    supers: bool = False


class Embedder(Protocol):
    """Turns a frame into a global descriptor and local features."""

    name: str
    dimension: int

    def embed(self, frame: Frame) -> Embedding:
        """Embed one frame; either modality may be missing. Deterministic for one thread count."""
        ...
