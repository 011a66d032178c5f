"""Parameters that change while the front-end is at work."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Thread

import numpy as np
import pytest
import rclpy
from rclpy.parameter import Parameter

from umf_ros.core.frames import Frame, StereoCamera
from umf_ros.nodes.loop_closure_node import LoopClosureNode


@pytest.fixture
def node() -> Iterator[LoopClosureNode]:
    rclpy.init(args=["--ros-args", "-p", "embedding.method:=solid", "-p", "dataset:=s3li-etna"])
    node = LoopClosureNode()
    yield node
    node.close()
    node.destroy_node()
    rclpy.try_shutdown()


def test_a_parameter_waits_for_no_keyframe_and_counts_from_the_next_one(node: LoopClosureNode) -> None:
    answers: list[bool] = []

    def change() -> None:
        answers.append(node.set_parameters([Parameter("loop.top_k", value=7)])[0].successful)

    with node._lock:  # as while a keyframe is verified
        changing = Thread(target=change, daemon=True)
        changing.start()
        changing.join(20.0)
        assert answers == [True]
    camera = StereoCamera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.2)
    points = np.random.default_rng(0).uniform(-9, 9, (300, 3)).astype(np.float32)
    node._detect(Frame(10**9, camera, np.eye(4), np.eye(4), points=points))
    assert node._detector._rules.top_k == 7 and len(node._detector.database) == 1
