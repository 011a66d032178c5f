"""What an embedder is."""

from __future__ import annotations

from typing import Protocol

from umf_ros.frames import Embedding, Frame


class Embedder(Protocol):
    """Turns a frame into a global descriptor and local features."""

    name: str
    dimension: int

    def embed(self, frame: Frame) -> Embedding:
        """Embed one frame; either modality may be missing. Deterministic for one thread count."""
        ...
