"""How long embedding takes and how large networks are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from landmarks import LandmarkEmbedder, frame_of

from umf_ros.frames import Embedding, Frame
from umf_ros.lab.evaluation import latency
from umf_ros.lab.evaluation.latency import WARM_UP, Cost, at_full_size, measure

FRAMES = [frame_of(stamp, 1) for stamp in range(5)]


class Timed(LandmarkEmbedder):
    """Takes as many seconds as it is told, by a clock of its own."""

    def __init__(self, seconds: Iterator[float]) -> None:
        self.now_s = 0.0
        self.stamps: list[int] = []
        self._seconds = seconds

    def perf_counter(self) -> float:
        return self.now_s

    def embed(self, frame: Frame) -> Embedding:
        self.stamps.append(frame.stamp_ns)
        self.now_s += next(self._seconds)
        return super().embed(frame)


def test_the_median_counts_and_warming_up_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    slow_start = [9.0] * WARM_UP
    embedder = Timed(iter([*slow_start, 0.010, 0.030, 0.020, 5.0, 0.015, 0.010, 0.030, 0.020, 0.040, 0.015]))
    monkeypatch.setattr(latency, "time", SimpleNamespace(perf_counter=embedder.perf_counter))
    # 10 10 15 15 20 20 30 30 40 5000 ms: between the fifth and the sixth
    assert measure(embedder, FRAMES, repeats=2) == pytest.approx(20.0)
    assert embedder.stamps == [0, 1, 2, 0, 1, 2, 3, 4, 0, 1, 2, 3, 4]


def test_size_and_ratio() -> None:
    cost = Cost("net", 3 * 2**18, eager_ms=80.0, fast_ms=20.0)
    assert cost.megabytes == 3.0 and cost.ratio == 0.25


def test_frames_are_timed_at_the_size_of_the_real_camera() -> None:
    frame = frame_of(7, 3)
    large = at_full_size(frame)
    assert large.left is not None and large.left.shape == (512, 688) and large.left.dtype == np.uint8
    assert (large.camera.width, large.camera.height) == (688, 512)
    assert large.points is frame.points and large.stamp_ns == 7
    blind = replace(frame, left=None)
    assert at_full_size(blind) is blind
