"""Sequences of real recordings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array
from umf_ros.lab.datasets.sample import Sample

DETOUR_M = 60.0
"""What lies less than this back along the way is no revisit."""
BASELINE_M = 1.0
"""Way before and after a place that says where the rover was heading."""


class RecordedSequence:
    """Samples of a recording; a `SampleSequence`.

    Args:
        name: unique.
        place: sequences of one place share its coordinates.
        world_T_body: (N, 4, 4).
        pass_index: (N,), of one drive: `detours`.
        load: makes the sample at an index.
    """

    setting = "real"

    def __init__(
        self, name: str, place: str, world_T_body: Array, pass_index: NDArray, load: Callable[[int], Sample]
    ) -> None:
        self.name, self.place = name, place
        self.world_T_body, self.pass_index = world_T_body, pass_index
        self._load = load

    def __len__(self) -> int:
        return len(self.world_T_body)

    def sample(self, index: int) -> Sample:
        """The sample at `index`."""
        return self._load(index)


def path_length(positions: Array) -> Array:
    """(N,) metres along the path of (N, 3) positions."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])


def detours(positions: Array) -> Array:
    """(N,) passes of one drive through (N, 3) positions: a detour later it is the next one."""
    return path_length(positions) / DETOUR_M


def course(positions: Array) -> Array:
    """(N, 3, 3) level rotations of a rover that drives forward through (N, 3) positions.

    The heading is that of the chord from a metre before to a metre after; a rover that stands keeps
    its last one.
    """
    way = path_length(positions)
    reach = [
        np.stack([np.interp(way + side, way, positions[:, axis]) for axis in (0, 1)], 1)
        for side in (-BASELINE_M, BASELINE_M)
    ]
    chord = reach[1] - reach[0]
    heading = np.arctan2(chord[:, 1], chord[:, 0])
    moving = np.linalg.norm(chord, axis=1) > 1e-3
    last = np.maximum.accumulate(np.where(moving, np.arange(len(way)), 0))
    return Rotation.from_euler("z", heading[last][:, None]).as_matrix()


def poses_of(rotations: Array, positions: Array) -> Array:
    """(N, 4, 4) poses."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, positions
    return poses
