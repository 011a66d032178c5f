"""Endurance tests of the live nodes, for `endurance.py`: kill -9, nonsense, each other, speed."""

from __future__ import annotations

import csv
import sqlite3
import tempfile
import threading
from collections import Counter
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from endurance_nodes import BACK_END, FRONT_END, Ears, NodeUnderTest, own_domain, play
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rich.console import Console
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from std_msgs.msg import String

from umf_ros.bags.reader import open_bag
from umf_ros.core.config import load_settings, topics_of
from umf_ros.graph_process import JOURNAL
from umf_ros.lab.live.live_graph import LiveGraph
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld, rover_loops, with_wrong_closures
from umf_ros.nodes.conversions import CLOSURES_QOS, closure_to_message, from_time, to_pose, to_time

Figures = dict[str, Any]
ODD = [float("nan"), float("inf"), -1.0, 1e300, 1e-300, 0.0]
TEXTS = ["keyframe/" + "9" * 5000 + " keyframe/1", "", "keyframe/-1 keyframe/2", "x" * 100_000, "keyframe/1 keyframe/2"]
FRAMES = ["keyframe/" + "9" * 5000, "", "keyframe/99999999999999999999", "keyframe/1", "odom", "\u2603"]
SECONDS = [0, 5, 2**31 - 1, -1]
SIZES = [0, 1, 688, 512, 2**31, 2**32 - 1]
MANY = QoSProfile(depth=500)
FIRST_LOOP = 215
DISCOVERY_S = 1.0
"""The writer knows its reader before the reader knows it, and messages sent between are lost."""
"""Poses until the first loops of the world are closed."""


class Rover:
    """Odometry and front-end of a rover."""

    def __init__(self, ears: Ears, world: GraphWorld) -> None:
        self._ears, self._world = ears, world
        self._odometry = ears.create_publisher(Odometry, "/odom", MANY)
        self._closures = ears.create_publisher(Odometry, "/loop_closures", CLOSURES_QOS)

    def drive(self, first: int, last: int) -> None:
        """Publish a part of the drive, with the closures that end there."""
        for k in range(first, last):
            message = Odometry(child_frame_id="base_link")
            message.header.stamp, message.header.frame_id = to_time((k + 1) * PERIOD_NS), "odom"
            message.pose.pose = to_pose(self._world.odometry[k])
            self._odometry.publish(message)
            for row, closure in enumerate(self._world.closures):
                if closure.second == k:
                    self._closures.publish(closure_to_message(self._world.message(row)))
            self._ears.spin_once(0.002)


def kill_back_end(folder: Path, kills: int, rng: np.random.Generator) -> Figures:
    """Kill the back-end while it works, start it again, and look for every verdict that it had given."""
    seed = int(rng.integers(10_000, 20_000))
    results = folder / f"back_end_{seed}"
    world = with_wrong_closures(rover_loops(FIRST_LOOP + 40 * (kills + 1), seed), 0.2, "groups", 1)
    cuts = [0, *range(FIRST_LOOP, FIRST_LOOP + 40 * (kills + 1), 40)]
    crashes = 0
    with own_domain():
        ears = Ears()
        rover = Rover(ears, world)
        for number in range(kills + 1):
            node = NodeUnderTest(BACK_END, results, {"pose_graph.max_gap_s": 3.0})
            crashes += not ears.anew(BACK_END)
            ears.wait(0.5)  # the other way round, discovery may take a little longer
            rover.drive(cuts[number], cuts[number + 1])
            if number < kills:
                ears.wait(float(rng.uniform(0.0, 1.5)))
                crashes += not node.is_alive
                node.kill()
        ears.wait(2.0)
        shutdown_s, status = node.stop()
        ears.destroy_node()
    crashes += (status != 0) + node.tracebacks()
    with closing(sqlite3.connect(results / JOURNAL)) as kept:
        stored = set(kept.execute("SELECT match_ns, query_ns FROM verdict"))
    with (results / "graph_verdicts.csv").open(newline="") as file:
        written = {(int(row["match_stamp_ns"]), int(row["query_stamp_ns"])) for row in csv.DictReader(file)}
    return {
        "backend_kills": kills,
        "verdicts": len(ears.verdicts),
        "lost_verdicts": len(ears.verdicts.keys() - (stored & written)),
        "fuzz_crashes": crashes,
        "shutdown_s": round(shutdown_s, 2),
    }


