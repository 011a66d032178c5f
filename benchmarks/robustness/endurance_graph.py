"""A pose graph of a long way, for `endurance.py`: what an event costs, and what the live node makes of it."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from endurance_live import DISCOVERY_S, MANY
from endurance_nodes import BACK_END, Ears, NodeUnderTest, own_domain
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger

from umf_ros.absolute.measurement import AbsoluteMeasurement, Aid
from umf_ros.core.config import load_settings
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, expmap, from_enu
from umf_ros.core.io import memory_mb
from umf_ros.durable_graph import DurableGraph
from umf_ros.graph_process import JOURNAL
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld, rover_loops
from umf_ros.nodes.conversions import CLOSURES_QOS, closure_to_message, to_pose, to_time
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import ClosureReason, State
from umf_ros.sensors.decode import OdometrySample

Figures = dict[str, Any]
SEED = 10005
ORIGIN = np.array([37.72, 15.0, 2550.0])
"""Latitude, longitude and height of the fixes' world."""
SETTINGS = load_settings().pose_graph.model_copy(update={"max_gap_s": 3.0})
BELIEVING = SETTINGS.model_copy(update={"reject_outliers": False})
LATE = 40
"""Closures whose cost is measured."""


def timed(step: Callable[[], object]) -> tuple[float, float]:
    """Milliseconds of a step by the clock on the wall, and of CPU: on a busy machine only those say how long it is."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    step()
    return 1e3 * (time.perf_counter() - wall_s), 1e3 * (time.process_time() - cpu_s)


def spread(name: str, milliseconds: Array) -> Figures:
    """Median, 95th percentile and worst of a cost."""
    p50, p95, worst = np.percentile(milliseconds, [50, 95, 100]).round(1).tolist()
    return {f"{name}_p50": p50, f"{name}_p95": p95, f"{name}_max": worst}


def all_at_once(poses: int) -> Figures:
    """Milliseconds of closures that come to a graph that got all others a moment ago, and is still busy with them."""
    world = rover_loops(poses, SEED)
    graph = PoseGraph(SETTINGS)
    for k, pose in enumerate(world.odometry):
        graph.add_odometry(k * PERIOD_NS, pose)
    closures = [world.message(row) for row in range(len(world.closures))]
    graph.add_closures(closures[:-LATE])
    for _ in range(20):  # what the moved map comes close to is looked at with the next call
        if not graph.update():
            break
    times = np.array([timed(partial(graph.add_closure, closure)) for closure in closures[-LATE:]])[20:]
    wall, cpu = np.median(times, axis=0).round(1).tolist()
    return {"event_ms_20k": wall, "event_cpu_ms_20k": cpu} | spread("event_cpu_ms_20k", times[:, 1])


def one_by_one(poses: int, fix_every_m: int = 0) -> Figures:
    """Milliseconds of CPU at the end of a drive all of whose closures are in the map, and of the pose that follows.

    Args:
        poses: of the drive, a metre apart.
        fix_every_m: metres between positions by GNSS; 0: none.
    """
    world = rover_loops(poses, SEED)
    graph, first = PoseGraph(BELIEVING), world.closures[-LATE].second
    fixes = fixes_of(world, fix_every_m) if fix_every_m else {}

    def drive_to(begin: int, end: int) -> None:
        for k in range(begin, end):
            graph.add_odometry(k * PERIOD_NS, world.odometry[k])
            if k in fixes:
                graph.add_absolute(fixes[k])

    drive_to(0, first)
    graph.add_closures([world.message(row) for row in range(len(world.closures) - LATE)])
    graph.retune(SETTINGS)
    graph.update()
    events, poses_ms, k = [], [], first
    for row in range(len(world.closures) - LATE, len(world.closures)):
        until = world.closures[row].second + 1
        drive_to(k, until)
        k = until
        graph.update()  # as the node does every second
        events.append(timed(partial(graph.add_closure, world.message(row)))[1])
        poses_ms.append(timed(lambda: (graph.map_T_odom(), graph.covariance()))[1])
    found = spread("drive_event_cpu_ms_20k", np.array(events[5:])) | spread("pose_cpu_ms_20k", np.array(poses_ms[5:]))
    found["trajectory_cpu_ms_20k"] = round(timed(graph.trajectory)[1], 1)
    return found


def fixes_of(world: GraphWorld, every_m: int) -> dict[int, AbsoluteMeasurement]:
    """Positions by GNSS along a drive, by the number of their pose."""
    rng, sigma_m = np.random.default_rng(SEED), 1.0
    rows = range(0, len(world.truth), every_m)
    measured = world.truth[::every_m, :3, 3] + rng.normal(0, sigma_m, (len(rows), 3))
    covariance, lever = sigma_m**2 * np.eye(3), np.zeros(3)
    return {
        k: AbsoluteMeasurement(Aid.GNSS, k * PERIOD_NS, position, covariance, lever)
        for k, position in zip(rows, from_enu(measured, ORIGIN), strict=True)
    }


def keep(world: GraphWorld, last: int, path: Path) -> int:
    """A journal of a drive up to a pose, with every closure accepted; returns how many these are."""
    begun = DurableGraph(SETTINGS, path, _ignore)  # as the node begins it, settings and all
    begun.close()
    closures = [_later(world, row) for row, closure in enumerate(world.closures) if closure.second < last]
    stamps = [(one.match_stamp_ns, one.query_stamp_ns) for one in closures]
    numbers = [np.hstack([one.match_T_query.ravel(), one.covariance.ravel(), one.probability]) for one in closures]
    events = [("odometry", (k + 1) * PERIOD_NS, 0, world.odometry[k].tobytes()) for k in range(last)]
    events += [("closure", *pair, data.tobytes()) for pair, data in zip(stamps, numbers, strict=True)]
    with closing(sqlite3.connect(path)) as journal, journal:
        journal.executemany("INSERT INTO event (kind, first_ns, second_ns, data) VALUES (?, ?, ?, ?)", events)
        verdicts = [(*pair, State.ACCEPTED.value, ClosureReason.AGREES.value) for pair in stamps]
        journal.executemany("INSERT INTO verdict (match_ns, query_ns, state, reason) VALUES (?, ?, ?, ?)", verdicts)
    return len(closures)


def live(poses: int, folder: Path) -> Figures:
    """A node takes up a stored graph, hears the end of the drive, saves, and ends."""
    world = rover_loops(poses, SEED)
    first = world.closures[-LATE].second
    results = folder / "long_graph"
    results.mkdir(exist_ok=True)
    (results / JOURNAL).unlink(missing_ok=True)
    kept = keep(world, first, results / JOURNAL)
    with own_domain():
        ears = Ears()
        odometry = ears.create_publisher(Odometry, "/odom", MANY)
        closures = ears.create_publisher(Odometry, "/loop_closures", CLOSURES_QOS)
        started_s = time.monotonic()
        node = NodeUnderTest(BACK_END, results, {"pose_graph.max_gap_s": 3.0})
        known = ears.anew(BACK_END) and ears.value(BACK_END, "pose graph", "accepted")
        figures: Figures = {"stored_closures_20k": kept, "taken_up_20k": known}
        figures["reopen_s_20k"] = round(time.monotonic() - started_s, 1)
        ears.wait(1.0)
        told_s: dict[tuple[int, int], float] = {}
        for k in range(first, poses):
            message = Odometry(child_frame_id="base_link")
            message.header.stamp, message.header.frame_id = to_time((k + 1) * PERIOD_NS), "odom"
            message.pose.pose = to_pose(world.odometry[k])
            odometry.publish(message)
            for row, closure in enumerate(world.closures):
                if closure.second == k:
                    closures.publish(closure_to_message(later := _later(world, row)))
                    told_s[later.match_stamp_ns, later.query_stamp_ns] = time.monotonic()
            ears.wait(0.05)
        ears.until(lambda: ears.verdicts.keys() >= told_s.keys(), 60.0)
        ears.wait(3.0)
        waited = [1e3 * (ears.verdicts[pair] - then_s) for pair, then_s in told_s.items() if pair in ears.verdicts]
        figures |= spread("verdict_ms_20k", np.array(waited)) | {"verdicts_missing": len(told_s) - len(waited)}
        figures["live_stall_ms_20k"] = ears.value(BACK_END, "pose graph", "executor_stall_max_ms")
        figures["memory_mb_20k"] = round(memory_mb(node.process.pid))
        shutdown_s, status = node.stop()
        figures |= {"shutdown_s_20k": round(shutdown_s, 2), "fuzz_crashes": int(status != 0) + node.tracebacks()}
        ears.destroy_node()
    return figures


def saved(poses: int, folder: Path) -> Figures:
    """The executor's stall while the node of `live`, started again, settles and writes all."""
    with own_domain():
        ears = Ears()
        node = NodeUnderTest(BACK_END, folder / "long_graph", {"pose_graph.max_gap_s": 3.0})
        ears.anew(BACK_END)
        client = ears.create_client(Trigger, f"/{BACK_END}/save")
        client.wait_for_service(20.0)
        started_s, answer = time.monotonic(), client.call_async(Trigger.Request())
        ears.until(answer.done, 500.0)
        save_s = time.monotonic() - started_s
        ears.wait(1.5)
        stall_ms = ears.value(BACK_END, "pose graph", "executor_stall_max_ms")
        shutdown_s, _ = node.stop()
        ears.destroy_node()
    return {
        "save_s_20k": round(save_s, 1),
        "save_stall_ms_20k": stall_ms,
        "settled_shutdown_s_20k": round(shutdown_s, 2),
    }


