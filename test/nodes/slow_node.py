"""Nodes on a slow machine, for the tests of their end: `detect` takes a second per frame, `open` a minute to start."""

from __future__ import annotations

import sys
import time

from umf_ros.core.frames import Frame
from umf_ros.nodes.loop_closure_node import LoopClosureNode
from umf_ros.nodes.pose_graph_node import PoseGraphNode
from umf_ros.nodes.process import leave, run


class SlowDetection(LoopClosureNode):
    def _detect(self, frame: Frame) -> None:
        time.sleep(1.0)
        super()._detect(frame)


class SlowStart(PoseGraphNode):
    def _open(self) -> None:
        super()._open()
        print("opening", flush=True)
        for _ in range(600):
            time.sleep(0.1)


if __name__ == "__main__":
    _, kind, *arguments = sys.argv
    leave(run(SlowDetection if kind == "detect" else SlowStart, arguments))
