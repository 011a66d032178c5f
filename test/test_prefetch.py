from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import make_frame, unit

from umf_ros.core.config import KeyframePolicy, Settings, load_settings
from umf_ros.core.frames import Embedding, Frame
from umf_ros.core.geometry import make_pose
from umf_ros.detector import LoopDetector
from umf_ros.sensors.decode import OdometrySample

Item = Frame | OdometrySample
POLICY = KeyframePolicy(min_translation_m=0.5)


def drive(count: int) -> list[Item]:
    """Frames 0.3 m apart, of two sessions, each after its odometry."""
    items: list[Item] = []
    for i in range(count):
        pose = make_pose(np.eye(3), [0.3 * i, 0, 0])
        items += [OdometrySample(i * 10**9, pose), make_frame(i, pose, session=int(i >= count // 2))]
    return items


class Slow:
    """An embedder that waits for leave, and notes what it is given and in which thread."""

    name, dimension = "slow", 8

    def __init__(self) -> None:
        self.leave = threading.Semaphore(0)
        self.seen: list[tuple[int, str]] = []

    def embed(self, frame: Frame) -> Embedding:
        assert self.leave.acquire(timeout=10)
        self.seen.append((frame.stamp_ns, threading.current_thread().name))
        return Embedding(unit(np.eye(8)[frame.stamp_ns // 10**9 % 8]))


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return load_settings().model_copy(update={"keyframe": POLICY})


def test_the_stream_is_handed_on_unchanged_and_each_keyframe_is_embedded_once(settings: Settings) -> None:
    items, slow = drive(12), Slow()
    slow.leave.release(100)
    detector = LoopDetector(settings, slow)
    handed = list(detector.prefetch(items))
    assert [id(one) for one in handed] == [id(one) for one in items]
    deadline = time.monotonic() + 10.0
    while len(slow.seen) < 6 and time.monotonic() < deadline:
        time.sleep(0.01)
    detector.close()
    # 0.6 m apart, and the second session begins with a keyframe of its own
    assert [stamp // 10**9 for stamp, _ in slow.seen] == [0, 2, 4, 6, 8, 10]


def test_a_stream_without_keyframes_comes_through(settings: Settings) -> None:
    samples = [one for one in drive(4) if isinstance(one, OdometrySample)]
    detector = LoopDetector(settings, Slow())
    assert list(detector.prefetch(samples)) == samples
    detector.close()


def test_prefetched_keyframes_are_those_of_a_stream_without_prefetching(settings: Settings) -> None:
    kept = []
    for ahead in (True, False):
        slow = Slow()
        slow.leave.release(100)
        detector = LoopDetector(settings, slow)
        stream = detector.prefetch(drive(12)) if ahead else drive(12)
        found = [detector.process(item) for item in stream if isinstance(item, Frame)]
        detector.close()
        kept.append([one.keyframe for one in found if one.keyframe is not None])
        assert [stamp for stamp, _ in slow.seen] == [one.stamp_ns for one in kept[-1]]
        assert all(name.startswith("embedding") for _, name in slow.seen)  # one thread at a time uses a network
    for prefetched, plain in zip(*kept, strict=True):
        assert (prefetched.stamp_ns, prefetched.session) == (plain.stamp_ns, plain.session)
        assert prefetched.path_length_m == plain.path_length_m
        assert (prefetched.embedding.descriptor == plain.embedding.descriptor).all()


def test_the_next_keyframe_is_embedded_while_its_predecessor_is_processed(settings: Settings) -> None:
    slow = Slow()
    detector = LoopDetector(settings, slow)
    stream = detector.prefetch(make_frame(i, make_pose(np.eye(3), [i, 0, 0])) for i in range(2))
    slow.leave.release(1)
    assert detector.process(next(stream)).keyframe is not None  # does not wait for the second
    slow.leave.release(1)
    assert detector.process(next(stream)).latency_ms["embed"] >= 0
    detector.close()


def test_frames_that_were_prefetched_and_never_processed_are_skipped(settings: Settings) -> None:
    slow = Slow()
    slow.leave.release(9)
    detector = LoopDetector(settings, slow)
    frames = [make_frame(i, make_pose(np.eye(3), [i, 0, 0])) for i in range(3)]
    stream = detector.prefetch(frames)
    next(stream)
    second = next(stream)
    found = detector.process(second).keyframe
    assert found is not None and (found.embedding.descriptor == unit(np.eye(8)[1])).all()
    assert detector.process(next(stream)).keyframe is not None
    detector.close()


def test_nothing_is_embedded_ahead_while_that_is_not_wanted(settings: Settings) -> None:
    slow = Slow()
    detector = LoopDetector(settings, slow)
    assert len(list(detector.prefetch(drive(12), lambda: False))) == 24
    assert slow.seen == []
    detector.close()


def test_an_error_of_the_network_is_raised_for_its_frame(settings: Settings) -> None:
    class Broken(Slow):
        def embed(self, frame: Frame) -> Embedding:
            raise RuntimeError("no such weights")

    detector = LoopDetector(settings, Broken())
    frames = list(detector.prefetch([make_frame(0, np.eye(4))]))
    with pytest.raises(RuntimeError, match="no such weights"):
        detector.process(frames[0])
    detector.close()
