from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from conftest import make_frame, unit

from umf_ros.core.config import KeyframePolicy, Settings, load_settings
from umf_ros.core.frames import Embedding, Frame
from umf_ros.core.geometry import make_pose
from umf_ros.detector import LoopDetector
from umf_ros.prefetch import Item, one_ahead
from umf_ros.sensors.decode import OdometrySample

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


def test_the_stream_is_handed_on_as_it_was_and_each_keyframe_after_the_next_is_foreseen() -> None:
    items, prefetched, handed = drive(12), [], []
    for item in one_ahead(items, POLICY, lambda frame: prefetched.append(frame.stamp_ns)):
        handed.append(item)
        if isinstance(item, Frame) and item.stamp_ns in prefetched[:-1]:
            assert prefetched[prefetched.index(item.stamp_ns) + 1] > item.stamp_ns
        elif isinstance(item, Frame):  # only the last keyframe has none after it
            assert item.stamp_ns > prefetched[-2]
    assert [id(one) for one in handed] == [id(one) for one in items]
    # 0.6 m apart, and the second session begins with a keyframe of its own
    assert [stamp // 10**9 for stamp in prefetched] == [0, 2, 4, 6, 8, 10]


def test_a_stream_without_keyframes_comes_through() -> None:
    samples = [one for one in drive(4) if isinstance(one, OdometrySample)]
    assert list(one_ahead(samples, POLICY, pytest.fail)) == samples


def test_what_was_foreseen_is_embedded_once_and_the_keyframes_are_the_same(settings: Settings) -> None:
    kept = []
    for ahead in (True, False):
        slow = Slow()
        slow.leave.release(100)
        detector = LoopDetector(settings, slow)
        stream = one_ahead(drive(12), POLICY, detector.prefetch) if ahead else drive(12)
        found = [detector.process(item) for item in stream if isinstance(item, Frame)]
        detector.close()
        kept.append([one.keyframe for one in found if one.keyframe is not None])
        assert [stamp for stamp, _ in slow.seen] == [one.stamp_ns for one in kept[-1]]
        assert all(name.startswith("embedding") for _, name in slow.seen)  # a network is one thread's at a time
    for prefetched, plain in zip(*kept, strict=True):
        assert (prefetched.stamp_ns, prefetched.session) == (plain.stamp_ns, plain.session)
        assert prefetched.path_length_m == plain.path_length_m
        assert (prefetched.embedding.descriptor == plain.embedding.descriptor).all()


def test_the_next_keyframe_is_embedded_while_nobody_waits_for_it(settings: Settings) -> None:
    slow = Slow()
    detector = LoopDetector(settings, slow)
    first, second = (make_frame(i, make_pose(np.eye(3), [i, 0, 0])) for i in range(2))
    detector.prefetch(first)
    detector.prefetch(second)
    slow.leave.release(1)
    assert detector.process(first).keyframe is not None  # does not wait for the second
    slow.leave.release(1)
    assert detector.process(second).latency_ms["embed"] >= 0
    detector.close()


def test_frames_that_were_foreseen_and_never_came_are_passed_over(settings: Settings) -> None:
    slow = Slow()
    slow.leave.release(9)
    detector = LoopDetector(settings, slow)
    frames = [make_frame(i, make_pose(np.eye(3), [i, 0, 0])) for i in range(3)]
    detector.prefetch(frames[0])
    detector.prefetch(frames[1])
    found = detector.process(frames[1]).keyframe
    assert found is not None and (found.embedding.descriptor == unit(np.eye(8)[1])).all()
    assert detector.process(frames[2]).keyframe is not None
    detector.close()


def test_a_fault_of_the_network_reaches_whoever_asks_for_that_frame(settings: Settings) -> None:
    class Broken(Slow):
        def embed(self, frame: Frame) -> Embedding:
            raise RuntimeError("no such weights")

    detector = LoopDetector(settings, Broken())
    frame = make_frame(0, np.eye(4))
    detector.prefetch(frame)
    with pytest.raises(RuntimeError, match="no such weights"):
        detector.process(frame)
    detector.close()
