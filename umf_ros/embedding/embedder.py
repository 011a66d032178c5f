"""Protocol of an embedder."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from umf_ros.core.frames import Embedding, Frame, Points
from umf_ros.core.geometry import Array


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


def unit_descriptor(values: Array) -> Points:
    """Return the values at unit length, and the first axis for values of length zero."""
    norm = float(np.linalg.norm(values))
    if norm < 1e-6:
        return np.eye(1, len(values), dtype=np.float32)[0]
    return (values / norm).astype(np.float32)
