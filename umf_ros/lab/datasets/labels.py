"""What is the same place, and what is not [UMF 4.5.2, 5.1.2]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
