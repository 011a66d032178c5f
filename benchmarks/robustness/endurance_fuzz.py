"""Inputs that were damaged, for `endurance.py`: messages, recordings, and files of every kind that is read.

Each part runs in a process of its own with 2 GB of memory, which prints what became of every input as JSON:
    python benchmarks/robustness/endurance_fuzz.py messages|bags|files COUNT SEED FOLDER [BAG]
"""

from __future__ import annotations

import json
import resource
import shutil
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import chain, islice
from itertools import count as count_up
from pathlib import Path
from typing import Any

import numpy as np
from endurance_attacks import attacked
from endurance_files import damage, lie_in_sqlite, mutated, with_other_words, write_files
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import Bag, decode, open_bag
from umf_ros.core.config import Settings, load_settings, topics_of
from umf_ros.core.errors import UmfError
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.sensors.calibration import calibration_of
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.router import MessageRouter, wanted_inputs
from umf_ros.sensors.sessions import OdometrySessionSplitter
from umf_ros.sensors.synchronizer import Synchronizer

MEMORY = 2 * 2**30
SLOW_S = 10.0
VALUES: list[Any] = [0, -1, 1, 2**31, 2**32 - 1, 2**63, 1e-300, 1e308, float("nan"), float("inf"), "", "\0", "x" * 9999]
VALUES += [None, [], b"", np.zeros(3), np.zeros(0, np.uint8), "keyframe/" + "9" * 5000, "mono16", "yuv422"]
Outcome = Counter[str]


def attempt(outcome: Outcome, step: Callable[..., object], *arguments: object) -> None:
    """Run a step and count what it came to: read, refused in one line, or anything else."""
    start = time.monotonic()
    try:
        step(*arguments)
        outcome["read"] += 1
    except UmfError as error:
        outcome["crashes" if "\n" in str(error) else "refused"] += 1
    except Exception as error:
        outcome["crashes"] += 1
        where = traceback.extract_tb(error.__traceback__)[-1]
        sys.stderr.write(
            f"{arguments[:1]}: {type(error).__name__}: {error} ({where.filename}, {where.lineno})\n"[-600:]
        )
    outcome["hangs"] += time.monotonic() - start > SLOW_S


class Rover:
    """The way of messages through the front-end and the odometry's way into the graph, as of a replay."""

    def __init__(self, settings: Settings) -> None:
        self.topics = topics_of(settings)
        calibration = calibration_of(settings)
        self.synchronizer = Synchronizer(settings.sync, calibration, wanted_inputs(self.topics), lambda _: None)
        self._samples: list[OdometrySample] = []
        self.intake = MessageRouter(self.synchronizer, self.topics, lambda _: None, self._samples.append)
        self._detector = LoopDetector(settings, make_detector_embedder(settings))
        self._graph = PoseGraph(settings.pose_graph)
        self._feed = OdometrySessionSplitter(self._graph)

    def take(self, topic: str, message: Any) -> None:
        """One message, and whatever follows from it."""
        self.intake.take(topic, message)
        for sample in self._samples:
            self._feed.take(sample.stamp_ns, sample.odom_T_body)
        self._samples.clear()
        for frame in self.synchronizer.pop():
            self._graph.add_closures(self._detector.process(frame).closures)

    def counted(self) -> int:
        """Messages of images, scans and odometry, all of which have found their fate."""
        self.synchronizer.flush()
        return sum(counter.received for counter in self.synchronizer.counters.values())


def fuzz_messages(count: int, rng: np.random.Generator, settings: Settings, bag: Bag) -> Outcome:
    """A recording with many harmful messages, or fields that no sensor sends, through the whole front-end."""
    outcome: Outcome = Counter()
    rover = Rover(settings)
    infos = {rover.topics.left_info, rover.topics.right_info}
    sent = 0
    for raw in islice(chain.from_iterable(bag.raw_messages(rover.intake.topics) for _ in count_up()), count):
        message = decode(raw)
        kind = rng.random()
        if kind < 0.3:
            message = attacked(message, rng)
        elif kind < 0.5:
            names = [name for name in message.__dataclass_fields__ if name != "header"]
            changes = {names[rng.integers(len(names))]: VALUES[rng.integers(len(VALUES))] for _ in range(2)}
            message = replace(message, **changes)
        sent += raw.topic not in infos
        attempt(outcome, rover.take, raw.topic, message)
    outcome["uncounted"] = abs(sent - rover.counted())
    return outcome


