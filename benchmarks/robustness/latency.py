"""Print latencies of the back-end at the end of a long drive, and its memory; with `--start`, those of a start.

`python benchmarks/robustness/latency.py [--poses 20000] [--quick] [--start|--bag|--parked BAG] [--json FILE]`

A node resumes a stored graph and receives the last 40 closures over DDS, with odometry at 20 Hz: its executor's longest
stall, the time from a closure to its verdict, memory and time to shut down; started again, it settles and saves. CPU
times are of the graph alone: of closures one by one at the end of the drive, again with a position by GNSS every four
metres, and of closures that come while the graph is still busy with all others. `--start` prints the times from
`umf replay` to the first keyframe of a recording in its run folder, of three starts.

`--bag`: a recording of the simulator is played to front-end and back-end, and again with `map_node` and its listener:
time from a scan to the closures of its keyframe, at this process, and the longest stall of each node's executor.
`--parked`: its first images and scan arrive again and again at 5 Hz while the odometry stands still, and then nothing
arrives: share of a core that the front-end takes.
"""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from live_nodes import BACK_END, FRONT_END, Ears, Figures, NodeUnderTest, Rover, later, listening, own_domain, spread
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from umf_ros.absolute.measurement import AbsoluteMeasurement, Aid
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import Settings, load_settings, topics_of
from umf_ros.core.geometry import from_enu
from umf_ros.core.io import memory_mb
from umf_ros.durable_graph import DurableGraph
from umf_ros.graph_process import JOURNAL
from umf_ros.lab.live.live_graph import NODES, PLAYER, WHOLE, NodeProcess
from umf_ros.lab.program import UMF, parser_of, write_figures
from umf_ros.lab.simulation.bag_writer import BagWriter
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld, rover_loops
from umf_ros.lab.simulation.simulator import START_NS
from umf_ros.nodes.conversions import LATCHED_QOS, from_time, sensor_qos
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import ClosureReason, State

SEED = 10005
ORIGIN = np.array([37.72, 15.0, 2550.0])
"""Latitude, longitude and height of the fixes' world."""
SETTINGS = load_settings().pose_graph.model_copy(update={"max_gap_s": 3.0})
BELIEVING = SETTINGS.model_copy(update={"reject_outliers": False})
SPARSE: dict[str, object] = {"pose_graph.max_gap_s": 3.0}
LATE = 40
"""Closures whose cost is measured."""
FIX_EVERY_M = 4
STANDING_S, ODOMETRY_HZ, SCANS_HZ = 40.0, 25, 5
NAMES = {
    "live_stall_ms": "executor's longest stall, ms",
    "drive_event_cpu_ms_p50": "CPU per closure, ms, p50",
    "drive_event_cpu_ms_p95": "CPU per closure, ms, p95",
    "verdict_ms_p50": "closure to verdict, ms, p50",
    "verdict_ms_p95": "closure to verdict, ms, p95",
    "verdicts_missing": "closures without a verdict",
    "shutdown_s": "shutdown, s",
    "memory_mb": "memory of the node, MB",
    "drive_event_cpu_ms_p50_gnss": "CPU per closure, GNSS, ms, p50",
    "drive_event_cpu_ms_p95_gnss": "CPU per closure, GNSS, ms, p95",
    "busy_event_cpu_ms_p50": "CPU per closure, busy, ms, p50",
    "busy_event_cpu_ms_p95": "CPU per closure, busy, ms, p95",
    "save_s": "settle and save, s",
    "save_stall_ms": "stall while saving, ms",
}


def cpu_ms(step: Callable[[], object]) -> float:
    """Milliseconds of CPU of a step: on a busy machine only those say how long it is."""
    before_s = time.process_time()
    step()
    return 1e3 * (time.process_time() - before_s)


