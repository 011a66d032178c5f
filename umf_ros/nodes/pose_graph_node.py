"""The live back-end: odometry and loop closures in, map pose and path out. Thin: every decision is the core's."""

from __future__ import annotations

import re
import sys
import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from umf_ros.bags.presets import topics_of
from umf_ros.errors import MessageError, UmfError
from umf_ros.geometry import Array
from umf_ros.nodes import pose_graph_messages as messages
from umf_ros.nodes.base_node import BaseNode
from umf_ros.nodes.conversions import closure_from_message
from umf_ros.nodes.diagnostics import OK, WARN, status
from umf_ros.nodes.process import run
from umf_ros.nodes.qos import CLOSURES_QOS, LATCHED_QOS, sensor_qos
from umf_ros.nodes.worker import Worker
from umf_ros.pose_graph.closures import ClosureVerdict, State
from umf_ros.pose_graph.pose_graph import PoseGraph
from umf_ros.sensors.messages import OdometrySample, decode_odometry
from umf_ros.sensors.odometry_feed import OdometryFeed

ODOMETRY_DEPTH = 200
# minutes of fast odometry: nothing is lost while the optimiser works
QUEUE = 100_000
REJECT = re.compile(r"\s*keyframe/(\d+)\s+keyframe/(\d+)\s*")


class PoseGraphNode(BaseNode):
    """Keeps a pose graph in a thread of its own and publishes the pose in the map at the odometry's rate."""

    def __init__(self) -> None:
        super().__init__("pose_graph_node", "folder for trajectories, graph and verdicts; empty: none")
        self._frames = self._settings.frames
        self._lock = threading.Lock()
        self._begin()
        self._make_publishers()
        self._worker: Worker[Callable[[], None]] = Worker(self._run, self._complain, QUEUE)
        odometry_topic = topics_of(self._settings).odometry
        if odometry_topic:
            qos = sensor_qos(self._settings.qos, ODOMETRY_DEPTH)
            self._subscribe("odometry", Odometry, odometry_topic, self._guarded(self._on_odometry), qos)
        self._subscribe("closures", Odometry, "/loop_closures", self._guarded(self._on_closure), CLOSURES_QOS)
        self.create_subscription(String, "~/reject_edge", self._guarded(self._on_reject), 10)
        self._offer(Trigger, "~/reject_last", self._reject_last)
        self._offer(Trigger, "~/save", self._save)
        self._offer(Trigger, "~/reset", self._reset)
        self.create_timer(1.0, self._tick)
        self.get_logger().info("ready")

    def close(self) -> None:
        """Take in what is queued, settle the graph and write the results."""
        self._worker.close(timeout_s=60.0)
        if self._results:
            self._graph.write_results(self._results)

    def _guarded(self, take: Callable[[Any], None]) -> Callable[[Any], None]:
        """`take`, with messages that cannot be used counted and the first of each kind told."""

        def receive(message: Any) -> None:
            try:
                take(message)
            except MessageError as error:
                self._refused[error.kind] += 1
                if self._refused[error.kind] == 1:
                    self.get_logger().warning(f"skipped: {error}")

        return receive

    def _begin(self) -> None:
        self._graph = PoseGraph(self._settings.pose_graph)
        self._feed = OdometryFeed(self._graph)
        self._refused: Counter[str] = Counter()
        self._map_T_odom: Array = np.eye(4)
        self._covariance: Array = np.zeros((6, 6))
        self._drawn = -1

    def _make_publishers(self) -> None:
        self._path_publisher = self.create_publisher(PathMessage, "~/path", LATCHED_QOS)
        self._pose_publisher = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 50)
        self._marker_publisher = self.create_publisher(MarkerArray, "~/markers", LATCHED_QOS)
        self._verdict_publisher = self.create_publisher(DiagnosticArray, "~/verdicts", CLOSURES_QOS)
        self._transform_publisher = self.create_publisher(TransformStamped, "~/map_to_odom", 50)
        self._broadcast = _broadcaster(self) if self._frames.publish_tf else None

    def _on_odometry(self, message: Odometry) -> None:
        sample = decode_odometry(message)
        self._worker.submit(lambda: self._add_odometry(sample))
        # the newest correction, not the next: the pose never waits for the optimiser
        map_T_odom = self._map_T_odom
        pose = messages.pose(sample.stamp_ns, map_T_odom @ sample.odom_T_body, self._covariance, self._frames)
        self._pose_publisher.publish(pose)
        transform = messages.transform(sample.stamp_ns, map_T_odom, self._frames)
        self._transform_publisher.publish(transform)
        if self._broadcast is not None:
            self._broadcast(transform)

    def _on_closure(self, message: Odometry) -> None:
        closure = closure_from_message(message)
        self._worker.submit(lambda: self._announce(self._graph.add_closure(closure)))

    def _on_reject(self, message: String) -> None:
        found = REJECT.fullmatch(message.data)
        if found is None:
            text = f"'{message.data}' on ~/reject_edge, expected 'keyframe/<match ns> keyframe/<query ns>'"
            raise MessageError("reject_edge", text)
        match, query = int(found[1]), int(found[2])
        self._worker.submit(lambda: self._announce(self._graph.revoke(match, query)))

    def _run(self, step: Callable[[], None]) -> None:
        with self._lock:
            step()

    def _add_odometry(self, sample: OdometrySample) -> None:
        reset = self._feed.take(sample.stamp_ns, sample.odom_T_body)
        if reset is not None:
            self.get_logger().warning(f"{reset.reason}: a new session begins")

    def _announce(self, verdicts: list[ClosureVerdict]) -> None:
        if not verdicts:
            return
        self._correct()
        for verdict in verdicts:
            # a verdict may change until the graph is settled: only what is refused is so for good
            final = verdict.state is State.REFUSED
            log = self.get_logger().info if final else self.get_logger().debug
            log(describe(verdict))
        report = DiagnosticArray(status=[_as_status(verdict) for verdict in verdicts])
        report.header.stamp = self.get_clock().now().to_msg()
        self._verdict_publisher.publish(report)
        self._draw()

    def _correct(self) -> None:
        self._map_T_odom = self._graph.map_T_odom()
        self._covariance = self._graph.covariance()

    def _draw(self) -> None:
        stamps, poses = self._graph.trajectory()
        self._drawn = len(stamps)
        self._path_publisher.publish(messages.path(stamps, poses, self._frames))
        verdicts, lines = self._graph.closure_lines()
        self._marker_publisher.publish(messages.markers(verdicts, lines, max(self._feed.newest_ns, 0), self._frames))

    def _tick(self) -> None:
        self._worker.submit(self._keep_up)
        self._diagnose(self._own_status())

    def _keep_up(self) -> None:
        """Decide about closures that waited for odometry, and show what has grown."""
        self._announce(self._graph.update())
        self._correct()
        if len(self._graph.trajectory()[0]) != self._drawn:
            self._draw()

    def _own_status(self) -> DiagnosticStatus:
        values: dict[str, object] = {**self._graph.counts, **self._refused, "queue_dropped": self._worker.dropped}
        values["odometry_out_of_line"] = self._feed.dropped
        values |= {state.value: count for state, count in self._graph.verdict_counts().items()}
        trouble = self._worker.dropped or any(name.startswith("optimiser") for name in self._graph.counts)
        level = WARN if trouble or self._refused else OK
        return status(level, "pose graph", f"{values.get('accepted', 0)} closures accepted", values)

    def _reject_last(self, _: Any) -> str:
        with self._lock:
            accepted = [v.closure for v in self._graph.closures() if v.state is State.ACCEPTED]
            if not accepted:
                raise UmfError("no closure is accepted")
            self._announce(self._graph.revoke(accepted[-1].match_stamp_ns, accepted[-1].query_stamp_ns))
        return f"closure {_name(accepted[-1])} revoked"

    def _save(self, _: Any) -> str:
        folder = self._results or "pose_graph_results"
        self._worker.drain(10.0)
        with self._lock:
            self._graph.write_results(folder)
        return f"results written to {folder}"

    def _reset(self, _: Any) -> str:
        with self._lock:
            self._begin()
        return "graph forgotten"