def kill_front_end(folder: Path, kills: int, bag: Path, config: Path, rng: np.random.Generator) -> Figures:
    """Kill the front-end while a recording is played over and over; all that it announced has to be on disk."""
    results = folder / f"front_end_{int(rng.integers(10**9))}"
    parameters: dict[str, object] = {"database.path": results / "places.sqlite"}
    crashes = 0
    with own_domain():
        ears = Ears()
        player = play(bag, "--loop", "--rate", "2")
        for number in range(kills + 1):
            node = NodeUnderTest(FRONT_END, results, parameters, config=config)
            crashes += not ears.anew(FRONT_END)
            enough = len(ears.keyframes) + 5
            crashes += not ears.until(partial(ears.has_heard, enough), 60.0)
            ears.wait(float(rng.uniform(0.0, 4.0)))
            if number < kills:
                crashes += not node.is_alive
                node.kill()
        shutdown_s, status = node.stop()
        player.kill()
        player.wait()
        ears.wait(0.5)
        ears.destroy_node()
    crashes += (status != 0) + node.tracebacks()
    with (results / "keyframes.csv").open(newline="") as file:
        rows = Counter((int(row["stamp_ns"]), row["session"]) for row in csv.DictReader(file))
    with (results / "closures.csv").open(newline="") as file:
        pairs = Counter((row["match_stamp_ns"], row["query_stamp_ns"]) for row in csv.DictReader(file))
    stored = {stamp for stamp, _ in rows} | _stored_places(results / "places.sqlite")
    return {
        "kills": kills,
        "keyframes": len(ears.keyframes),
        "lost_keyframes": len(ears.keyframes - stored),
        "duplicate_closures": pairs.total() - len(pairs) + rows.total() - len(rows),
        "fuzz_crashes": crashes,
        "shutdown_s": round(shutdown_s, 2),
    }


ORDERS = ((BACK_END,), (FRONT_END,), (BACK_END, FRONT_END), (FRONT_END, BACK_END))
"""Nodes that are killed one after the other, before those that were killed start again."""


def kill_both(folder: Path, kills: int, bag: Path, config: Path, rng: np.random.Generator) -> Figures:
    """Kill front-end and back-end in every order while a recording is played, at last both, and start them again.

    Every closure in the front-end's table needs a verdict then, and no closure may count twice.
    """
    results = _fresh(folder, "both")
    parameters: dict[str, object] = {"database.path": results / "places.sqlite", "dataset": "simulated"}
    crashes, nodes = 0, dict[str, NodeUnderTest]()
    with own_domain():
        ears, player = Ears(), play(bag, "--rate", "0.25")
        for number in range(kills + 1):
            for name in (FRONT_END, BACK_END):
                if name not in nodes:
                    nodes[name] = NodeUnderTest(name, results, parameters, config=config)
                    crashes += not ears.anew(name)
            enough = len(ears.closures) + 2
            ears.until(lambda: len(ears.closures) >= enough or player.poll() is not None, 60.0)  # noqa: B023 (at once)
            for name in ORDERS[number % len(ORDERS)] if number < kills else ():
                ears.wait(float(rng.uniform(0.0, 2.0)))
                crashes += not nodes[name].is_alive
                nodes.pop(name).kill()
                ears.wait(float(rng.uniform(1.0, 4.0)))
        player.kill()
        for node in nodes.values():
            node.kill()
        nodes = {name: NodeUnderTest(name, results, parameters, config=config) for name in (FRONT_END, BACK_END)}
        crashes += sum(not ears.anew(name) for name in nodes)
        ears.wait(3.0)
        stopped = [node.stop() for node in nodes.values()]
        ears.destroy_node()
    crashes += sum(status != 0 for _, status in stopped) + sum(node.tracebacks() for node in nodes.values())
    with closing(sqlite3.connect(results / JOURNAL)) as kept:
        stored = Counter(kept.execute("SELECT first_ns, second_ns, data FROM event WHERE kind = 'closure'"))
    found, decided = (_pairs(results / name) for name in ("closures.csv", "graph_verdicts.csv"))
    return {
        "kills": kills,
        "closures": len(found),
        "closures_without_verdict": len(found - decided),
        "closures_twice": stored.total() - len(stored),
        "fuzz_crashes": crashes,
        "shutdown_s": round(max(seconds for seconds, _ in stopped), 2),
    }