def all_at_once(poses: int) -> Figures:
    """Cost of closures that come to a graph that got all others a moment ago, and is still busy with them."""
    world, graph = rover_loops(poses, SEED), PoseGraph(SETTINGS)
    for k, pose in enumerate(world.odometry):
        graph.add_odometry(k * PERIOD_NS, pose)
    closures = [world.message(row) for row in range(len(world.closures))]
    graph.add_closures(closures[:-LATE])
    for _ in range(20):  # what the moved map comes close to is looked at with the next call
        if not graph.update():
            break
    times = np.array([cpu_ms(partial(graph.add_closure, closure)) for closure in closures[-LATE:]])
    return spread("busy_event_cpu_ms", times[20:])


def one_by_one(poses: int, fix_every_m: int = 0) -> Figures:
    """Cost at the end of a drive all of whose closures are in the map, and of the pose that follows.

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
        events.append(cpu_ms(partial(graph.add_closure, world.message(row))))
        poses_ms.append(cpu_ms(lambda: (graph.map_T_odom(), graph.covariance())))
    found = spread("drive_event_cpu_ms", np.array(events[5:])) | spread("pose_cpu_ms", np.array(poses_ms[5:]))
    return found | {"trajectory_cpu_ms": round(cpu_ms(graph.trajectory), 1)}


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
    begun = DurableGraph(SETTINGS, path, lambda _: None)  # as the node begins it, settings and all
    begun.close()
    closures = [later(world, row) for row, closure in enumerate(world.closures) if closure.second < last]
    stamps = [(one.match_stamp_ns, one.query_stamp_ns) for one in closures]
    numbers = [np.hstack([one.match_T_query.ravel(), one.covariance.ravel(), one.probability]) for one in closures]
    events = [("odometry", (k + 1) * PERIOD_NS, 0, world.odometry[k].tobytes()) for k in range(last)]
    events += [("closure", *pair, data.tobytes()) for pair, data in zip(stamps, numbers, strict=True)]
    with closing(sqlite3.connect(path)) as journal, journal:
        journal.executemany("INSERT INTO event (kind, first_ns, second_ns, data) VALUES (?, ?, ?, ?)", events)
        verdicts = [(*pair, State.ACCEPTED.value, ClosureReason.AGREES.value) for pair in stamps]
        journal.executemany("INSERT INTO verdict (match_ns, query_ns, state, reason) VALUES (?, ?, ?, ?)", verdicts)
    return len(closures)


def live(poses: int, results: Path) -> Figures:
    """A node takes up a stored graph, hears the end of the drive, and ends."""
    world = rover_loops(poses, SEED)
    first = world.closures[-LATE].second
    kept = keep(world, first, results / JOURNAL)
    with listening() as ears:
        rover, started_s = Rover(ears, world), time.monotonic()
        node = NodeUnderTest(BACK_END, results, SPARSE)
        known = ears.anew(BACK_END) and ears.value(BACK_END, "pose graph", "accepted")
        figures: Figures = {"stored_closures": kept, "taken_up": known}
        figures["reopen_s"] = round(time.monotonic() - started_s, 1)
        ears.wait(1.0)
        told_s: dict[tuple[int, int], float] = {}
        for closures in rover.drive(range(first, poses)):
            told_s |= {(one.match_stamp_ns, one.query_stamp_ns): time.monotonic() for one in closures}
            ears.wait(0.05)
        ears.until(lambda: ears.verdicts.keys() >= told_s.keys(), 60.0)
        ears.wait(3.0)
        waited = [1e3 * (ears.verdicts[pair] - then_s) for pair, then_s in told_s.items() if pair in ears.verdicts]
        figures |= spread("verdict_ms", np.array(waited)) | {"verdicts_missing": len(told_s) - len(waited)}
        figures["live_stall_ms"] = ears.value(BACK_END, "pose graph", "executor_stall_max_ms")
        figures["memory_mb"] = round(memory_mb(node.process.pid))
        shutdown_s, faults = node.end()
    return figures | {"shutdown_s": round(shutdown_s, 2), "faults": faults}


def saved(results: Path) -> Figures:
    """The executor's stall while the node of `live`, started again, settles and writes all."""
    with listening() as ears:
        node = NodeUnderTest(BACK_END, results, SPARSE)
        ears.anew(BACK_END)
        client = ears.create_client(Trigger, f"/{BACK_END}/save")
        client.wait_for_service(20.0)
        started_s, answer = time.monotonic(), client.call_async(Trigger.Request())
        ears.until(answer.done, 500.0)
        save_s = time.monotonic() - started_s
        ears.wait(1.5)
        stall_ms = ears.value(BACK_END, "pose graph", "executor_stall_max_ms")
        shutdown_s, _ = node.stop()
    return {"save_s": round(save_s, 1), "save_stall_ms": stall_ms, "settled_shutdown_s": round(shutdown_s, 2)}


