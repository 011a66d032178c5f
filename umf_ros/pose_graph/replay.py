"""A g2o file driven through the back-end as if it were live."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.config import PoseGraph as PoseGraphSettings
from umf_ros.frames import LoopClosure
from umf_ros.geometry import Array, gtsam_to_ros_covariance
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.condensed import Edge
from umf_ros.pose_graph.g2o import G2oGraph
from umf_ros.pose_graph.graph import PoseGraph

PERIOD_NS = 1_000_000_000
_MOST_SOLUTIONS = 150


@dataclass(frozen=True)
class Recording:
    """A graph file as odometry chains and loop closures; vertex number k gets the stamp of k seconds.

    Attributes:
        ids: (N,) vertex ids in the file, ascending.
        chains: first vertex number of every chain of consecutive ids that odometry joins.
        odometry: (N, 4, 4) poses composed from the odometry edges of each chain.
        steps: (N, 6, 6) covariance in GTSAM's order of the step that ends at a vertex; zero where a chain begins.
        closures: the other edges, from the earlier vertex number to the later, in order of the later.
    """

    ids: NDArray[np.int64]
    chains: list[int]
    odometry: Array
    steps: Array
    closures: list[Edge]

    def settings(self, settings: PoseGraphSettings) -> PoseGraphSettings:
        """The settings with every vertex a keyframe and no limit on a closure's length."""
        return settings.model_copy(update={"keyframe_spacing_m": 1e-6, "max_gap_s": 1.5, "max_closure_m": 1e7})

    def vertex_of(self, stamp_ns: int) -> int:
        """Id in the file of the vertex with a stamp."""
        return int(self.ids[stamp_ns // PERIOD_NS])

    def message(self, row: int) -> LoopClosure:
        """Closure `row` with stamps for keys."""
        edge = self.closures[row]
        covariance = gtsam_to_ros_covariance(edge.covariance, edge.pose)
        return LoopClosure(edge.second * PERIOD_NS, edge.first * PERIOD_NS, edge.pose, covariance)

    def step_covariance(self, vertex: int) -> Array | None:
        """Covariance of the odometry step that ends at a vertex in ROS order, None where a chain begins."""
        if vertex in self.chains:
            return None
        step = lie.invert(self.odometry[vertex - 1]) @ self.odometry[vertex]
        return gtsam_to_ros_covariance(self.steps[vertex], step)


def as_recording(content: G2oGraph) -> Recording:
    """Tell odometry from closures: the first edge between successive vertices is odometry."""
    used = {vertex for edge in content.edges for vertex in (edge.first, edge.second)}
    ids = np.array(sorted(used), np.int64)
    number = {int(vertex): k for k, vertex in enumerate(ids)}
    odometry: dict[int, Edge] = {}
    closures: list[Edge] = []
    for edge in content.edges:
        forward = _forward(edge, number)
        if forward.second == forward.first + 1 and forward.second not in odometry:
            odometry[forward.second] = forward
        else:
            closures.append(forward)
    chains = [k for k in range(len(ids)) if k not in odometry]
    poses, steps = np.tile(np.eye(4), (len(ids), 1, 1)), np.zeros((len(ids), 6, 6))
    for k, vertex in enumerate(ids.tolist()):
        if k in odometry:
            poses[k] = poses[k - 1] @ odometry[k].pose
            steps[k] = odometry[k].covariance
        else:
            poses[k] = content.poses.get(vertex, np.eye(4))
    closures.sort(key=lambda edge: (edge.second, edge.first))
    return Recording(ids, chains, poses, steps, closures)


def _forward(edge: Edge, number: dict[int, int]) -> Edge:
    first, second = number[edge.first], number[edge.second]
    if first < second:
        return Edge(first, second, edge.pose, edge.covariance)
    return Edge(second, first, lie.invert(edge.pose), lie.conjugate(lie.adjoint(edge.pose), edge.covariance))


def drive(graph: PoseGraph, recording: Recording) -> Iterator[int]:
    """Feed a recording to a graph in order of its vertices; yields the number of closures fed so far."""
    batch = max(1, len(recording.closures) // _MOST_SOLUTIONS)
    vertex = 0
    for start in range(0, len(recording.closures), batch):
        rows = range(start, min(start + batch, len(recording.closures)))
        vertex = _advance(graph, recording, vertex, recording.closures[rows[-1]].second + 1)
        graph.add_closures([recording.message(row) for row in rows])
        yield rows[-1] + 1
    _advance(graph, recording, vertex, len(recording.ids))
    graph.settle()


def _advance(graph: PoseGraph, recording: Recording, start: int, end: int) -> int:
    for vertex in range(start, end):
        if vertex and vertex in recording.chains:
            graph.begin_session()
        graph.add_odometry(vertex * PERIOD_NS, recording.odometry[vertex], recording.step_covariance(vertex))
    return max(start, end)