def _pairs(path: Path) -> set[tuple[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return {(row["match_stamp_ns"], row["query_stamp_ns"]) for row in csv.DictReader(file)}


def _stored_places(path: Path) -> set[int]:
    with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as connection:
        return {stamp for (stamp,) in connection.execute("SELECT stamp_ns FROM keyframe")}


def _fresh(folder: Path, name: str) -> Path:
    """A folder of its own: one that is used again is gone on with."""
    return Path(tempfile.mkdtemp(prefix=f"{name}_", dir=folder))


def fuzz_back_end(folder: Path, count: int, rng: np.random.Generator) -> Figures:
    """Messages to the back-end that no front-end sends: each has to show in the diagnostics, by what became of it."""
    with own_domain():
        ears = Ears()
        publishers: list[Any] = [
            ears.create_publisher(Odometry, "/odom", MANY),
            ears.create_publisher(Odometry, "/loop_closures", CLOSURES_QOS),
            ears.create_publisher(String, f"/{BACK_END}/reject_edge", MANY),
        ]
        node = NodeUnderTest(BACK_END, _fresh(folder, BACK_END), {})
        crashes = 0 if ears.anew(BACK_END) else 1
        ears.until(lambda: all(publisher.get_subscription_count() for publisher in publishers), 10.0)
        ears.wait(DISCOVERY_S)
        sent: Counter[str] = Counter()
        for number in range(count):
            kind = ("odometry", "closures", "reject")[number % 3]
            message = String(data=TEXTS[rng.integers(len(TEXTS))]) if kind == "reject" else _odd_odometry(rng)
            publishers[number % 3].publish(message)
            sent[kind] += 1
            ears.wait(0.002)
        ears.wait(5.0)
        fate = ears.values.get(BACK_END, {}).get("pose graph", {})
        graph = {name: float(value) for name, value in fate.items() if value.replace(".", "").isdigit()}
        states = ("accepted", "rejected", "pending", "refused")
        odometry = sum(value for name, value in graph.items() if name.startswith("odometry"))
        odometry += ears.value(BACK_END, "input odometry", "refused")
        closures = sum(graph.get(name, 0) for name in (*states, "closure twice"))
        closures += ears.value(BACK_END, "input closures", "refused")
        rejects = graph.get("reject_edge", 0) + graph.get("GraphError", 0)
        found = {"odometry": odometry, "closures": closures, "reject": rejects}
        missing = {kind: abs(sent[kind] - found[kind]) for kind in sent}
        crashes += not node.is_alive
        shutdown_s, status = node.stop()
        ears.destroy_node()
    if any(missing.values()):
        Console(stderr=True).print(f"back-end: sent {dict(sent)}, found {found} in {fate}", markup=False)
    crashes += (status != 0) + node.tracebacks()
    return {
        "fuzz_messages": count,
        "fuzz_crashes": crashes,
        "fuzz_uncounted": round(sum(missing.values())),
        "shutdown_s": round(shutdown_s, 2),
    }


def fuzz_front_end(folder: Path, count: int, config: Path, rng: np.random.Generator) -> Figures:
    """Messages to the front-end that no sensor sends: each has to show in the diagnostics of its input."""
    topics = topics_of(load_settings())
    kinds = {"left_image": Image, "right_image": Image, "left_info": CameraInfo, "right_info": CameraInfo}
    kinds |= {"cloud": PointCloud2, "odometry": Odometry}
    with own_domain():
        ears = Ears()
        publishers = {name: ears.create_publisher(kind, getattr(topics, name), MANY) for name, kind in kinds.items()}
        node = NodeUnderTest(FRONT_END, _fresh(folder, FRONT_END), {}, config=config)
        crashes = 0 if ears.anew(FRONT_END) else 1
        ears.until(lambda: all(publisher.get_subscription_count() for publisher in publishers.values()), 10.0)
        ears.wait(DISCOVERY_S)
        sent: Counter[str] = Counter()
        for number in range(count):
            name = list(kinds)[number % len(kinds)]
            publishers[name].publish(_odd(kinds[name], rng))
            sent[name] += 1
            ears.wait(0.002)
        ears.wait(5.0)
        missing = 0.0
        decoded = {"left_image": "left", "right_image": "right", "cloud": "cloud", "odometry": "odometry"}
        for name in kinds:
            missing += abs(sent[name] - ears.value(FRONT_END, f"input {name}", "received"))
            if name in decoded:  # and once more, by its fate
                held = 1  # the newest may wait for one that agrees with it
                counted = ears.value(FRONT_END, "detector", f"{decoded[name]}_received")
                missing += max(0.0, abs(sent[name] - counted) - held)
        crashes += not node.is_alive
        shutdown_s, status = node.stop()
        ears.destroy_node()
    if missing:
        Console(stderr=True).print(f"front-end: sent {dict(sent)}, found {ears.values.get(FRONT_END)}", markup=False)
    crashes += (status != 0) + node.tracebacks()
    return {
        "fuzz_messages": count,
        "fuzz_crashes": crashes,
        "fuzz_uncounted": round(missing),
        "shutdown_s": round(shutdown_s, 2),
    }


def _odd_odometry(rng: np.random.Generator) -> Odometry:
    message = Odometry(child_frame_id=FRAMES[rng.integers(len(FRAMES))])
    message.header.frame_id = FRAMES[rng.integers(len(FRAMES))]
    message.header.stamp.sec = int(rng.choice(SECONDS))
    message.pose.pose.position.x = ODD[rng.integers(len(ODD))]
    message.pose.pose.orientation.w = ODD[rng.integers(len(ODD))]
    message.pose.covariance = np.full(36, ODD[rng.integers(len(ODD))])
    return message


def _odd(kind: type, rng: np.random.Generator) -> Any:
    """A message of a sensor with impossible sizes, kinds and numbers."""
    if kind is Odometry:
        return _odd_odometry(rng)
    message = kind()
    message.header.frame_id = FRAMES[rng.integers(len(FRAMES))]
    message.header.stamp.sec = int(rng.choice(SECONDS))
    message.height, message.width = (int(size) for size in rng.choice(SIZES, 2))
    if kind is CameraInfo:
        message.k = np.full(9, ODD[rng.integers(len(ODD))])
        message.p = np.full(12, ODD[rng.integers(len(ODD))])
        return message
    message.data = rng.integers(0, 256, int(rng.integers(0, 5000)), np.uint8).tobytes()
    if kind is Image:
        message.encoding = str(rng.choice(["mono8", "", "bgr8", "mono16", "yuv422", "x" * 9999]))
        message.step = int(rng.choice(SIZES))
    else:
        names, datatypes = ["x", "y", "z", "t"], rng.integers(0, 12, 4)
        message.fields = [
            PointField(name=name, offset=int(rng.choice(SIZES)), datatype=int(datatype), count=int(rng.choice([0, 1])))
            for name, datatype in zip(names, datatypes, strict=True)
        ]
        message.point_step, message.row_step = int(rng.choice(SIZES)), int(rng.choice(SIZES))
    return message


def two_robots(folder: Path, bag: Path, config: Path) -> Figures:
    """Two whole robots live at once, with keyframes of their own: no closure may cross."""
    topics = tuple(topic for topic in topics_of(load_settings()).model_dump().values() if topic)
    with own_domain():
        ears = {name: Ears(name) for name in ("red", "blue")}
        nodes = [
            NodeUnderTest(kind, folder / name / kind, {"keyframe.min_translation_m": apart_m}, name, config)
            for name, apart_m in zip(ears, (0.2, 0.33), strict=True)
            for kind in (FRONT_END, BACK_END)
        ]
        together = next(iter(ears.values()))
        names = [f"{name}/{kind}" for name in ears for kind in (FRONT_END, BACK_END)]
        crashes = int(not together.until(lambda: all(name in together.values for name in names)))
        rates = zip(ears, ("1", "1.5"), strict=True)
        players = [play(bag, "--rate", rate, moved_to=name, topics=topics) for name, rate in rates]
        while any(player.poll() is None for player in players):
            for one in ears.values():
                one.wait(0.05)
        for one in ears.values():
            one.wait(2.0)
        crashes += sum(node.stop()[1] != 0 for node in nodes)
        for one in ears.values():
            one.wait(0.5)
            one.destroy_node()
    crossed = sum(len(one.verdicts.keys() - one.closures) for one in ears.values())
    return {
        "fuzz_crashes": crashes,
        "crossed_closures": crossed,
        "red_closures": len(ears["red"].closures),
        "blue_closures": len(ears["blue"].closures),
        "red_verdicts": len(ears["red"].verdicts),
        "blue_verdicts": len(ears["blue"].verdicts),
    }


def play_live(folder: Path, bag: Path, config: Path) -> Figures:
    """Milliseconds from the stamp of a scan to its closure, by the recording's clock, at its own pace."""
    run = _fresh(folder, "live")
    delays_ms: list[float] = []
    with own_domain():
        ears = Ears()
        clock = Node("endurance_clock", parameter_overrides=[Parameter("use_sim_time", value=True)])

        def hear(message: Odometry) -> None:
            delays_ms.append((clock.get_clock().now().nanoseconds - from_time(message.header.stamp)) * 1e-6)

        clock.create_subscription(Odometry, "/loop_closures", hear, CLOSURES_QOS)
        executor = SingleThreadedExecutor()
        executor.add_node(clock)
        threading.Thread(target=_spin, args=(executor,), daemon=True).start()
        with LiveGraph(run, Console(stderr=True, quiet=True), config) as graph:
            listening = threading.Thread(target=ears.until, args=(lambda: not graph.is_running, 3600.0), daemon=True)
            listening.start()
            graph.play(bag, open_bag(bag).duration_s, 1.0)
        listening.join()
        seconds = graph.seconds_to_stop
    figures: Figures = {"live_p50_ms": None, "live_p95_ms": None}
    if delays_ms:
        p50, p95 = np.percentile(delays_ms, [50, 95])
        figures = {"live_p50_ms": round(float(p50), 1), "live_p95_ms": round(float(p95), 1)}
    stalls = {"front_end": ears.value(FRONT_END, "detector", "executor_stall_max_ms")}
    stalls["back_end"] = ears.value(BACK_END, "pose graph", "executor_stall_max_ms")
    return figures | {
        "live_closures": len(delays_ms),
        "front_end_memory_mb": round(ears.value(FRONT_END, "detector", "memory_mb")),
        "keyframe_p50_ms": _median_ms(run / "latencies.csv"),
        "front_end_stall_ms": round(stalls["front_end"], 1),
        "back_end_stall_ms": round(stalls["back_end"], 1),
        "executor_stall_max_ms": round(max(stalls.values()), 1),
        "shutdown_s": round(max(seconds.values(), default=float("nan")), 2),
    }


def _spin(executor: SingleThreadedExecutor) -> None:
    with suppress(ExternalShutdownException):  # the domain ends first
        executor.spin()


def _median_ms(path: Path) -> float:
    """Median of the milliseconds of a keyframe, of those that had candidates."""
    with path.open(encoding="utf-8", newline="") as file:
        times = [float(row["total"]) for row in csv.DictReader(file) if float(row["verify"]) > 1.0]
    return round(float(np.median(times)), 1) if times else float("nan")