def long_graph(poses: int = 20_000) -> Figures:
    """Cost of an event at the end of a long path."""
    return all_at_once(poses) | one_by_one(poses)


def live_graph(folder: Path, poses: int = 20_000) -> Figures:
    """The same events in the node."""
    return live(poses, folder) | saved(poses, folder)


FAR_NS = 10**15
"""Stamps of closures that never get odometry begin here."""


def backlogs(folder: Path, number: int = 10_000, latched: int = 5000) -> Figures:
    """Seconds to the next decision and of Ctrl-C after closures that wait, contradict, repeat, or came before it.

    A kind of closure is sent to a back-end that knows the odometry, then one right closure; the latched ones are sent
    before the back-end starts.
    """
    world, rng = rover_loops(500, SEED), np.random.default_rng(1)
    right = [_later(world, row) for row in range(len(world.closures))]
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
    with own_domain():
        ears = Ears()
        odometry = ears.create_publisher(Odometry, "/odom", MANY)
        sender = ears.create_publisher(Odometry, "/loop_closures", CLOSURES_QOS)

        def send() -> None:
            for row, closure in enumerate(closures):
                sender.publish(closure_to_message(closure))
                if row % 20 == 0:
                    ears.spin_once(0.005)

        if early:
            send()
        node = NodeUnderTest(BACK_END, folder, {"pose_graph.max_gap_s": 3.0})
        ears.anew(BACK_END)
        ears.until(odometry.get_subscription_count)
        ears.wait(DISCOVERY_S)
        for k, pose in enumerate(world.odometry):
            message = Odometry(child_frame_id="base_link")
            message.header.stamp, message.header.frame_id = to_time((k + 1) * PERIOD_NS), "odom"
            message.pose.pose = to_pose(pose)
            odometry.publish(message)
            ears.spin_once(0.002)
        ears.until(lambda: ears.value(BACK_END, "pose graph", "odometry") >= len(world.odometry) - 5, 20.0)
        if not early:
            send()
        sent_s = time.time()
        sender.publish(closure_to_message(right))
        ears.until(lambda: right.pair in ears.decided, 120.0)
        decision_s = ears.decided.get(right.pair, float("inf")) - sent_s
        shutdown_s, status = node.stop()
        ears.destroy_node()
    return {
        "decision": round(decision_s, 2),
        "sigint": round(shutdown_s, 2),
        "lines": len(node.log.read_text(errors="replace").splitlines()),
        "fuzz_crashes": int(status != 0) + node.tracebacks(),
    }


