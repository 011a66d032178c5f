"""Endurance tests of the live nodes, for `endurance.py`: kill -9, nonsense, each other, backlogs, a restart."""

from __future__ import annotations

import csv
import sqlite3
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from live_nodes import (
    BACK_END,
    DISCOVERY_S,
    FRONT_END,
    MANY,
    Ears,
    Figures,
    NodeUnderTest,
    Rover,
    later,
    listening,
    own_domain,
    play,
)
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rich.console import Console
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from std_msgs.msg import String

from umf_ros.core.config import load_settings, topics_of
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import expmap
from umf_ros.durable_graph import DurableGraph
from umf_ros.graph_process import JOURNAL
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld, rover_loops, with_wrong_closures
from umf_ros.nodes.conversions import CLOSURES_QOS
from umf_ros.sensors.decode import OdometrySample

Topics = dict[str, tuple[type, str, QoSProfile]]
Pairs = set[tuple[int, int]]
Rng = np.random.Generator
FIRST_LOOP = 215
"""Poses until the first loops of the world are closed."""
SPARSE: dict[str, object] = {"pose_graph.max_gap_s": 3.0}


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a table."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def pairs_of(path: Path) -> list[tuple[int, int]]:
    """Stamps of match and query in a table."""
    return [(int(row["match_stamp_ns"]), int(row["query_stamp_ns"])) for row in rows_of(path)]


def _journal(folder: Path, query: str) -> list[Any]:
    with closing(sqlite3.connect(folder / JOURNAL)) as kept:
        return kept.execute(query).fetchall()


def _fresh(folder: Path, name: str) -> Path:
    """A folder of its own: one that is used again is gone on with."""
    return Path(tempfile.mkdtemp(prefix=f"{name}_", dir=folder))


def kill_back_end(folder: Path, kills: int, rng: Rng) -> Figures:
    """Kill the back-end while it works, start it again, and look for every verdict that it had given."""
    seed = int(rng.integers(10_000, 20_000))
    results = folder / f"back_end_{seed}"
    last = FIRST_LOOP + 40 * (kills + 1)
    world = with_wrong_closures(rover_loops(last, seed), 0.2, "groups", 1)
    cuts, crashes = [0, *range(FIRST_LOOP, last, 40)], 0
    with listening() as ears:
        rover = Rover(ears, world)
        for number in range(kills + 1):
            node = NodeUnderTest(BACK_END, results, SPARSE)
            crashes += not ears.anew(BACK_END)
            ears.wait(0.5)  # the other way round, discovery may take a little longer
            deque(rover.drive(range(cuts[number], cuts[number + 1])), maxlen=0)
            if number < kills:
                ears.wait(float(rng.uniform(0.0, 1.5)))
                crashes += not node.is_alive
                node.kill()
        ears.wait(2.0)
        shutdown_s, faults = node.end()
    stored: Pairs = set(_journal(results, "SELECT match_ns, query_ns FROM verdict"))
    return {
        "backend_kills": kills,
        "verdicts": len(ears.verdicts),
        "lost_verdicts": len(ears.verdicts.keys() - (stored & set(pairs_of(results / "graph_verdicts.csv")))),
        "fuzz_crashes": crashes + faults,
        "shutdown_s": round(shutdown_s, 2),
    }


ORDERS = ((BACK_END,), (FRONT_END,), (BACK_END, FRONT_END), (FRONT_END, BACK_END))
"""Nodes that are killed one after the other, before those that were killed start again."""


