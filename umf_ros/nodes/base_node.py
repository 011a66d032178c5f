"""Base of both nodes: life cycle, parameters, watched inputs, diagnostics, and faults that do not end the node."""

from __future__ import annotations

import gc
import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_srvs.srv import Trigger

from umf_ros.core import watchdog
from umf_ros.core.config import Settings, Topics, topics_of
from umf_ros.core.errors import ConfigError, MessageError, OutputError, UmfError, either, shortened
from umf_ros.core.io import check_writable
from umf_ros.map_poses import InitialPose, MapPoses
from umf_ros.nodes.conversions import from_time, latched, sensor_qos
from umf_ros.nodes.diagnostics import ERROR, FAILURES, OK, WARN, InputWatch, status
from umf_ros.nodes.parameters import changed_settings, declare, with_own_odometry
from umf_ros.nodes.process import Worker, interruptible, log_to
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.tf import PATIENCE_S, TOPIC, BodyFrames, StaticTransforms
from umf_ros.sensors.topic_finder import FRONT_END, SETTLING_S, TopicFinder, describe_inputs, must_find

STATIC_QOS = latched(100)
"""Deep enough for several broadcasters, each with a part of the tree."""
ODOMETRY_DEPTH = 200
BURST = 500
"""Messages of a rare input that are received at once."""
WATCH_S = 1.0
HEARTBEAT_S = 0.1
FAULT_S = 10.0
"""Time after a fault until it leaves the status of the node."""
CLOCK_PATIENCE_S = 30.0
"""Longest start of a bag player beside the nodes, for which it waits, on a busy machine."""
SIM_TIME_SILENT = "use_sim_time is set, but /clock is silent: message stamps are used, the age of the pose is unknown"


