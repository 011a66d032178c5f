"""The nodes as processes over DDS, for `endurance.py`: killed, fed with nonsense, and timed."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.parameter import Parameter
from rich.console import Console
from std_msgs.msg import String

from umf_ros.bags.reader import open_bag
from umf_ros.lab.live.live_graph import LiveGraph
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld, rover_loops, with_wrong_closures
from umf_ros.nodes.conversions import closure_to_message, from_time, to_pose, to_time
from umf_ros.nodes.qos import CLOSURES_QOS
from umf_ros.pose_graph.journal import GraphJournal

ODD = [float("nan"), float("inf"), -1.0, 1e300, 1e-300, 0.0]
TEXTS = ["keyframe/" + "9" * 5000 + " keyframe/1", "", "keyframe/-1 keyframe/2", "x" * 100_000, "keyframe/1 keyframe/2"]
FRAMES = ["keyframe/" + "9" * 5000, "", "keyframe/99999999999999999999", "keyframe/1", "odom", "\u2603"]


class Rover(Node):
    """Odometry and front-end of a rover; knows which closures the back-end has decided about."""

    def __init__(self, world: GraphWorld) -> None:
        super().__init__("endurance")
        self.world = world
        self.odometry = self.create_publisher(Odometry, "/odom", 500)
        self.closures = self.create_publisher(Odometry, "/loop_closures", CLOSURES_QOS)
        self.reject = self.create_publisher(String, "/pose_graph_node/reject_edge", 500)
        self.decided: set[str] = set()
        self.values: dict[str, str] = {}
        self.create_subscription(DiagnosticArray, "/pose_graph_node/verdicts", self._hear, CLOSURES_QOS)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._diagnose, 10)

    def _hear(self, message: DiagnosticArray) -> None:
        self.decided |= {status.name for status in message.status}

    def _diagnose(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "pose_graph_node: pose graph":
                self.values = {pair.key: pair.value for pair in status.values}

    def until(self, condition: Callable[[], bool], timeout_s: float = 60.0) -> bool:
        """Spin until something holds; False when it does not in time."""
        deadline = time.monotonic() + timeout_s
        while not condition() and time.monotonic() < deadline:
            rclpy.spin_once(self, timeout_sec=0.02)
        return condition()

    def is_heard(self) -> bool:
        """Whether the back-end that was started last is connected: who was killed is still counted for a while."""
        connected = min(self.odometry.get_subscription_count(), self.closures.get_subscription_count()) > 0
        return bool(self.values) and connected

    def drive(self, first: int, last: int) -> None:
        """Publish a part of the drive, with the closures that end there."""
        for k in range(first, last):
            message = Odometry(child_frame_id="base_link")
            message.header.stamp, message.header.frame_id = to_time((k + 1) * PERIOD_NS), "odom"
            message.pose.pose = to_pose(self.world.odometry[k])
            self.odometry.publish(message)
            for row, closure in enumerate(self.world.closures):
                if closure.second == k:
                    self.closures.publish(closure_to_message(self.world.message(row)))
            rclpy.spin_once(self, timeout_sec=0.005)

    def nonsense(self, count: int, rng: np.random.Generator) -> None:
        """Publish messages that nobody sends."""
        for number in range(count):
            if number % 3 == 0:
                self.reject.publish(String(data=TEXTS[rng.integers(len(TEXTS))]))
                continue
            message = Odometry(child_frame_id=FRAMES[rng.integers(len(FRAMES))])
            message.header.frame_id = FRAMES[rng.integers(len(FRAMES))]
            message.header.stamp.sec = int(rng.choice([0, 5, 2**31 - 1, -1]))
            message.pose.pose.position.x = ODD[rng.integers(len(ODD))]
            message.pose.pose.orientation.w = ODD[rng.integers(len(ODD))]
            message.pose.covariance = np.full(36, ODD[rng.integers(len(ODD))])
            (self.closures if number % 3 == 1 else self.odometry).publish(message)
            rclpy.spin_once(self, timeout_sec=0.002)


def start(results: Path, log: Path) -> subprocess.Popen[bytes]:
    """The back-end as a process of its own."""
    words = ["-p", f"results_dir:={results}", "-p", "pose_graph.max_gap_s:=3.0", "-p", "qos.reliability:=reliable"]
    command = [sys.executable, "-m", "umf_ros.nodes.pose_graph_node", "--ros-args", *words]
    with log.open("ab") as file:
        return subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)


def kill_back_end(folder: Path, kills: int, nonsense: int, rng: np.random.Generator) -> dict[str, Any]:
    """Kill the back-end while it works, start it again, and look for every verdict that it had given."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    rover = Rover(with_wrong_closures(rover_loops(40 * (kills + 2), 10003), 0.2, "groups", 1))
    results, log = folder / "back_end", folder / "back_end.log"
    crashes = 0
    for number in range(kills + 1):
        rover.values.clear()
        process = start(results, log)
        heard = rover.until(rover.is_heard)
        rover.drive(40 * number, 40 * (number + 1))
        if number < kills:
            rover.until(lambda: False, float(rng.uniform(0.0, 1.5)))
            crashes += process.poll() is not None or not heard
            process.kill()
            process.wait()
    before = dict(rover.values)
    rover.nonsense(nonsense, rng)
    rover.values.clear()
    rover.until(lambda: bool(rover.values), 30.0)
    refused = "closure refused", "reject_edge", "closure_frame", "pose", "stamp", "frame", "GraphError", "closure twice"
    counted = sum(int(float(count)) for name, count in rover.values.items() if name.startswith(refused))
    counted -= sum(int(float(count)) for name, count in before.items() if name.startswith(refused))
    counted += sum(int(float(rover.values.get(name, 0))) for name in ("odometry_out_of_line", "accepted", "waiting"))
    stall_ms = float(rover.values.get("executor_stall_max_ms", "nan"))
    crashes += process.poll() is not None
    asked = time.monotonic()
    process.send_signal(signal.SIGINT)
    crashes += process.wait(60) != 0
    shutdown_s = time.monotonic() - asked
    crashes += log.read_text(errors="replace").count("Traceback")
    kept = GraphJournal(results / "pose_graph.sqlite")
    stored = {f"keyframe/{match} keyframe/{query}" for match, query in kept.verdicts()}
    kept.close()
    with (results / "graph_verdicts.csv").open() as file:
        written = {f"keyframe/{row['match_stamp_ns']} keyframe/{row['query_stamp_ns']}" for row in csv.DictReader(file)}
    rover.destroy_node()
    rclpy.shutdown()
    return {
        "backend_kills": kills,
        "lost_verdicts": len(rover.decided - (stored & written)),
        "fuzz_over_dds": nonsense,
        "crashes_over_dds": crashes,
        "uncounted_over_dds": max(0, nonsense - counted),
        "executor_stall_max_ms": round(stall_ms, 1),
        "shutdown_s": round(shutdown_s, 2),
    }


def play_live(bag: Path, folder: Path) -> dict[str, float | None]:
    """Milliseconds from the stamp of a scan to its closure, by the recording's clock, at its own pace."""
    run = folder / "live"
    run.mkdir()
    rclpy.init()
    ears = Node("endurance_ears", parameter_overrides=[Parameter("use_sim_time", value=True)])
    delays_ms: list[float] = []

    def hear(message: Odometry) -> None:
        delays_ms.append((ears.get_clock().now().nanoseconds - from_time(message.header.stamp)) * 1e-6)

    ears.create_subscription(Odometry, "/loop_closures", hear, CLOSURES_QOS)
    spinning = threading.Thread(target=rclpy.spin, args=(ears,), daemon=True)
    spinning.start()
    with LiveGraph(run, Console(stderr=True)) as graph:
        graph.play(bag, open_bag(bag).duration_s, 1.0)
    rclpy.shutdown()
    if not delays_ms:
        return {"live_p50_ms": None, "live_p95_ms": None}
    p50, p95 = np.percentile(delays_ms, [50, 95])
    return {"live_p50_ms": round(float(p50), 1), "live_p95_ms": round(float(p95), 1)}