def kill_both(folder: Path, kills: int, bag: Path, config: Path, rng: Rng) -> Figures:
    """Kill front-end and back-end in every order while a recording is played, at last both, and start them again.

    Every keyframe that was announced has to be on disk then and every closure in the front-end's table needs a verdict;
    nothing may count twice.
    """
    results = _fresh(folder, "both")
    parameters: dict[str, object] = {"database.path": results / "places.sqlite", "dataset": "simulated"}
    crashes, nodes = 0, dict[str, NodeUnderTest]()
    with listening() as ears:
        player = play(bag, "--rate", "0.25")
        for number in range(kills + 2):
            for name in (FRONT_END, BACK_END):
                if name not in nodes:
                    nodes[name] = NodeUnderTest(name, results, parameters, config=config)
                    crashes += not ears.anew(name)
            enough = len(ears.closures) + 2
            if number <= kills:
                ears.until(lambda: len(ears.closures) >= enough or player.poll() is not None, 60.0)  # noqa: B023 (at once)
            for name in ORDERS[number % len(ORDERS)] if number < kills else ():
                ears.wait(float(rng.uniform(0.0, 2.0)))
                crashes += not nodes[name].is_alive
                nodes.pop(name).kill()
                ears.wait(float(rng.uniform(1.0, 4.0)))
            if number == kills:
                player.kill()
                for node in nodes.values():
                    node.kill()
                nodes.clear()
        ears.wait(3.0)
        ends = [node.end() for node in nodes.values()]
    events = Counter(_journal(results, "SELECT first_ns, second_ns, data FROM event WHERE kind = 'closure'"))
    keyframes = Counter((int(row["stamp_ns"]), row["session"]) for row in rows_of(results / "keyframes.csv"))
    with closing(sqlite3.connect(f"file:{results / 'places.sqlite'}?mode=ro", uri=True)) as places:
        stored = {stamp for (stamp,) in places.execute("SELECT stamp_ns FROM keyframe")}
    found, decided = (pairs_of(results / name) for name in ("closures.csv", "graph_verdicts.csv"))
    return {
        "kills": kills,
        "keyframes": len(ears.keyframes),
        "lost_keyframes": len(ears.keyframes - stored - {stamp for stamp, _ in keyframes}),
        "duplicate_closures": len(found) - len(set(found)) + keyframes.total() - len(keyframes),
        "closures": len(set(found)),
        "closures_without_verdict": len(set(found) - set(decided)),
        "closures_twice": events.total() - len(events),
        "fuzz_crashes": crashes + sum(faults for _, faults in ends),
        "shutdown_s": round(max(seconds for seconds, _ in ends), 2),
    }


ODD = [float("nan"), float("inf"), -1.0, 1e300, 1e-300, 0.0]
TEXTS = ["keyframe/" + "9" * 5000 + " keyframe/1", "", "keyframe/-1 keyframe/2", "x" * 100_000, "keyframe/1 keyframe/2"]
FRAMES = ["keyframe/" + "9" * 5000, "", "keyframe/99999999999999999999", "keyframe/1", "odom", "\u2603"]
SECONDS = [0, 5, 2**31 - 1, -1]
SIZES = [0, 1, 688, 512, 2**31, 2**32 - 1]


def fuzz_back_end(folder: Path, count: int, rng: Rng) -> Figures:
    """Messages to the back-end that no front-end sends: each has to show in the diagnostics, by what became of it."""

    def missing(ears: Ears, sent: Counter[str]) -> float:
        fate = ears.values.get(BACK_END, {}).get("pose graph", {})
        graph = {name: float(value) for name, value in fate.items() if value.replace(".", "").isdigit()}
        states = ("accepted", "rejected", "pending", "refused", "closure twice")
        odometry = sum(value for name, value in graph.items() if name.startswith("odometry"))
        refused = {name: ears.value(BACK_END, f"input {name}", "refused") for name in ("odometry", "closures")}
        found = {
            "odometry": odometry + refused["odometry"],
            "closures": sum(graph.get(name, 0) for name in states) + refused["closures"],
            "reject": graph.get("reject_edge", 0) + graph.get("GraphError", 0),
        }
        return sum(abs(sent[kind] - found[kind]) for kind in sent)

    topics: Topics = {
        "odometry": (Odometry, "/odom", MANY),
        "closures": (Odometry, "/loop_closures", CLOSURES_QOS),
        "reject": (String, f"/{BACK_END}/reject_edge", MANY),
    }
    return _fuzz(folder, BACK_END, topics, missing, count, rng, None)


