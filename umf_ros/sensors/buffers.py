"""Bounded memories of the inputs."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Image
from umf_ros.core.geometry import Array, interpolate

SURPLUS = "surplus"
"""Reason of images that lie nearest to no scan: no fault, cameras are faster than LiDARs."""


@dataclass(slots=True)
class InputCounter:
    """Messages of one input: `received == used + sum(dropped) + waiting` at any time; dropped ones by reason."""

    received: int = 0
    used: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def waiting(self) -> int:
        """Messages whose fate is open."""
        return self.received - self.used - self.dropped.total()

    @property
    def lost(self) -> int:
        """Messages dropped for a reason that should not happen."""
        return self.dropped.total() - self.dropped[SURPLUS]


@dataclass(slots=True)
class StampedImage:
    """An image (H, W) uint8, its exposure, and whether it came too late for its scan, or is used in a frame."""

    stamp_ns: int
    image: Image
    late: bool = False
    used: bool = False


class ImageBuffer:
    """The latest images of one camera, in the order of their stamps."""

    def __init__(self, size: int, counter: InputCounter) -> None:
        self._size = size
        self._counter = counter
        self._images: deque[StampedImage] = deque()
        self.newest_ns: int | None = None

    def add(self, stamp_ns: int, image: Image, late: bool = False) -> None:
        """Append an image; the oldest leaves a full buffer."""
        if len(self._images) == self._size:
            self._forget("queue full")
        self._images.append(StampedImage(stamp_ns, image, late))
        self.newest_ns = stamp_ns

    def passed(self, stamp_ns: int) -> bool:
        """Whether no image to come can be nearer to the stamp than those that came."""
        return self.newest_ns is not None and self.newest_ns >= stamp_ns

    def nearest(self, stamp_ns: int, slop_ns: int) -> StampedImage | None:
        """The image nearest to a stamp, or None when it is further than the slop; the earlier of two equals."""
        nearest = min(self._images, key=lambda image: abs(image.stamp_ns - stamp_ns), default=None)
        return nearest if nearest and abs(nearest.stamp_ns - stamp_ns) <= slop_ns else None

    def use(self, image: StampedImage | None) -> None:
        """Count an image as used, the first time."""
        if image is not None and not image.used:
            image.used = True
            self._counter.used += 1

    def forget_before(self, stamp_ns: int) -> None:
        """Let go of older images."""
        while self._images and self._images[0].stamp_ns < stamp_ns:
            self._forget(SURPLUS)

    def clear(self) -> None:
        """Let go of everything."""
        self.forget_before(2**63)
        self.newest_ns = None

    def _forget(self, reason: str) -> None:
        image = self._images.popleft()
        if not image.used:
            self._counter.dropped["late" if image.late else reason] += 1


class OdometryBuffer:
    """The poses of the odometry in the latest `length_ns`, interpolated across gaps up to `max_gap_ns`."""

    def __init__(self, length_ns: int, max_gap_ns: int) -> None:
        self._length_ns = length_ns
        self._max_gap_ns = max_gap_ns
        self._stamps: list[int] = []
        self._poses: list[Array] = []

    def add(self, stamp_ns: int, odom_T_body: Array) -> None:
        """Append a pose, later than all before."""
        self._stamps.append(stamp_ns)
        self._poses.append(odom_T_body)
        # lists are cut rarely and in bulk; bisection wants lists
        if self._stamps[0] < stamp_ns - 2 * self._length_ns:
            old = bisect_left(self._stamps, stamp_ns - self._length_ns)
            del self._stamps[:old], self._poses[:old]

    def passed(self, stamp_ns: int) -> bool:
        """Whether the odometry has reached a stamp."""
        return bool(self._stamps) and self._stamps[-1] >= stamp_ns

    def at(self, stamp_ns: int) -> Array | None:
        """`odom_T_body` at a stamp, or None outside of what is known."""
        after = bisect_left(self._stamps, stamp_ns)
        if after == len(self._stamps):
            return None
        if self._stamps[after] == stamp_ns:
            return self._poses[after]
        if after == 0:
            return None
        before_ns, after_ns = self._stamps[after - 1], self._stamps[after]
        if after_ns - before_ns > self._max_gap_ns:
            return None
        fraction = (stamp_ns - before_ns) / (after_ns - before_ns)
        return interpolate(self._poses[after - 1], self._poses[after], fraction)

    def path(self, start_ns: int, end_ns: int) -> tuple[NDArray[np.int64], list[Array]]:
        """Stamps and poses from start to end, both interpolated, as far as they are known."""
        first, last = bisect_left(self._stamps, start_ns), bisect_left(self._stamps, end_ns)
        stamps = sorted({start_ns, *self._stamps[first:last], end_ns})
        known = [(stamp, pose) for stamp in stamps if (pose := self.at(stamp)) is not None]
        return np.array([stamp for stamp, _ in known], np.int64), [pose for _, pose in known]

    def samples(self, start_ns: int, end_ns: int) -> tuple[NDArray[np.int64], list[Array]]:
        """Stamps and poses from start to end as they came, no further back than the buffer's length before the end."""
        first = bisect_left(self._stamps, max(start_ns, end_ns - self._length_ns))
        last = bisect_right(self._stamps, end_ns)
        return np.array(self._stamps[first:last], np.int64), self._poses[first:last]

    def clear(self) -> None:
        """Forget everything."""
        self._stamps.clear()
        self._poses.clear()
