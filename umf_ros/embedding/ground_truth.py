"""An embedder that knows the true poses: the whole pipeline runs in tests without a network."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from umf_ros.errors import UmfError
from umf_ros.frames import Embedding, Frame
from umf_ros.geometry import Array, heading

NEAREST_NS = 100_000_000


class GroundTruthEmbedder:
    """Descriptors whose similarity falls with the distance of the poses and of their headings.

    Random Fourier features [Rahimi 2007] of position and heading approximate a Gaussian
    kernel: similarity is about exp(-d^2 / 2 scale^2) for equal headings, near zero for opposite ones.

    Args:
        poses: world_T_body by stamp in ns; a frame takes the nearest within 0.1 s.
        scale_m: distance at which similarity has fallen to 0.6.
        dimension: length of the descriptor.
        seed: of the random features.
    """

    name = "ground_truth"

    def __init__(self, poses: Mapping[int, Array], scale_m: float = 6.0, dimension: int = 512, seed: int = 0) -> None:
        self.dimension = dimension
        self._stamps = np.array(sorted(poses), np.int64)
        self._poses = [poses[int(stamp)] for stamp in self._stamps]
        rng = np.random.default_rng(seed)
        # a quarter turn counts as much as three times the scale
        self._frequencies = rng.normal(size=(5, dimension // 2)) / np.array([scale_m] * 3 + [0.47] * 2)[:, None]

    def embed(self, frame: Frame) -> Embedding:
        """The pose of the frame, as a descriptor without local features.

        Raises:
            UmfError: no pose is known near the frame's stamp.
        """
        pose = self._pose_at(frame.stamp_ns)
        angle = heading(pose)
        phase = np.concatenate([pose[:3, 3], [np.cos(angle), np.sin(angle)]]) @ self._frequencies
        code = np.concatenate([np.cos(phase), np.sin(phase)])
        return Embedding((code / np.linalg.norm(code)).astype(np.float32))

    def _pose_at(self, stamp_ns: int) -> Array:
        nearest = int(np.abs(self._stamps - stamp_ns).argmin()) if len(self._stamps) else -1
        if nearest < 0 or abs(int(self._stamps[nearest]) - stamp_ns) > NEAREST_NS:
            raise UmfError(f"no true pose within 0.1 s of the frame at {stamp_ns}")
        return self._poses[nearest]
