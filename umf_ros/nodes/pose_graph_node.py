"""The live back-end: odometry and loop closures in, map pose and path out. All decisions are the core's."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from diagnostic_msgs.srv import AddDiagnostics
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from lifecycle_msgs.msg import TransitionEvent
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from umf_ros.absolute.measurement import AbsoluteDecoder, Aid
from umf_ros.core import watchdog
from umf_ros.core.config import Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import LoopClosure
from umf_ros.graph_process import JOURNAL, ProcessEndedError, start_graph
from umf_ros.map_poses import InitialPose, MapPoses
from umf_ros.nodes import conversions as messages
from umf_ros.nodes.base_node import ODOMETRY_DEPTH, BaseNode
from umf_ros.nodes.conversions import CLOSURES_QOS, LATCHED_QOS, parse_pair
from umf_ros.nodes.diagnostics import OK, TOO_SLOW, WARN, status
from umf_ros.nodes.process import Worker, leave, run
from umf_ros.pose_graph.closures import ClosureVerdict, State
from umf_ros.runs.run_file import GraphInput
from umf_ros.sensors.calibration import Calibration, calibration_of
from umf_ros.sensors.decode import OdometrySample, stamp_ns
from umf_ros.sensors.sessions import ODOMETRY, SessionClock, StampedInput
from umf_ros.sensors.topic_finder import BACK_END

if find_spec("gtsam") is None:  # before inputs are searched: the process of the graph imports it
    raise ModuleNotFoundError("gtsam is not installed", name="gtsam")
# minutes of fast odometry: none is lost while the optimiser works
INBOX = 100_000
AT_ONCE, DECIDE_S = 500, 0.5
"""Most messages that are passed to the graph, or statuses in a message, and the time to decide about closures."""
FRONT_END = "loop_closure_node"
SETTLE_S, PREPARE_S = 0.4, 0.2
"""Longest time to settle the graph at the end, and to prepare for it once per second."""
END_S = 2.0
"""Longest time to process messages at the end; what is left is stored for the next start."""
LEFT, DROPPED = "the next start with this folder processes them", "without results_dir they are dropped"
UNSETTLED = "no time to settle the graph: its current results were written; the next start with this folder settles it"
DRAWING = 20.0
"""Least pause between publications of path and markers, as a multiple of their duration: long paths are large."""
KEPT_M = 0.1
"""Least motion until the pose is kept again for the next start."""
GRACE_S = 0.5
"""Time within which a front-end that shuts down with this node reports it."""


class PoseGraphNode(BaseNode):
    """Back-end node: a pose graph in a process of its own, and the pose in the map at the odometry's rate."""

    def __init__(self) -> None:
        self._front_end_busy = False
        self._interrupted_s: float | None = None
        super().__init__("pose_graph_node", "folder for trajectories, graph and verdicts; empty: none", BACK_END)

    def _open(self) -> None:
        settings = self._settings
        self._frames = settings.frames
        journal = Path(self._results) / JOURNAL if self._results and not settings.localizing else None
        self._durable = start_graph(settings, journal, self._report_fault)
        self._opening.callback(self._durable.close)
        self._state = self._durable.state()
        # sessions of the odometry that came, and the one whose correction is known; none before its first message
        self._odometry_clock, self._corrected = SessionClock(), -1
        # newest odometry in path and markers; None: verdicts have changed since
        self._drawn_ns: int | None = None
        self._next_draw_s = 0.0
        # messages for the graph, with the session of odometry; refusals to be logged together
        self._inbox: deque[tuple[GraphInput, int]] = deque()
        self._inbox_dropped, self._ending = 0, False
        self._refused: list[ClosureVerdict] = []
        self._make_publishers()
        if recovery := self._durable.recovery():
            self.get_logger().info(recovery)
            self._announce(self._durable.closures())
        self._worker: Worker[Callable[[], None]] = Worker(lambda step: step(), self._on_failure, AT_ONCE)
        self._newest: OdometrySample | None = None
        self._kept_at = np.full(3, np.inf)
        self._map_poses = self._follow_initial_pose(self._expect)
        if self._state.unsettled:
            self._worker.submit(self._settle_previous, needed=True)
        is_aided = bool(settings.absolute.gnss or settings.absolute.imu)
        calibration = calibration_of(settings) if is_aided else None
        self._odometry_frames = self._subscribe_odometry(self._on_odometry, calibration)
        self._subscribe("closures", Odometry, "loop_closures", self._on_closure, CLOSURES_QOS, rare=True)
        if calibration is not None:
            self._subscribe_absolute(calibration)
        self.create_subscription(String, "~/reject_edge", self._guarded("reject_edge", self._on_reject), 10)
        hear = self._guarded("front-end", self._on_front_end)
        self.create_subscription(TransitionEvent, f"{FRONT_END}/transition_event", hear, 10)
        self._offer(self._worker, "~/reject_last", lambda _: self._reject_last())
        self._offer(self._worker, "~/save", lambda _: self._save())
        self._offer(self._worker, "~/reset", lambda _: self._reset())
        self._offer(self._worker, "~/add_closure", self._add_by_hand, AddDiagnostics)
        self._offer(self._worker, "~/reject_edge", partial(self._decide_by_hand, state=State.REJECTED), AddDiagnostics)
        self._offer(self._worker, "~/undo_edit", partial(self._decide_by_hand, state=State.PENDING), AddDiagnostics)

    def _finish(self) -> None:
        """Process the queue, settle the graph and write the results."""
        self._ending = True
        self._worker.close(END_S)
        self._tell_refusals()
        try:
            if left := [item for item, _ in self._inbox]:
                self._durable.keep(left)
                self.get_logger().warning(f"no time for {len(left)} messages: {LEFT if self._results else DROPPED}")
            if self._results and not self._durable.write_results(Path(self._results), SETTLE_S):
                self.get_logger().warning(UNSETTLED)
        finally:
            self._durable.close()

    def ready_to_close(self) -> bool:
        """Return whether a front-end that also shuts down has published its last closures."""
        now_s = time.monotonic()
        if self._interrupted_s is None:
            self._interrupted_s = now_s
        if not self._opened or not self.count_publishers("loop_closures"):
            return True
        return not self._front_end_busy and now_s - self._interrupted_s > GRACE_S

    def _settle_previous(self) -> None:
        """Settle the graph of the previous process, in steps."""
        with watchdog.task("settling the graph", watchdog.PATIENT_S):
            settled = self._durable.write_results(Path(self._results), DECIDE_S)
        if settled:
            self._announce(self._durable.closures())
        elif not self._ending:
            self._worker.submit(self._settle_previous, needed=True)

    def _on_failure(self, error: Exception) -> None:
        """End the node when the process of the graph has ended."""
        if isinstance(error, ProcessEndedError):
            self.failure = error
        else:
            self._report_fault(error)

    def _retune(self, settings: Settings) -> None:
        self._worker.submit(lambda: self._durable.retune(settings.pose_graph), needed=True)

    def _on_front_end(self, event: TransitionEvent) -> None:
        self._front_end_busy = event.goal_state.label == "shuttingdown"

    def _subscribe_absolute(self, calibration: Calibration) -> None:
        """Hear GNSS and IMU where their topics are named."""
        topics, qos = self._settings.absolute, messages.sensor_qos(self._settings.qos, ODOMETRY_DEPTH)
        find = self._odometry_frames.pose_of
        self._decoder = AbsoluteDecoder(calibration.antenna, calibration.body_T_imu, find)
        if topics.gnss:
            self._subscribe("gnss", NavSatFix, topics.gnss, partial(self._on_absolute, Aid.GNSS), qos)
        if topics.imu:
            self._subscribe("imu", Imu, topics.imu, partial(self._on_absolute, Aid.GRAVITY), qos)

    def _on_absolute(self, source: Aid, message: Any) -> None:
        measurement = self._decoder.decode(source, message, stamp_ns(message))
        if measurement is not None:
            self._submit(measurement)

    def _expect(self, _: MapPoses, initial: InitialPose) -> None:
        self._worker.submit(lambda: self._durable.expect(initial), needed=True)

    def _keep_pose(self) -> None:
        """Keep a pose that has moved for the next start."""
        newest, map_T_odom = self._newest, self._state.map_T_odom
        if self._map_poses is None or not self._results or map_T_odom is None or newest is None:
            return
        pose = map_T_odom @ newest.odom_T_body
        if np.linalg.norm(pose[:3, 3] - self._kept_at) > KEPT_M:
            self._map_poses.write_last(Path(self._results), InitialPose(pose, self._state.covariance))
            self._kept_at = pose[:3, 3]

    def _make_publishers(self) -> None:
        self._path_publisher = self.create_publisher(PathMessage, "~/path", LATCHED_QOS)
        self._pose_publisher = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 50)
        self._marker_publisher = self.create_publisher(MarkerArray, "~/markers", LATCHED_QOS)
        self._verdict_publisher = self.create_publisher(DiagnosticArray, "~/verdicts", CLOSURES_QOS)
        self._transform_publisher = self.create_publisher(TransformStamped, "~/map_to_odom", 50)
        self._broadcast = _broadcaster(self) if self._frames.publish_tf else None

    def _on_odometry(self, sample: OdometrySample) -> None:
        if self._odometry_frames.odom != self._frames.odom:
            self._frames = self._frames.model_copy(update={"odom": self._odometry_frames.odom})
        decided = self._odometry_clock.take(StampedInput(ODOMETRY, sample.stamp_ns, sample.odom_T_body))[1]
        session = self._odometry_clock.session
        self._submit(sample, session)
        # the latest correction, if it is of this odometry: the pose never waits for the optimiser
        state = self._state
        map_T_odom = state.map_T_odom
        if map_T_odom is None or self._corrected != session or not decided or decided[-1].fault:
            return
        self._newest = sample
        pose = messages.pose(sample.stamp_ns, map_T_odom @ sample.odom_T_body, state.covariance, self._frames)
        self._pose_publisher.publish(pose)
        transform = messages.transform(sample.stamp_ns, map_T_odom, self._frames)
        self._transform_publisher.publish(transform)
        if self._broadcast is not None:
            self._broadcast(transform)

    def _on_closure(self, message: Odometry) -> None:
        if messages.is_between_rovers(message):
            return
        self._submit(messages.closure_from_message(message))

    def _submit(self, item: GraphInput, session: int = -1) -> None:
        """Queue an input of the graph, of a session of odometry."""
        if len(self._inbox) >= INBOX:
            self._inbox_dropped += 1
            return
        self._inbox.append((item, session))
        self._worker.submit(self._take, needed=True, once=True)

    def _take(self) -> None:
        """Pass queued inputs to the graph, and decide once none waits; the odometry's correction is of its session."""
        batch = [self._inbox.popleft() for _ in range(min(len(self._inbox), AT_ONCE))]
        verdicts, resets = self._durable.take([item for item, _ in batch], self._decide_s)
        for reset in resets:
            self.get_logger().warning(f"{reset.reason}: a new session begins")
        session = max([self._corrected, *(session for _, session in batch)])
        if resets or session != self._corrected:
            self._correct()
            self._corrected = session
        self._announce(verdicts)
        if (self._inbox or self._is_behind) and not self._ending:
            self._worker.submit(self._take, needed=True, once=True)

    @property
    def _decide_s(self) -> float:
        """Time to decide about closures: none while inputs wait, as the newest closures are decided about first."""
        return 0.0 if self._inbox else DECIDE_S

    @property
    def _is_behind(self) -> bool:
        """Whether closures wait for a decision; they precede all work that can wait."""
        waiting = any(isinstance(item, LoopClosure) for item, _ in tuple(self._inbox))
        return waiting or bool(self._state.counts["closures_undecided"])

    def _on_reject(self, message: String) -> None:
        pair = parse_pair(message.data)
        self._worker.submit(lambda: self._announce(self._durable.decide_by_hand(*pair, State.REJECTED)), needed=True)

    def _announce(self, verdicts: list[ClosureVerdict]) -> None:
        if not verdicts:
            return
        self._correct()
        # a verdict may change until the graph is settled, except a refusal
        self._refused += [verdict for verdict in verdicts if verdict.state is State.REFUSED]
        for first in range(0, len(verdicts), AT_ONCE):
            report = DiagnosticArray(status=[_as_status(one) for one in verdicts[first : first + AT_ONCE]])
            report.header.stamp = self.get_clock().now().to_msg()
            self._verdict_publisher.publish(report)
        self._drawn_ns = None

    def _tell_refusals(self) -> None:
        """Log refusals, those of one reason in one line."""
        refused, self._refused = self._refused, []
        for reason, number in Counter(verdict.reason for verdict in refused).items():
            first = describe(next(verdict for verdict in refused if verdict.reason is reason))
            self.get_logger().info(first if number == 1 else f"graph: {number} closures refused: {reason}")

    def _correct(self) -> None:
        self._state = self._durable.state()

    def _show(self) -> None:
        """Publish path and markers if they have changed and have subscribers; late ones get the last (latched)."""
        listeners = self._path_publisher.get_subscription_count() + self._marker_publisher.get_subscription_count()
        newest_ns = self._state.newest_ns
        if listeners and self._drawn_ns != newest_ns and time.monotonic() >= self._next_draw_s:
            started_s, self._drawn_ns = time.thread_time(), newest_ns
            stamps, poses, closures, absolute = self._durable.drawing()
            self._path_publisher.publish(messages.path(stamps, poses, self._frames))
            header = messages.to_header(max(newest_ns, 0), self._frames.map)
            self._marker_publisher.publish(messages.to_markers(closures, header, absolute))
            self._next_draw_s = time.monotonic() + DRAWING * (time.thread_time() - started_s)

    def _tick(self) -> None:
        self._worker.submit(self._update, needed=True, once=True)
        self._diagnose(self._own_status())

    def _update(self) -> None:
        """Decide about closures whose odometry has arrived, and publish the new path."""
        self._announce(self._durable.update(not self._is_behind, self._decide_s))
        self._tell_refusals()
        if not self._is_behind:
            self._durable.prepare(PREPARE_S)
        self._correct()
        self._show()
        self._keep_pose()

    def _own_status(self) -> DiagnosticStatus:
        state = self._state
        values: dict[str, object] = {**state.counts, **self._faults}
        values |= {"queue_dropped": self._inbox_dropped, "queue_waiting": len(self._inbox)}
        text = f"{values.get('accepted', 0)} closures accepted"
        if state.probability is not None:
            values["probability"] = state.probability
            text = "in the map" if state.map_T_odom is not None else "not localised in the map yet"
        level = WARN if any(name.startswith("optimiser") for name in state.counts) else OK
        return status(level, "pose graph", text, values)

    def _failures(self) -> dict[str, str]:
        found, state = super()._failures(), self._state
        is_found = state.probability is None or state.map_T_odom is not None
        if (pending := state.counts.get("pending")) and state.newest_ns < 0:
            found["stale_odometry"] = f"{pending} closures pending: no odometry received"
        return found | {
            "weak_overlap": "" if is_found or state.newest_ns < 0 else "no place of the map was found so far",
            "overload": TOO_SLOW if self._inbox_dropped else "",
            "contradicting_sensors": "; ".join(f"{k}: {v}" for k, v in state.counts.items() if "as a whole" in k),
        }

    def _reject_last(self) -> str:
        accepted = [one.closure for one in self._durable.closures() if one.state is State.ACCEPTED]
        if not accepted:
            raise UmfError("no closure is accepted")
        self._announce(self._durable.decide_by_hand(*accepted[-1].pair, State.REJECTED))
        return f"closure {_name(accepted[-1])} revoked"

    def _decide_by_hand(self, request: AddDiagnostics.Request, state: State) -> str:
        """Decide about the closures between two keyframes that the request's text names."""
        pair = parse_pair(request.load_namespace)
        self._announce(self._durable.decide_by_hand(*pair, state))
        told = self._durable.verdicts_on(*pair)
        return "; ".join(f"closure {_name(one.closure)} {one.state.value}: {one.reason}" for one in told)

    def _add_by_hand(self, request: AddDiagnostics.Request) -> str:
        """Accept the closures between two keyframes; with a pose in the request, that is a new one."""
        pair, closure = messages.closure_by_hand(request.load_namespace)
        if closure is not None:
            self._announce(self._durable.add_by_hand(closure))
        return self._decide_by_hand(AddDiagnostics.Request(load_namespace=pair), State.ACCEPTED)

    def _save(self) -> str:
        folder = self._results or "pose_graph_results"
        self._durable.write_results(Path(folder))
        return f"results written to {folder}"

    def _reset(self) -> str:
        if self._results:
            parent = Path(self._results)
            self._durable.write_results(next(new for i in count(1) if not (new := parent / f"graph_{i}").exists()))
        kept = self._durable.end()
        self._state, self._drawn_ns = self._durable.state(), None
        return "a new graph begins" + (f"; the old one is kept in {kept}" if kept else "")