def write_kinds(bag: Bag, folder: Path, settings: Settings) -> list[Path]:
    """The start of a recording as mcap, packed and not, as db3, folder of ROS 2 and bag of ROS 1."""
    wanted = set(topics_of(settings).model_dump().values())
    raws = list(islice(bag.raw_messages(bag.topics.keys() & wanted), 40))
    jazzy, noetic = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
    paths: list[Path] = []
    for plugin in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
        with Ros2Writer(folder / plugin.name, version=9, storage_plugin=plugin) as writer:
            known: dict[str, Any] = {}
            for raw in raws:
                if raw.topic not in known:
                    known[raw.topic] = writer.add_connection(raw.topic, raw.type, typestore=jazzy)
                writer.write(known[raw.topic], raw.log_ns, raw.data)
        paths += [path for path in sorted((folder / plugin.name).iterdir()) if path.suffix in (".mcap", ".db3")]
    paths.append(folder / StoragePlugin.SQLITE3.name)
    for packing in (CompressionType.LZ4, CompressionType.ZSTD):
        paths.append(folder / f"{packing.name}.mcap")
        with paths[-1].open("wb") as file:
            packed = McapWriter(file, chunk_size=2**20, compression=packing)
            packed.start("ros2")
            channels: dict[str, int] = {}
            for raw in raws:
                if raw.topic not in channels:
                    schema = packed.register_schema(raw.type, "ros2msg", b"")
                    channels[raw.topic] = packed.register_channel(raw.topic, "cdr", schema)
                packed.add_message(channels[raw.topic], raw.log_ns, raw.data, raw.log_ns)
            packed.finish()
    with Ros1Writer(folder / "one.bag") as old:
        links: dict[str, Any] = {}
        for raw in raws:
            if raw.type not in noetic.fielddefs:
                continue
            if raw.topic not in links:
                links[raw.topic] = old.add_connection(raw.topic, raw.type, typestore=noetic)
            old.write(links[raw.topic], raw.log_ns, jazzy.cdr_to_ros1(raw.data, raw.type))
    return [*paths, folder / "one.bag"]


def fuzz_bags(count: int, rng: np.random.Generator, settings: Settings, bag: Bag, folder: Path) -> Outcome:
    """Recordings of all kinds with damaged bytes, or that lie."""
    outcome: Outcome = Counter()
    paths = write_kinds(bag, folder, settings)

    def read(path: Path) -> None:
        for _ in FrameReader(open_bag(path), settings, warn=lambda _: None).stream():
            pass

    for path in paths:
        read(path)  # whole, it is read
    for number in range(count):
        source = paths[number % len(paths)]
        path = folder / f"mutated{source.suffix}"
        if source.is_dir():
            shutil.rmtree(path, ignore_errors=True)
            shutil.copytree(source, path)
            about = path / "metadata.yaml"
            about.write_bytes(with_other_words(about.read_bytes(), rng))
        else:
            path.write_bytes(source.read_bytes())
            if source.suffix == ".db3" and rng.random() < 0.5:
                lie_in_sqlite(path, rng)
            else:
                path.write_bytes(mutated(path.read_bytes(), rng))
        attempt(outcome, read, path)
    return outcome


def fuzz_files(count: int, rng: np.random.Generator, folder: Path) -> Outcome:
    """Files of every kind, damaged or lying."""
    outcome: Outcome = Counter()
    files = list(write_files(folder, rng).items())
    for number in range(count):
        name, (whole, read) = files[number % len(files)]
        path = folder / f"mutated_{number}_{name}"
        damage(path, whole, rng)
        attempt(outcome, read, path)
        for left in folder.glob(f"{path.name}*"):
            left.unlink()
    return outcome


def main() -> None:
    """One part, as JSON."""
    part, count, seed, folder = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, hard))
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    settings = load_settings()
    if part == "files":
        outcome = fuzz_files(count, rng, folder)
    elif part == "bags":
        outcome = fuzz_bags(count, rng, settings, open_bag(sys.argv[5]), folder)
    else:
        often = load_settings(None, loop__min_time_gap_s=3.0, loop__min_travel_m=1.0, keyframe__min_translation_m=0.2)
        outcome = fuzz_messages(count, rng, often, open_bag(sys.argv[5]))
    print(json.dumps(outcome))


if __name__ == "__main__":
    main()