def restart(folder: Path, hours: float = 8.0, rate_hz: float = 25.0) -> Figures:
    """Seconds of a restart after hours of odometry, by the clock on the wall and of CPU."""
    path = folder / "hours.sqlite"
    path.unlink(missing_ok=True)
    graph, count = DurableGraph(SETTINGS, path, _ignore), int(hours * 3600 * rate_hz)
    turns = 2 * np.pi * np.arange(count) / (600 * rate_hz)
    poses = expmap(np.stack([*np.zeros((2, count)), turns, *np.zeros((3, count))], axis=1))
    poses[:, 0, 3], poses[:, 1, 3] = 10 + 50 * np.sin(turns), 50 * (1 - np.cos(turns))
    stamps = 10**9 + (np.arange(count) * 1e9 / rate_hz).astype(np.int64)
    for first in range(0, count, 500):
        rows = slice(first, first + 500)
        graph.take([OdometrySample(*one) for one in zip(stamps[rows].tolist(), poses[rows], strict=True)])
    graph.close()
    wall_ms, cpu_ms = timed(lambda: DurableGraph(SETTINGS, path, _ignore).close())
    size_mb = round(path.stat().st_size / 1e6)
    return {"restart_s_8h": round(wall_ms / 1e3, 2), "restart_cpu_s_8h": round(cpu_ms / 1e3, 2), "log_mb_8h": size_mb}


def _later(world: GraphWorld, row: int) -> Any:
    """A closure as it is told where the first pose has the stamp of one second, not zero."""
    closure, told = world.closures[row], world.message(row)
    stamps = (closure.second + 1) * PERIOD_NS, (closure.first + 1) * PERIOD_NS
    return type(told)(*stamps, told.match_T_query, told.covariance)


def _ignore(_: Exception) -> None:
    """A journal that cannot be written shows in what is found."""
