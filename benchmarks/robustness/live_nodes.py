"""The nodes as processes over DDS, for `endurance.py` and `latency.py`: started, killed, driven, heard."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld
from umf_ros.nodes.conversions import CLOSURES_QOS, closure_to_message, from_time, to_pose, to_time
from umf_ros.pose_graph.closures import ClosureReason

Figures = dict[str, Any]
FRONT_END, BACK_END = "loop_closure_node", "pose_graph_node"
PLAYER = "umf_ros.lab.live.bag_player_node"
START_S = 120.0
MANY = QoSProfile(depth=500)
DISCOVERY_S = 1.0
"""The writer knows its reader before the reader knows it, and messages sent between are lost."""
UNDECIDED = ClosureReason.NO_ODOMETRY_YET, ClosureReason.NOT_DECIDED_YET


def spread(name: str, milliseconds: Array) -> Figures:
    """Median, 95th percentile and worst of a cost."""
    p50, p95, worst = np.percentile(milliseconds, [50, 95, 100]).round(1).tolist()
    return {f"{name}_p50": p50, f"{name}_p95": p95, f"{name}_max": worst}


def later(world: GraphWorld, row: int) -> LoopClosure:
    """A closure of a world whose first pose has the stamp of one second, not zero."""
    closure, told = world.closures[row], world.message(row)
    stamps = (closure.second + 1) * PERIOD_NS, (closure.first + 1) * PERIOD_NS
    return LoopClosure(*stamps, told.match_T_query, told.covariance)


@contextmanager
def own_domain() -> Iterator[None]:
    """A DDS domain of this process and its children, on this machine alone."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    try:
        yield
    finally:
        rclpy.try_shutdown()