def describe(verdict: ClosureVerdict) -> str:
    """One line about a verdict for a person."""
    numbers = "" if np.isnan(verdict.residual) else f" ({verdict.residual:.1f} sigma, {verdict.residual_m:.2f} m)"
    seconds = (verdict.closure.query_stamp_ns - verdict.closure.match_stamp_ns) * 1e-9
    return f"graph: closure {seconds:.1f} s back {verdict.state.value}: {verdict.reason}{numbers}"


def _as_status(verdict: ClosureVerdict) -> DiagnosticStatus:
    level = OK if verdict.state is State.ACCEPTED else WARN
    values = {"verdict": verdict.state.value, "mahalanobis": verdict.residual, "misfit_m": verdict.residual_m}
    return status(level, _name(verdict.closure), verdict.reason, values)


def _name(closure: Any) -> str:
    return f"keyframe/{closure.match_stamp_ns} keyframe/{closure.query_stamp_ns}"


def _broadcaster(node: Node) -> Callable[[TransformStamped], None] | None:
    try:
        from tf2_ros import TransformBroadcaster
    except ImportError:
        node.get_logger().warning("tf2_ros is not installed: map -> odom goes out on ~/map_to_odom only")
        return None
    return TransformBroadcaster(node).sendTransform


def main() -> None:
    """Entry point of `ros2 run umf_ros pose_graph_node`."""
    sys.exit(run(PoseGraphNode))


if __name__ == "__main__":
    main()
