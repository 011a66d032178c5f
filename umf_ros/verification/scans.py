"""Scans made ready for comparison, kept while they are likely to be needed again."""

from __future__ import annotations

from collections import OrderedDict
from functools import cached_property

from umf_ros.frames import Keyframe, Points
from umf_ros.verification.registration import Surface
from umf_ros.verification.terrain import TerrainMap


class Scan:
    """One keyframe's scan: its relief map for the search, its surface for the alignment."""

    def __init__(self, points: Points) -> None:
        self._points = points

    @cached_property
    def terrain(self) -> TerrainMap:
        """The relief map."""
        return TerrainMap(self._points)

    @cached_property
    def surface(self) -> Surface:
        """Points, normals and search tree."""
        return Surface(self._points)


class ScanCache:
    """The most recently used scans; a cache, so it changes no result."""

    def __init__(self, capacity: int = 60) -> None:
        self._capacity = capacity
        self._scans: OrderedDict[tuple[int, int], Scan] = OrderedDict()

    def __getitem__(self, keyframe: Keyframe) -> Scan:
        key = (keyframe.session, keyframe.stamp_ns)
        scan = self._scans.pop(key, None) or Scan(keyframe.points)
        self._scans[key] = scan
        if len(self._scans) > self._capacity:
            self._scans.popitem(last=False)
        return scan

    def clear(self) -> None:
        """Forget all scans, as when stamps start over."""
        self._scans.clear()
