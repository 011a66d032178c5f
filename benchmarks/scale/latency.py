"""Print latencies of the back-end at the end of a long drive, and its memory; with `--start`, those of a start.

`python benchmarks/scale/latency.py [--poses 20000] [--quick] [--start BAG] [--bag BAG] [--parked BAG]`

A node resumes a stored graph and receives the last 40 closures over DDS, with odometry at 20 Hz: its executor's longest
stall, the time from a closure to its verdict, memory and time to shut down. CPU times are of the graph alone, and again
with a position by GNSS every four metres. `--start` prints the times from `umf replay` to the first keyframe of a
recording in its run folder, of three starts.

`--bag`: a recording of the simulator is played to front-end and back-end, and again with `map_node` and its listener:
time from a scan to the closures of its keyframe, at this process. `--parked`: its first images and scan arrive again
and again at 5 Hz while the odometry stands still, and then nothing arrives: share of a core that the front-end takes.
"""

from __future__ import annotations

import argparse
import sqlite3
import subprocess
import sys
import tempfile
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import PointCloud2

from umf_ros.bags.reader import open_bag
from umf_ros.core.config import Settings, topics_of
from umf_ros.lab.live.live_graph import NODES, PLAYER, WHOLE, NodeProcess
from umf_ros.lab.simulation.bag_writer import BagWriter
from umf_ros.lab.simulation.simulator import START_NS
from umf_ros.nodes.conversions import CLOSURES_QOS, LATCHED_QOS, closure_from_message, from_time, sensor_qos

sys.path.insert(0, str(Path(__file__).parents[1] / "robustness"))

from endurance_graph import Figures, live, one_by_one
from endurance_nodes import own_domain

NAMES = {
    "live_stall_ms_20k": "executor's longest stall, ms",
    "drive_event_cpu_ms_20k_p50": "CPU per closure, ms, p50",
    "drive_event_cpu_ms_20k_p95": "CPU per closure, ms, p95",
    "verdict_ms_20k_p50": "closure to verdict, ms, p50",
    "verdict_ms_20k_p95": "closure to verdict, ms, p95",
    "verdicts_missing": "closures without a verdict",
    "shutdown_s_20k": "shutdown, s",
    "memory_mb_20k": "memory of the node, MB",
}
FIX_EVERY_M = 4
STANDING_S, ODOMETRY_HZ, SCANS_HZ = 40.0, 25, 5
NAMES_WITH_FIXES = {
    "drive_event_cpu_ms_20k_p50_gnss": "CPU per closure, GNSS, ms, p50",
    "drive_event_cpu_ms_20k_p95_gnss": "CPU per closure, GNSS, ms, p95",
}