def describe(verdict: ClosureVerdict) -> str:
    """Return one line about a verdict for the log."""
    seconds = (verdict.closure.query_stamp_ns - verdict.closure.match_stamp_ns) * 1e-9
    return f"graph: closure {seconds:.1f} s back {verdict.state.value}: {verdict.reason}{verdict.figures}"


def _as_status(verdict: ClosureVerdict) -> DiagnosticStatus:
    level = OK if verdict.state is State.ACCEPTED else WARN
    values = {"verdict": verdict.state.value, "mahalanobis": verdict.residual, "misfit_m": verdict.residual_m}
    return status(level, _name(verdict.closure), verdict.reason, values)


def _name(closure: LoopClosure) -> str:
    return f"keyframe/{closure.match_stamp_ns} keyframe/{closure.query_stamp_ns}"


def _broadcaster(node: Node) -> Callable[[TransformStamped], None] | None:
    try:
        from tf2_ros import TransformBroadcaster
    except ImportError:
        node.get_logger().warning("tf2_ros is not installed: map -> odom is published on ~/map_to_odom only")
        return None
    return TransformBroadcaster(node).sendTransform


def main() -> None:
    """Run `ros2 run umf_ros pose_graph_node`."""
    leave(run(PoseGraphNode))


if __name__ == "__main__":
    main()