def start_of_replay_s(recording: Path) -> float:
    """Seconds from `umf replay` to its first stored keyframe; NaN without one."""
    with tempfile.TemporaryDirectory() as folder:
        command = [*UMF, "replay", str(recording), "--out", folder]
        start = time.monotonic()
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            while process.poll() is None:
                for path in Path(folder).glob("*/run.sqlite"):
                    with suppress(sqlite3.OperationalError), closing(sqlite3.connect(path)) as run:
                        if run.execute("SELECT count(*) FROM keyframes").fetchone()[0]:
                            process.kill()
                            return time.monotonic() - start
                time.sleep(0.01)
    return float("nan")


class BagEars(Ears):
    """Hears also when scans and their closures arrive, and the maps of `map_node`.

    Attributes:
        delays_ms: from scans to the closures of their keyframes.
        maps: grids.
    """

    def __init__(self) -> None:
        super().__init__()
        self.delays_ms: list[float] = []
        self.maps: list[OccupancyGrid] = []
        self._scans_s: dict[int, float] = {}
        topic = topics_of(Settings(dataset="simulated")).cloud
        self.create_subscription(PointCloud2, topic, self._hear_scan, sensor_qos(Settings().qos, 50))
        self.create_subscription(OccupancyGrid, "map_node/map_grid", self.maps.append, LATCHED_QOS)

    def _hear_scan(self, message: PointCloud2) -> None:
        self._scans_s[from_time(message.header.stamp)] = time.monotonic()

    def _hear_closure(self, message: Odometry) -> None:
        super()._hear_closure(message)
        began_s = self._scans_s.get(from_time(message.header.stamp))
        if began_s is not None:  # this process heard the scan
            self.delays_ms.append(1e3 * (time.monotonic() - began_s))


def played(bag: Path, folder: Path, modules: tuple[str, ...]) -> BagEars:
    """Play a recording to nodes; return what was heard."""
    given = [word for text in WHOLE for word in ("-p", text)]
    nodes = [NodeProcess(module, ["--ros-args", *given], folder, lambda _: None) for module in modules]
    ears = BagEars()
    try:
        for node in nodes:
            node.wait_ready()
        player = NodeProcess(PLAYER, [str(bag.resolve()), "--wait-for-subscribers", "--quiet"], folder, lambda _: None)
        while player.exit_code is None:
            ears.spin_once(0.05)
        player.stop()
        ears.wait(1.5)  # for the last diagnostics
    finally:
        for node in nodes:
            node.stop()
        ears.destroy_node()
    return ears


def with_and_without_map(bag: Path, folder: Path) -> Figures:
    """Print the latency of closures with the map and without."""
    figures: Figures = {}
    for name, modules in (("without map_node", NODES), ("with map_node", (*NODES, "umf_ros.nodes.map_node"))):
        ears = played(bag, folder, modules)
        if not ears.delays_ms:
            sys.exit(f"{name}: this process heard no closure")
        found = spread("closure_ms", np.array(ears.delays_ms))
        lines = {"front_end_stall_ms": (FRONT_END, "detector"), "back_end_stall_ms": (BACK_END, "pose graph")}
        found |= {one: round(ears.value(*line, "executor_stall_max_ms"), 1) for one, line in lines.items()}
        delays = f"p50 {found['closure_ms_p50']:6.1f}, p95 {found['closure_ms_p95']:6.1f}"
        stalls = f"{found['front_end_stall_ms']:.0f} and {found['back_end_stall_ms']:.0f}"
        counts = f"{len(ears.delays_ms)} closures, {len(ears.maps)} grids"
        print(f"{name:18s} scan to closure, ms: {delays}; {counts}; longest stalls, ms: {stalls}")
        figures[name] = found | {"closures": len(ears.delays_ms), "maps": len(ears.maps)}
    return figures


