"""Samples of a data set and their labels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Image, Points, StereoCamera
from umf_ros.core.geometry import Array, heading, wrap_angle


@dataclass(frozen=True, slots=True)
class Rule:
    """Distances in metres, headings in degrees; what is neither positive nor negative is neutral.

    UMF takes every pair beyond 30 deg for different. Two views 40 deg apart still share half of
    their field, so in training the band up to `negative_deg` stays neutral. With `between_passes`, pairs
    of one pass are neutral too.
    """

    positive_m: float = 12.0
    positive_deg: float = 30.0
    negative_m: float = 60.0
    negative_deg: float = 60.0
    between_passes: bool = False


@dataclass(frozen=True, slots=True)
class Places:
    """Where a batch was taken.

    Attributes:
        world: (B,) int, places of different worlds are different.
        position: (B, 2) metres.
        heading: (B,) radians.
        passage: (B,) in which pass of its world; two passes differ by one at least.
    """

    world: NDArray[np.int64]
    position: Array
    heading: Array
    passage: Array


def places_of(world: int, world_T_body: Array, passage: NDArray | None = None) -> Places:
    """Places of (N, 4, 4) poses in one world; without `passage` (N,) they are of one pass."""
    count = len(world_T_body)
    passage = np.zeros(count) if passage is None else passage.astype(float)
    return Places(np.full(count, world), world_T_body[:, :2, 3], heading(world_T_body), passage)


def distances(a: Places, b: Places) -> tuple[Array, Array]:
    """(A, B) metres, infinite between worlds, and (A, B) radians between headings."""
    metres = np.linalg.norm(a.position[:, None] - b.position[None], axis=-1)
    metres = np.where(a.world[:, None] == b.world[None], metres, np.inf)
    return metres, np.abs(wrap_angle(a.heading[:, None] - b.heading[None]))


def label(a: Places, b: Places, rule: Rule) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(A, B) positive and (A, B) negative pairs."""
    metres, turn = distances(a, b)
    positive = (metres < rule.positive_m) & (turn < np.radians(rule.positive_deg))
    negative = (metres > rule.negative_m) | (turn > np.radians(rule.negative_deg))
    if rule.between_passes:
        apart = (a.world[:, None] != b.world[None]) | (np.abs(a.passage[:, None] - b.passage[None]) >= 1)
        positive, negative = positive & apart, negative & apart
    return positive, negative


@dataclass(frozen=True, slots=True)
class Sample:
    """An image, a scan and where they were taken.

    Attributes:
        image: (h, w) uint8, the whole view at any resolution and aspect, or None.
        points: (N, 3) float32 metres, body frame, or None.
        intensity: (N,) float32 in the sensor's unit, or None.
        world_T_body: true pose; None: heading unknown is not allowed in training.
        camera: intrinsics at the camera's full resolution.
        body_T_camera: pose of the camera in the body frame.
        depth: (h', w') float32 metres along the optical axis over the whole view, 0 where there is none, or None.
    """

    image: Image | None
    points: Points | None
    intensity: Points | None
    world_T_body: Array
    camera: StereoCamera
    body_T_camera: Array
    depth: Points | None = None


class SampleSequence(Protocol):
    """Samples of one place, in order of time.

    Attributes:
        name: for people, unique.
        place: sequences of one place share its coordinates and this name.
        world_T_body: (N, 4, 4) true poses.
        pass_index: (N,) which traverse of the place a sample belongs to, from 0; fractions count on along a
            drive without beginning or end. Two passes differ by one at least.
        setting: "easy", "hard" or "real".
    """

    name: str
    place: str
    world_T_body: Array
    pass_index: NDArray
    setting: str

    def __len__(self) -> int: ...

    def sample(self, index: int) -> Sample:
        """The sample at `index`."""
        ...
