"""Thinned scans keep the moments of their points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from conftest import make_frame

from umf_ros.core.frames import Frame, Points, ScanMotion
from umf_ros.verification import thin_frame, thin_scan


def frame_of(points: Points, motion: ScanMotion | None) -> Frame:
    return replace(make_frame(1.0), points=points, motion=motion)


def test_moments_are_thinned_with_their_points() -> None:
    points = np.array([[1.0, 1, 0], [1.01, 1, 0], [5, 5, 1], [90, 0, 0]], np.float32)
    motion = ScanMotion(np.array([0.0, 0.1, 0.2, 0.3], np.float32), np.ones(6), np.ones(6))
    thinned, kept = thin_frame(frame_of(points, motion))
    np.testing.assert_array_equal(thinned, thin_scan(points))
    assert kept is not None and np.allclose(np.sort(kept.moments_s), [0.05, 0.2])
    assert kept.noise is motion.noise and kept.moments_s.dtype == thinned.dtype == np.float32


def test_a_scan_of_unknown_motion_stays_so() -> None:
    thinned, motion = thin_frame(frame_of(np.ones((4, 3), np.float32), None))
    assert motion is None and thinned.shape == (1, 3)