def fuzz_front_end(folder: Path, count: int, config: Path, rng: Rng) -> Figures:
    """Messages to the front-end that no sensor sends: each has to show in the diagnostics of its input."""
    topics = topics_of(load_settings())
    kinds = {"left_image": Image, "right_image": Image, "left_info": CameraInfo, "right_info": CameraInfo}
    kinds |= {"cloud": PointCloud2, "odometry": Odometry}

    def missing(ears: Ears, sent: Counter[str]) -> float:
        total = sum(abs(sent[name] - ears.value(FRONT_END, f"input {name}", "received")) for name in kinds)
        decoded = {"left_image": "left", "right_image": "right", "cloud": "cloud", "odometry": "odometry"}
        held = 1  # the newest may wait for one that agrees with it
        fates = {name: ears.value(FRONT_END, "detector", f"{short}_received") for name, short in decoded.items()}
        return total + sum(max(0.0, abs(sent[name] - counted) - held) for name, counted in fates.items())

    named: Topics = {name: (kind, getattr(topics, name), MANY) for name, kind in kinds.items()}
    return _fuzz(folder, FRONT_END, named, missing, count, rng, config)


def _fuzz(
    folder: Path,
    node_name: str,
    topics: Topics,
    missing: Callable[[Ears, Counter[str]], float],
    count: int,
    rng: Rng,
    config: Path | None,
) -> Figures:
    """Send odd messages of every kind in turn; `missing` says how many of them are not accounted for."""
    with listening() as ears:
        publishers = {name: ears.create_publisher(*topic) for name, topic in topics.items()}
        node = NodeUnderTest(node_name, _fresh(folder, node_name), {}, config=config)
        crashes = int(not ears.anew(node_name))
        ears.until(lambda: all(publisher.get_subscription_count() for publisher in publishers.values()), 10.0)
        ears.wait(DISCOVERY_S)
        sent: Counter[str] = Counter()
        for number in range(count):
            name = list(topics)[number % len(topics)]
            publishers[name].publish(_odd(topics[name][0], rng))
            sent[name] += 1
            ears.wait(0.002)
        ears.wait(5.0)
        lost = missing(ears, sent)
        crashes += not node.is_alive
        shutdown_s, faults = node.end()
    if lost:
        told = f"{node_name}: sent {dict(sent)}, found {ears.values.get(node_name)}"
        Console(stderr=True).print(told, markup=False)
    figures: Figures = {"fuzz_messages": count, "fuzz_crashes": crashes + faults, "fuzz_uncounted": round(lost)}
    return figures | {"shutdown_s": round(shutdown_s, 2)}