class BaseNode(LifecycleNode, ABC):
    """A managed node with the package's settings as its parameters, and a folder for results.

    Nodes set up their work in `_open` and end it in `_finish`. With `autostart`, the default, they are configured and
    activated at once, or when the topics that no parameter names are found in the ROS graph; without, they wait for the
    services of the life cycle. An inactive node takes no messages.
    No exception in a callback ends a node: every one is counted, logged, and shows in the diagnostics. `failure` is why
    a node cannot start.

    Raises:
        ConfigError: a parameter is unknown, of the wrong type or out of range.
        OutputError: the folder for results cannot be written.
        UmfError: it cannot be configured, with `autostart`.
    """

    def __init__(self, name: str, results: str, wanted: Collection[str] = FRONT_END) -> None:
        """Declare the parameters; `results` describes the folder `results_dir`, `wanted` are inputs."""
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        log_to(self.get_logger())
        change_state = self._service_change_state.callback
        self._service_change_state.callback = partial(self._answer_transition, change_state)
        self._settings, self._results = declare(self, results)
        self._settings = with_own_odometry(self._settings)
        self._input_names, self._finder = wanted, None
        if must_find(self._settings, wanted):
            _check_results(self._results)  # before it waits for topics
            self._finder = TopicFinder(self._settings, self.get_namespace(), wanted)
        self.failure: UmfError | None = None
        self._watches: list[InputWatch] = []
        self._own: list[Any] = []
        self._faults, self._last_fault, self._fault_s = Counter[str](), "", -math.inf
        self._logged_s: dict[str, float] = {}
        self._clockless_s = 0.0
        self._active = self._opened = self._leaving = False
        self._unwritten: Exception | None = None
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._use_parameters)
        self._wall = Clock(clock_type=ClockType.STEADY_TIME)
        # the machine's clock: the watch has to run while /clock is silent
        self._stall_ms, self._beat_s = 0.0, math.inf
        self.create_timer(HEARTBEAT_S, self._beat, clock=self._wall)
        self.create_timer(WATCH_S, self._guarded("watch", lambda: self._watch()), clock=self._wall)
        self._starting = bool(self.get_parameter("autostart").value)
        if self._starting:
            self._start()

    def _start(self) -> None:
        """Configure and activate, as soon as the inputs are found."""
        if not self._find_inputs(SETTLING_S):
            if self._is_due("inputs", 30.0):
                wanted = either(list(self._input_names))
                self.get_logger().info(f"waiting for topics of {wanted} (parameters topics.*, dataset)")
            return
        self._starting = False
        self._configure()
        self.trigger_configure()
        self.trigger_activate()
        self.get_logger().info("ready")

    def _find_inputs(self, settling_s: float) -> bool:
        """Name the topics that no parameter names; False while they are not there."""
        if self._finder is None:
            return True
        types = {topic: kinds[0] for topic, kinds in self.get_topic_names_and_types() if self.count_publishers(topic)}
        found = self._finder.look(types, time.monotonic(), settling_s)
        if found is not None:
            self._settings, self._finder = found, None
            self.get_logger().info(describe_inputs(found, self._input_names))
        return found is not None

    def _answer_transition(self, change_state: Callable[..., Any], request: Any, response: Any) -> Any:
        """Answer a request to change the state; rclpy leaves one that is not possible without an answer."""
        asked = request.transition.label or request.transition.id
        if not any(asked in possible[:2] for possible in self._state_machine.available_transitions):
            state = self._state_machine.current_state[1]
            self.get_logger().warning(f"transition {shortened(asked)} refused: not possible in the state '{state}'")
            return response  # its success is false
        return change_state(request, response)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure the node; an error of the user is one line and a failure."""
        if not self._opened:
            try:
                if not self._find_inputs(0.0):
                    raise ConfigError("no topic of its inputs is there (parameters topics.*, dataset)")
                self._configure()
            except UmfError as error:
                self.get_logger().error(str(error))
                self._release()
                return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start taking messages."""
        if not self._opened:
            self.get_logger().error("the results could not be written: call cleanup again, then configure")
            return TransitionCallbackReturn.FAILURE
        self._active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop taking messages, and finish those in hand."""
        self._active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Write the results and release everything."""
        result = super().on_cleanup(state)
        try:
            self._close()
        except Exception as error:  # rclpy would drop it silently
            self._unwritten = error
            if not self._leaving:
                self.get_logger().error(f"{type(error).__name__}: {error}")
            return TransitionCallbackReturn.FAILURE
        self._release()
        return result

    on_shutdown = on_cleanup

    def close(self) -> None:
        """Finish the work in hand and write the results.

        Raises:
            OutputError: they cannot be written.
        """
        self._leaving = True
        if self._opened and rclpy.ok(context=self.context):
            self.trigger_shutdown()  # reports the start and the end of the last messages
        self._close()
        error, self._unwritten = self._unwritten, None
        if error is not None:
            raise error

    def _close(self) -> None:
        self._active = False
        if self._opened:
            self._opened = False
            with watchdog.watching(watchdog.PATIENT_S):
                self._finish()

    def ready_to_close(self) -> bool:
        """Return whether the node can close after Ctrl-C."""
        return True

    @abstractmethod
    def _open(self) -> None:
        """Create everything that the node needs; where that fails, the callbacks of `_opening` release it."""

    @abstractmethod
    def _finish(self) -> None:
        """Finish the work in hand, write the results, release everything."""

    @abstractmethod
    def _retune(self, settings: Settings) -> None:
        """Apply settings that may change while the node runs."""

    @abstractmethod
    def _tick(self) -> None:
        """Work once per second of the machine's clock."""

    def _configure(self) -> None:
        _check_results(self._results)
        before, self._unwritten = self._entities(), None
        try:
            with watchdog.watching(watchdog.PATIENT_S), ExitStack() as self._opening:
                with interruptible():
                    self._open()
                self._opening.pop_all()
            self._opened = True
            # permanent objects: their garbage collection blocked the executor for .3 s
            gc.collect()
            gc.freeze()
        finally:
            self._own = [item for item in self._entities() if item not in before]

    def _entities(self) -> list[Any]:
        return [*self.publishers, *self.subscriptions, *self.services]

    def _release(self) -> None:
        """Destroy the entities that `_open` made; `/clock` is subscribed in every state."""
        gc.unfreeze()
        for entity in self._own:
            self.destroy_publisher(entity) or self.destroy_subscription(entity) or self.destroy_service(entity)
        self._own.clear()
        self._watches.clear()

    def _watch(self) -> None:
        if self._starting:
            try:
                self._start()
            except UmfError as error:
                self.failure, self._starting = error, False
        if not self._opened:
            if self._starting:
                self._diagnose(status(WARN, "start", "not ready", {}))
            return
        self._clockless_s = self._clockless_s + WATCH_S if self._lacks_clock() else 0.0
        for watch in self._watches if 0 < self._clockless_s < CLOCK_PATIENCE_S else ():
            watch.begin()  # the player is still starting: silence is expected
        self._tick()
        for watch in self._watches:
            if watch.warning and self._is_due(f"input {watch.name}", 30.0):
                self.get_logger().warning(watch.warning)
        if self._clockless_s >= CLOCK_PATIENCE_S and self._is_due("clock", 30.0):
            self.get_logger().warning(SIM_TIME_SILENT)

    def _beat(self) -> None:
        """Measure the longest delay of the executor, ms."""
        now_s = time.monotonic()
        self._stall_ms = max(self._stall_ms, 1e3 * (now_s - self._beat_s - HEARTBEAT_S))
        self._beat_s = now_s

    def _is_due(self, line: str, every_s: float) -> bool:
        """Rate-limit log lines: return whether this one is due again."""
        now_s = time.monotonic()
        if now_s - self._logged_s.get(line, -math.inf) < every_s:
            return False
        self._logged_s[line] = now_s
        return True

    def _lacks_clock(self) -> bool:
        return bool(self.get_parameter("use_sim_time").value) and self.get_clock().now().nanoseconds == 0

    def _own_topic(self, name: str, topics: Topics) -> str:
        """Return the name to subscribe to: that of a data set is relative, so that a namespace is a robot."""
        topic = str(getattr(topics, name))
        named = getattr(self._settings.topics, name) != getattr(Topics(), name)
        return topic if named else topic.removeprefix("/")

    def _guarded(self, what: str, take: Callable[..., Any]) -> Callable[..., Any]:
        """Return `take` with every exception caught."""

        def call(*arguments: Any) -> Any:
            try:
                return take(*arguments)
            except Exception as error:
                self._report_fault(error, what)
                return None

        return call

    def _subscribe(
        self, name: str, kind: type, topic: str, take: Callable[[Any], None], qos: QoSProfile, rare: bool = False
    ) -> None:
        """Subscribe to an input of messages with a header, and watch it; `rare` ones may be silent."""

        def receive(message: Any) -> None:
            watch.count(from_time(message.header.stamp))
            if not self._active:
                return
            try:
                take(message)
            except Exception:
                watch.refused += 1
                raise

        def lose(event: Any) -> None:
            watch.lost += event.total_count_change

        guarded = self._guarded(name, receive)

        def receive_waiting(message: Any) -> None:
            """Receive a message and, of a rare input, those behind it: the executor takes a millisecond for each."""
            guarded(message)
            for _ in range(BURST if rare else 0):
                if (taken := subscription.handle.take_message(kind, False)) is None:
                    break
                guarded(taken[0])

        events = SubscriptionEventCallbacks(message_lost=lose)
        subscription = self.create_subscription(kind, topic, receive_waiting, qos, event_callbacks=events)
        watch = InputWatch(self, name, subscription.topic_name, kind, rare)
        self._watches.append(watch)

    def _subscribe_odometry(
        self, take: Callable[[OdometrySample], None], calibration: Calibration | None = None
    ) -> BodyFrames:
        """Subscribe to the odometry and to `/tf_static`; `take` gets the poses of the body."""
        frames, topics = self._subscribe_transforms(calibration), topics_of(self._settings)
        if topics.odometry:
            name, qos = self._own_topic("odometry", topics), sensor_qos(self._settings.qos, ODOMETRY_DEPTH)
            self._subscribe("odometry", Odometry, name, lambda message: take(frames.odometry(message)), qos)
        return frames

    def _subscribe_transforms(self, calibration: Calibration | None = None) -> BodyFrames:
        """Subscribe to `/tf_static` for extrinsics and the odometry's frame; Jazzy from PyPI lacks tf2_msgs."""
        transforms, warn = StaticTransforms(), self.get_logger().warning
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            if calibration is not None and calibration.is_open:
                text = f"{TOPIC} cannot be heard without tf2_msgs: the parameter calibration names a file"
                raise ConfigError(text) from None
            if self._settings.frames.extrinsics == "tf":
                self.get_logger().info("tf2_msgs is not installed: extrinsics are those of the calibration file")
        else:
            self.create_subscription(TFMessage, TOPIC, self._guarded("transforms", transforms.add), STATIC_QOS)
        return BodyFrames(self._settings.frames, transforms, warn, PATIENCE_S, calibration)

    def _answer(self, name: str, action: Callable[[Any], str], request: Any) -> tuple[bool, str]:
        """Return the success and the text of a service; any fault is a failure."""
        try:
            return True, action(request)
        except Exception as error:
            if not isinstance(error, UmfError):
                self._report_fault(error, name)
            return False, str(error)

    def _offer(
        self, worker: Worker[Callable[[], None]] | None, name: str, action: Callable[[Any], str], kind: type = Trigger
    ) -> None:
        """Offer a service that answers with the text of `action`, which runs at once without a worker.

        A worker runs it when it is its turn: the executor goes on meanwhile.
        """

        async def answer(request: Any, response: Any) -> Any:
            answered = Future()

            def act() -> None:
                with watchdog.task(name, watchdog.PATIENT_S):
                    answered.set_result(self._answer(name, action, request))

            if worker is None:
                act()
            elif not worker.submit(act, needed=True):
                answered.set_result((False, "the node ends, or has too much to do"))
            response.success, response.message = await answered
            return response

        # a group of its own: those in one group wait for each other, the timers too
        self.create_service(kind, name, answer, callback_group=ReentrantCallbackGroup())

    def _diagnose(self, own: DiagnosticStatus) -> None:
        """Publish the health of the node, with the failures that there are, and of its inputs."""
        failures = self._failures() if self._opened else BaseNode._failures(self)
        found = {name: text for name, text in failures.items() if text}
        category = next((name for name in FAILURES if name in found), "none")
        pairs = {"failure_category": category, "remedy": FAILURES.get(category, "none")}
        pairs["executor_stall_max_ms"] = f"{self._stall_ms:.6g}"
        own.values += [KeyValue(key=key, value=text) for key, text in pairs.items()]
        own.level = max(own.level, ERROR if "cannot_write" in found else WARN if found or not self._active else OK)
        own.message = "inactive" if self._opened and not self._active else "; ".join([own.message, *found.values()])
        report = DiagnosticArray(status=[own, *(watch.status() for watch in self._watches)])
        report.header.stamp = self.get_clock().now().to_msg()
        name = self.get_fully_qualified_name().removeprefix("/")
        for line in report.status:
            line.name = f"{name}: {line.name}"
            line.hardware_id = self.get_namespace().strip("/") or "rover"
        self._diagnostics.publish(report)

    def _failures(self) -> dict[str, str]:
        """Return what is wrong by category of `FAILURES`; empty texts of those that are not there."""
        silent = {watch.name: watch.warning for watch in self._watches if watch.warning}
        fault = "cannot_write" if self._cannot_write else "fault"
        return {
            "no_clock": SIM_TIME_SILENT if self._lacks_clock() else "",
            "stale_odometry": silent.pop("odometry", ""),
            "no_data": "its inputs are not found yet" if self._starting else "; ".join(silent.values()),
            fault: f"last fault: {self._last_fault}" if self._last_fault and self._has_fault else "",
        }

    def _report_fault(self, error: Exception, what: str = "") -> None:
        """Count a fault; log the first of each kind at once, later ones at a limited rate."""
        kind = error.kind if isinstance(error, MessageError) else type(error).__name__
        self._faults[kind] += 1
        self._fault_s = time.monotonic()
        where = f"{what}: " if what else ""
        if isinstance(error, MessageError):
            if self._faults[kind] == 1:
                self.get_logger().warning(f"skipped: {error}")
            return
        text = " ".join(str(error).split())[:300]
        self._last_fault = text if isinstance(error, OutputError) else f"{where}{kind}: {text}"
        if self._is_due(f"fault {what} {kind}", 10.0):
            self.get_logger().error(f"{where}{kind}: {text} ({self._faults[kind]} so far); the node continues")

    @property
    def _has_fault(self) -> bool:
        """Whether a fault is so recent that it may not be over."""
        return time.monotonic() - self._fault_s < FAULT_S

    @property
    def _cannot_write(self) -> bool:
        return self._has_fault and self._faults["OutputError"] > 0 and "write" in self._last_fault

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            changed_settings(self._settings, parameters)
        except UmfError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _use_parameters(self, parameters: list[Parameter]) -> None:
        settings = changed_settings(self._settings, parameters)
        if settings != self._settings:
            self._settings = settings
            if self._opened:
                self._retune(settings)

    def _follow_initial_pose(self, take: Callable[[MapPoses, InitialPose], None]) -> MapPoses | None:
        """Pass on the pose where the rover may be: of the parameter or the last run now, of rviz whenever it comes.

        Returns:
            The poses of the map; None while mapping.
        """
        settings = self._settings
        if not settings.localizing:
            return None
        known = MapPoses(Path(settings.map))
        if (initial := known.initial(settings, self._results)) is not None:
            take(known, initial)

        def receive(message: PoseWithCovarianceStamped) -> None:
            take(known, known.from_message(message, settings.frames.map))

        self.create_subscription(PoseWithCovarianceStamped, "initialpose", self._guarded("initial pose", receive), 1)
        return known


def _check_results(folder: str) -> None:
    if folder:
        check_writable(Path(folder))