def write_parked(recording: Path, path: Path) -> None:
    """Write half a minute of a rover that stands where a recording of the simulator begins."""
    topics = topics_of(Settings(dataset="simulated"))
    sensors = (topics.left_image, topics.right_image, topics.left_info, topics.right_info, topics.cloud)
    first: dict[str, Any] = {}
    for topic, _, message in open_bag(recording).messages((*sensors, topics.odometry)):
        first.setdefault(topic, message)
        if len(first) == len(sensors) + 1:
            break
    speed = first[topics.odometry].twist.twist
    speed.linear = speed.angular = type(speed.linear)(0.0, 0.0, 0.0)
    with BagWriter(path) as bag:
        for number in range(round(STANDING_S * ODOMETRY_HZ)):
            now_ns = START_NS + number * 10**9 // ODOMETRY_HZ
            for topic in (topics.odometry, *(sensors if number % (ODOMETRY_HZ // SCANS_HZ) == 0 else ())):
                header = first[topic].header
                header.stamp.sec, header.stamp.nanosec = divmod(now_ns, 10**9)
                bag.write(topic, first[topic], now_ns)


def load_when_parked(recording: Path, folder: Path) -> Figures:
    """Print what share of a core the front-end takes while the rover stands, and while nothing arrives."""
    parked = folder / "parked.mcap"
    write_parked(recording, parked)
    given = [word for text in WHOLE for word in ("-p", text)]
    node = NodeProcess(NODES[0], ["--ros-args", *given], folder, lambda _: None)
    try:
        node.wait_ready()
        player = NodeProcess(PLAYER, [str(parked), "--wait-for-subscribers", "--quiet"], folder, lambda _: None)
        time.sleep(STANDING_S / 2)  # connections, and the first keyframe
        figures: Figures = {"parked": load_of(node)}
        print(f"parked, scans and images at {SCANS_HZ} Hz: {figures['parked']:6.1%} of a core")
        player.stop()
        figures["nothing_arrives"] = load_of(node)
        print(f"nothing arrives:                   {figures['nothing_arrives']:6.1%} of a core")
    finally:
        node.stop()
    return figures


def load_of(node: NodeProcess) -> float:
    """Return the share of a core that a node takes for some seconds."""
    before_s = node.cpu_s
    time.sleep(STANDING_S / 4)
    return (node.cpu_s - before_s) / (STANDING_S / 4)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--poses", type=int, default=20_000, help="of the drive, one metre apart")
    parser.add_argument("--quick", action="store_true", help="2,000 poses")
    parser.add_argument("--start", type=Path, help="a recording: time the start of its replay instead")
    parser.add_argument("--bag", type=Path, help="recording of the simulator: closures with and without map_node")
    parser.add_argument("--parked", type=Path, help="recording of the simulator: load of the front-end while parked")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.start is not None:
            figures: Figures = {"start_s": [round(start_of_replay_s(arguments.start), 2) for _ in range(3)]}
            print(f"umf replay to the first keyframe, s: {' '.join(map(str, figures['start_s']))}")
        elif arguments.bag is not None:
            with own_domain():
                figures = with_and_without_map(arguments.bag, Path(folder))
        elif arguments.parked is not None:
            with own_domain():
                figures = load_when_parked(arguments.parked, Path(folder))
        else:
            poses = 2_000 if arguments.quick else arguments.poses
            figures = one_by_one(poses) | live(poses, Path(folder)) | saved(Path(folder)) | all_at_once(poses)
            figures |= {f"{name}_gnss": value for name, value in one_by_one(poses, FIX_EVERY_M).items()}
            for name, text in NAMES.items():
                print(f"{text:32s} {figures[name]:8.1f}")
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    main()