def start_of_replay_s(recording: Path) -> float:
    """Seconds from `umf replay` to its first stored keyframe; NaN without one."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "umf_ros.cli", "replay", str(recording), "--out", folder]
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


def closures_of(bag: Path, folder: Path, modules: tuple[str, ...]) -> tuple[list[float], int]:
    """Play a recording to nodes; return ms from scans to their closures, and the number of maps that were heard."""
    given = [word for text in WHOLE for word in ("-p", text)]
    nodes = [NodeProcess(module, ["--ros-args", *given], folder, lambda _: None) for module in modules]
    scans: dict[int, float] = {}
    closures: list[float] = []
    maps: list[OccupancyGrid] = []

    def take_closure(message: Odometry) -> None:
        began_s = scans.get(closure_from_message(message).query_stamp_ns)
        if began_s is not None:  # this process heard the scan
            closures.append(1e3 * (time.monotonic() - began_s))

    def take_scan(message: PointCloud2) -> None:
        scans[from_time(message.header.stamp)] = time.monotonic()

    listener = rclpy.create_node("listener")
    topic = topics_of(Settings(dataset="simulated")).cloud
    listener.create_subscription(PointCloud2, topic, take_scan, sensor_qos(Settings().qos, 50))
    listener.create_subscription(Odometry, "loop_closures", take_closure, CLOSURES_QOS)
    listener.create_subscription(OccupancyGrid, "map_node/map_grid", maps.append, LATCHED_QOS)
    try:
        for node in nodes:
            node.wait_ready()
        player = NodeProcess(PLAYER, [str(bag.resolve()), "--wait-for-subscribers", "--quiet"], folder, lambda _: None)
        while player.exit_code is None:
            rclpy.spin_once(listener, timeout_sec=0.05)
        player.stop()
    finally:
        for node in nodes:
            node.stop()
        listener.destroy_node()
    return closures, len(maps)


def with_and_without_map(bag: Path, folder: Path) -> None:
    """Print the latency of closures with the map and without."""
    for name, modules in (("without map_node", NODES), ("with map_node", (*NODES, "umf_ros.nodes.map_node"))):
        closures, maps = closures_of(bag, folder, modules)
        if not closures:
            sys.exit(f"{name}: this process heard no closure")
        p50, p95 = np.percentile(closures, [50, 95])
        print(f"{name:18s} scan to closure, ms: p50 {p50:6.1f}, p95 {p95:6.1f}; {len(closures)} closures, {maps} grids")


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


def print_load_when_parked(recording: Path, folder: Path) -> None:
    """Print what share of a core the front-end takes while the rover stands, and while nothing arrives."""
    parked = folder / "parked.mcap"
    write_parked(recording, parked)
    given = [word for text in WHOLE for word in ("-p", text)]
    node = NodeProcess(NODES[0], ["--ros-args", *given], folder, lambda _: None)
    try:
        node.wait_ready()
        player = NodeProcess(PLAYER, [str(parked), "--wait-for-subscribers", "--quiet"], folder, lambda _: None)
        time.sleep(STANDING_S / 2)  # connections, and the first keyframe
        print(f"parked, scans and images at {SCANS_HZ} Hz: {load_of(node):6.1%} of a core")
        player.stop()
        print(f"nothing arrives:                   {load_of(node):6.1%} of a core")
    finally:
        node.stop()


def load_of(node: NodeProcess) -> float:
    """Return the share of a core that a node takes for some seconds."""
    before_s = node.cpu_s
    time.sleep(STANDING_S / 4)
    return (node.cpu_s - before_s) / (STANDING_S / 4)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=20_000, help="of the drive, one metre apart")
    parser.add_argument("--quick", action="store_true", help="2,000 poses")
    parser.add_argument("--start", type=Path, help="a recording: time the start of its replay instead")
    parser.add_argument("--bag", type=Path, help="recording of the simulator: closures with and without map_node")
    parser.add_argument("--parked", type=Path, help="recording of the simulator: load of the front-end while parked")
    arguments = parser.parse_args()
    if arguments.start is not None:
        seconds = " ".join(f"{start_of_replay_s(arguments.start):.2f}" for _ in range(3))
        print(f"umf replay to the first keyframe, s: {seconds}")
        return
    if arguments.bag is not None:
        with tempfile.TemporaryDirectory() as folder, own_domain():
            with_and_without_map(arguments.bag, Path(folder))
        return
    if arguments.parked is not None:
        with tempfile.TemporaryDirectory() as folder, own_domain():
            print_load_when_parked(arguments.parked, Path(folder))
        return
    poses = 2_000 if arguments.quick else arguments.poses
    with tempfile.TemporaryDirectory() as folder:
        figures: Figures = one_by_one(poses) | live(poses, Path(folder))
    aided = one_by_one(poses, FIX_EVERY_M)
    figures |= {f"{name}_gnss": aided[name] for name in NAMES if name in aided}
    for name, text in (NAMES | NAMES_WITH_FIXES).items():
        print(f"{text:32s} {figures[name]:8.1f}")


if __name__ == "__main__":
    main()