def _odd(kind: type, rng: Rng) -> Any:
    """A message with impossible sizes, kinds, names and numbers."""
    if kind is String:
        return String(data=TEXTS[rng.integers(len(TEXTS))])
    message = kind()
    if kind is Odometry:
        message.child_frame_id = FRAMES[rng.integers(len(FRAMES))]
    message.header.frame_id = FRAMES[rng.integers(len(FRAMES))]
    message.header.stamp.sec = int(rng.choice(SECONDS))
    if kind is Odometry:
        message.pose.pose.position.x = ODD[rng.integers(len(ODD))]
        message.pose.pose.orientation.w = ODD[rng.integers(len(ODD))]
        message.pose.covariance = np.full(36, ODD[rng.integers(len(ODD))])
        return message
    message.height, message.width = (int(size) for size in rng.choice(SIZES, 2))
    if kind is CameraInfo:
        message.k = np.full(9, ODD[rng.integers(len(ODD))])
        message.p = np.full(12, ODD[rng.integers(len(ODD))])
        return message
    message.data = rng.integers(0, 256, int(rng.integers(0, 5000)), np.uint8).tobytes()
    if kind is Image:
        message.encoding = str(rng.choice(["mono8", "", "bgr8", "mono16", "yuv422", "x" * 9999]))
        message.step = int(rng.choice(SIZES))
        return message
    message.fields = [
        PointField(name=name, offset=int(rng.choice(SIZES)), datatype=int(datatype), count=int(rng.choice([0, 1])))
        for name, datatype in zip(("x", "y", "z", "t"), rng.integers(0, 12, 4), strict=True)
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
    found: Figures = {"fuzz_crashes": crashes}
    found["crossed_closures"] = sum(len(one.verdicts.keys() - one.closures) for one in ears.values())
    for name, one in ears.items():
        found |= {f"{name}_closures": len(one.closures), f"{name}_verdicts": len(one.verdicts)}
    return found


SEED, FAR_NS = 10005, 10**15
"""Of the world; stamps of closures that never get odometry begin there."""


def backlogs(folder: Path, number: int = 10_000, latched: int = 5000) -> Figures:
    """Seconds to the next decision and of Ctrl-C after closures that wait, contradict, repeat, or came before it.

    A kind of closure is sent to a back-end that knows the odometry, then one right closure; the latched ones are sent
    before the back-end starts.
    """
    world, rng = rover_loops(500, SEED), np.random.default_rng(1)
    right = [later(world, row) for row in range(len(world.closures))]
    alike = [replace(right[0], match_stamp_ns=FAR_NS + k, query_stamp_ns=FAR_NS + 10**11 + k) for k in range(number)]
    ends = np.sort(rng.integers(1, 500, (number, 2)), axis=1) * PERIOD_NS
    pairs = zip(alike, ends.tolist(), strict=True)
    wrong = [replace(one, match_stamp_ns=match, query_stamp_ns=query) for one, (match, query) in pairs]
    kinds = {
        "waiting": alike,
        "contradicting": [one for one in wrong if one.query_stamp_ns > one.match_stamp_ns],
        "repeated": [right[1]] * number,
        "refused": [replace(one, covariance=np.zeros((6, 6))) for one in alike],
        "latched": alike[:latched],
    }
    figures: Figures = {"fuzz_crashes": 0}
    for name, closures in kinds.items():
        found = _backlog(folder / f"backlog_{name}", world, closures, right[-1], name == "latched")
        figures["fuzz_crashes"] += found.pop("fuzz_crashes")
        figures |= {f"{key}_{name}_s" if key != "lines" else f"lines_{name}": value for key, value in found.items()}
    return figures


def _backlog(folder: Path, world: GraphWorld, closures: list[LoopClosure], right: LoopClosure, early: bool) -> Figures:
    with listening() as ears:
        rover = Rover(ears, world)

        def send() -> None:
            for row, closure in enumerate(closures):
                rover.send(closure)
                if row % 20 == 0:
                    ears.spin_once(0.005)

        if early:
            send()
        node = NodeUnderTest(BACK_END, folder, SPARSE)
        ears.anew(BACK_END)
        ears.until(rover.odometry.get_subscription_count)
        ears.wait(DISCOVERY_S)
        deque(rover.drive(range(len(world.odometry)), close=False), maxlen=0)
        ears.until(lambda: ears.value(BACK_END, "pose graph", "odometry") >= len(world.odometry) - 5, 20.0)
        if not early:
            send()
        sent_s = time.time()
        rover.send(right)
        ears.until(lambda: right.pair in ears.decided, 120.0)
        decision_s = ears.decided.get(right.pair, float("inf")) - sent_s
        shutdown_s, faults = node.end()
    lines = len(node.log.read_text(errors="replace").splitlines())
    times = {"decision": round(decision_s, 2), "sigint": round(shutdown_s, 2)}
    return times | {"lines": lines, "fuzz_crashes": faults}


def restart(folder: Path, hours: float = 8.0, rate_hz: float = 25.0) -> Figures:
    """Seconds of a restart after hours of odometry, by the clock on the wall and of CPU."""
    path, settings = folder / "hours.sqlite", load_settings(None, pose_graph__max_gap_s=3.0).pose_graph
    path.unlink(missing_ok=True)
    graph, count = DurableGraph(settings, path, lambda _: None), int(hours * 3600 * rate_hz)
    turns = 2 * np.pi * np.arange(count) / (600 * rate_hz)
    poses = expmap(np.stack([*np.zeros((2, count)), turns, *np.zeros((3, count))], axis=1))
    poses[:, 0, 3], poses[:, 1, 3] = 10 + 50 * np.sin(turns), 50 * (1 - np.cos(turns))
    stamps = 10**9 + (np.arange(count) * 1e9 / rate_hz).astype(np.int64)
    for first in range(0, count, 500):
        rows = slice(first, first + 500)
        graph.take([OdometrySample(*one) for one in zip(stamps[rows].tolist(), poses[rows], strict=True)])
    graph.close()
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    DurableGraph(settings, path, lambda _: None).close()
    found = {"restart_s_8h": time.perf_counter() - wall_s, "restart_cpu_s_8h": time.process_time() - cpu_s}
    return {name: round(value, 2) for name, value in found.items()} | {"log_mb_8h": round(path.stat().st_size / 1e6)}