class NodeUnderTest:
    """One of our nodes in a process of its own.

    Args:
        name: which.
        folder: for its results, and its log beside them.
        parameters: by name.
        namespace: of the robot.
        config: parameter file.
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        parameters: dict[str, object],
        namespace: str = "",
        config: Path | None = None,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.log = folder / f"{name}.log"
        values = {"results_dir": folder, "qos.reliability": "reliable", "qos.depth": 500, **parameters}
        values = values if config else {"dataset": "simulated", **values}
        words = ["--params-file", str(config)] if config else []
        words += [word for key, value in values.items() for word in ("-p", f"{key}:={value}")]
        words += ["-r", f"__ns:=/{namespace}"] if namespace else []
        command = [sys.executable, "-m", f"umf_ros.nodes.{name}", "--ros-args", *words]
        with self.log.open("ab") as file:
            self.process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self.process.poll() is None

    def kill(self) -> None:
        """End it as a power cut would."""
        self.process.kill()
        self.process.wait()

    def stop(self) -> tuple[float, int]:
        """End it as Ctrl-C does; seconds that took, and the exit status."""
        asked = time.monotonic()
        self.process.send_signal(signal.SIGINT)
        try:
            status = self.process.wait(60.0)
        except subprocess.TimeoutExpired:
            self.kill()
            status = -1
        return time.monotonic() - asked, status

    def end(self) -> tuple[float, int]:
        """Stop it; seconds that took, and the number of tracebacks in its log and of a wrong exit status."""
        seconds, status = self.stop()
        return seconds, int(status != 0) + self.log.read_text(errors="replace").count("Traceback")


def play(bag: Path, *more: str, moved_to: str = "", topics: tuple[str, ...] = ()) -> subprocess.Popen[bytes]:
    """Play a recording as a process of its own, its topics moved into a namespace where one is given."""
    words = [word for topic in topics for word in ("-r", f"{topic}:=/{moved_to}{topic}")] if moved_to else []
    command = [sys.executable, "-m", PLAYER, str(bag), "--quiet", "--wait-for-subscribers", *more]
    silent = subprocess.DEVNULL
    return subprocess.Popen([*command, *(["--ros-args", *words] if words else [])], stdout=silent, stderr=silent)


@contextmanager
def listening() -> Iterator[Ears]:
    """Ears in a domain of their own."""
    with own_domain():
        ears = Ears()
        yield ears
        ears.destroy_node()


class Rover:
    """Odometry and front-end of a rover in a world, whose first pose has the stamp of one second."""

    def __init__(self, ears: Ears, world: GraphWorld) -> None:
        self._ears, self._world = ears, world
        self.odometry = ears.create_publisher(Odometry, "/odom", MANY)
        self._closures = ears.create_publisher(Odometry, "/loop_closures", CLOSURES_QOS)

    def drive(self, poses: Iterable[int], close: bool = True) -> Iterator[list[LoopClosure]]:
        """Publish odometry of some poses, and after each one the closures that end there, which are yielded."""
        for k in poses:
            message = Odometry(child_frame_id="base_link")
            message.header.stamp, message.header.frame_id = to_time((k + 1) * PERIOD_NS), "odom"
            message.pose.pose = to_pose(self._world.odometry[k])
            self.odometry.publish(message)
            rows = [row for row, closure in enumerate(self._world.closures) if closure.second == k and close]
            closures = [later(self._world, row) for row in rows]
            for closure in closures:
                self.send(closure)
            self._ears.spin_once(0.002)
            yield closures

    def send(self, closure: LoopClosure) -> None:
        """Publish a closure."""
        self._closures.publish(closure_to_message(closure))


class Ears(Node):
    """Hears what the nodes of one robot say.

    Attributes:
        keyframes: stamps of the keyframes that were announced.
        closures: pairs of stamps on `loop_closures`, match and query.
        verdicts: seconds of the monotonic clock at the back-end's first verdict on each of these.
        decided: seconds of the system's clock at which those of them were compared with the map, or refused.
        values: latest diagnostics by node's full name, then by line.
    """

    def __init__(self, namespace: str = "") -> None:
        super().__init__(f"ears_{namespace or 'root'}")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self.keyframes: set[int] = set()
        self.closures: set[tuple[int, int]] = set()
        self.verdicts: dict[tuple[int, int], float] = {}
        self.decided: dict[tuple[int, int], float] = {}
        self.values: dict[str, dict[str, dict[str, str]]] = {}
        at = f"/{namespace}/" if namespace else "/"
        self.create_subscription(PoseStamped, f"{at}{FRONT_END}/keyframes", self._hear_keyframe, CLOSURES_QOS)
        self.create_subscription(Odometry, f"{at}loop_closures", self._hear_closure, CLOSURES_QOS)
        self.create_subscription(DiagnosticArray, f"{at}{BACK_END}/verdicts", self._hear_verdicts, CLOSURES_QOS)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._hear_health, 50)

    def until(self, condition: Callable[[], object], timeout_s: float = START_S) -> bool:
        """Spin until something holds; False when it does not in time."""
        deadline = time.monotonic() + timeout_s
        while not condition() and time.monotonic() < deadline:
            self.spin_once(0.02)
        return bool(condition())

    def spin_once(self, seconds: float) -> None:
        """Hear the next message, within some time."""
        self._executor.spin_once(timeout_sec=seconds)

    def wait(self, seconds: float) -> None:
        """Spin for so long."""
        self.until(lambda: False, seconds)

    def has_heard(self, keyframes: int) -> bool:
        """Whether so many keyframes were announced."""
        return len(self.keyframes) >= keyframes

    def anew(self, name: str) -> bool:
        """Wait until a node that was just started says how it is; who was killed before is forgotten."""
        self.values.pop(name, None)
        return self.until(lambda: name in self.values)

    def value(self, name: str, line: str, key: str) -> float:
        """A number of the diagnostics; 0 where there is none."""
        try:
            return float(self.values[name][line][key])
        except (KeyError, ValueError):
            return 0.0

    def _hear_keyframe(self, message: PoseStamped) -> None:
        self.keyframes.add(from_time(message.header.stamp))

    def _hear_closure(self, message: Odometry) -> None:
        self.closures.add((_stamp(message.header.frame_id), _stamp(message.child_frame_id)))

    def _hear_verdicts(self, message: DiagnosticArray) -> None:
        for status in message.status:
            match, _, query = status.name.partition(" ")
            self.verdicts.setdefault((_stamp(match), _stamp(query)), time.monotonic())
            if status.message not in UNDECIDED:
                self.decided.setdefault((_stamp(match), _stamp(query)), from_time(message.header.stamp) / 1e9)

    def _hear_health(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name, _, line = status.name.partition(": ")
            self.values.setdefault(name, {})[line] = {pair.key: pair.value for pair in status.values}


def _stamp(frame: str) -> int:
    digits = frame.removeprefix("keyframe/")
    return int(digits) if digits.isdigit() and len(digits) < 20 else -1
