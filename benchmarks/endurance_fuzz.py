"""Inputs that were damaged, for `endurance.py`: messages, recordings, and files of every kind that is read.

Each part runs in a process of its own with 2 GB of memory, which prints what became of every input as JSON:
    python benchmarks/endurance_fuzz.py messages|bags|files COUNT SEED FOLDER [BAG]
"""

from __future__ import annotations

import json
import pickle
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import calibration_of, topics_of
from umf_ros.bags.reader import Bag, decode, open_bag
from umf_ros.config import Database, Settings, load_settings
from umf_ros.errors import UmfError
from umf_ros.frames import Embedding, Keyframe, StereoCamera
from umf_ros.lab.datasets.g2o import read_g2o
from umf_ros.lab.datasets.pickles import load_pickle
from umf_ros.networks.weights import load_weights
from umf_ros.places.database import PlaceDatabase
from umf_ros.resources import find
from umf_ros.sensors.durable_graph import DurableGraph
from umf_ros.sensors.intake import Intake, wanted_inputs
from umf_ros.sensors.synchronizer import Synchronizer

MEMORY = 2 * 2**30
SLOW_S = 10.0
VALUES: list[Any] = [0, -1, 1, 2**31, 2**32 - 1, 2**63, 1e-300, 1e308, float("nan"), float("inf"), "", "\0", "x" * 9999]
VALUES += [None, [], b"", np.zeros(3), np.zeros(0, np.uint8), "keyframe/" + "9" * 5000, "mono16", "yuv422"]
Outcome = Counter[str]


def mutated(whole: bytes, rng: np.random.Generator) -> bytes:
    """A copy with a few bytes changed close together, or cut off, or both."""
    copy = bytearray(whole)
    first = int(rng.integers(0, len(copy)))
    for place in first + rng.integers(0, 64, rng.integers(1, 16)):
        copy[min(int(place), len(copy) - 1)] = int(rng.integers(0, 256))
    if rng.random() < 0.2:
        del copy[int(rng.integers(1, len(copy))) :]
    return bytes(copy)


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
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
    outcome["hangs"] += time.monotonic() - start > SLOW_S


def fuzz_messages(count: int, rng: np.random.Generator, settings: Settings, bag: Bag) -> Outcome:
    """Messages of a recording with fields that nobody sends, through the intake of the front-end."""
    outcome: Outcome = Counter()
    topics = topics_of(settings)
    synchronizer = Synchronizer(settings.sync, calibration_of(settings), wanted_inputs(topics), lambda _: None)
    intake = Intake(synchronizer, topics, lambda _: None)
    messages = [(raw.topic, decode(raw)) for raw in islice(bag.raw_messages(intake.topics), 60)]
    infos = {topics.left_info, topics.right_info}
    sent = 0
    for number in range(count):
        topic, message = messages[number % len(messages)]
        names = [name for name in message.__dataclass_fields__ if name != "header"]
        changes = {names[rng.integers(len(names))]: VALUES[rng.integers(len(VALUES))] for _ in range(2)}
        sent += topic not in infos
        attempt(outcome, intake.take, topic, replace(message, **changes))
        synchronizer.pop()
    synchronizer.flush()
    counted = sum(counter.received for counter in synchronizer.counters.values())
    outcome["uncounted"] = max(0, sent - counted)
    return outcome


def write_kinds(bag: Bag, folder: Path, settings: Settings) -> list[Path]:
    """The start of a recording as mcap, db3, folder of ROS 2 and bag of ROS 1."""
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
    """Recordings of all kinds with damaged bytes."""
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
        path.write_bytes(mutated(source.read_bytes(), rng))
        attempt(outcome, read, path)
    return outcome


def some_keyframe(stamp_ns: int, rng: np.random.Generator) -> Keyframe:
    """A keyframe of noise."""
    descriptor = rng.standard_normal(16).astype(np.float32)
    camera = StereoCamera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.2)
    points = rng.standard_normal((20, 3)).astype(np.float32)
    return Keyframe(stamp_ns, Embedding(descriptor / np.linalg.norm(descriptor)), camera, np.eye(4), points)


def write_files(folder: Path, rng: np.random.Generator) -> dict[str, tuple[bytes, Callable[[Path], object]]]:
    """A file of every kind that is read, and how it is read."""
    places = PlaceDatabase(Database(path=str(folder / "places.sqlite")), "noise", 16)
    for number in range(20):
        places.add(some_keyframe(number * 10**9, rng))
    places.close()
    graph = DurableGraph(load_settings().pose_graph, folder / "graph.sqlite", lambda _: None)
    for number in range(200):
        graph.take_odometry(number * 10**8 + 1, np.eye(4))
    graph.graph.write_g2o(folder / "graph.g2o")
    graph.close()

    def read_places(path: Path) -> None:
        opened = PlaceDatabase(Database(path=str(path)), "noise", 16)
        try:
            for row in range(len(opened)):
                opened[row]
        finally:
            opened.close()

    def read_graph(path: Path) -> None:
        DurableGraph(load_settings().pose_graph, path, lambda _: None).close()

    return {
        "places.sqlite": ((folder / "places.sqlite").read_bytes(), read_places),
        "graph.sqlite": ((folder / "graph.sqlite").read_bytes(), read_graph),
        "settings.yaml": (find("config/loop_closure.yaml").read_bytes(), load_settings),
        "graph.g2o": ((folder / "graph.g2o").read_bytes(), read_g2o),
        "weights.safetensors": (find("models/umf_light.safetensors").read_bytes(), load_weights),
        "table.pickle": (pickle.dumps({"a": [np.arange(9.0), "b"], "c": np.array([None], object)}), load_pickle),
    }


def fuzz_files(count: int, rng: np.random.Generator, folder: Path) -> Outcome:
    """Files of every kind with damaged bytes; of weights their head, where names and shapes are."""
    outcome: Outcome = Counter()
    files = list(write_files(folder, rng).items())
    for number in range(count):
        name, (whole, read) = files[number % len(files)]
        path = folder / f"mutated_{number}_{name}"
        head = 4096 if name.startswith("weights") else len(whole)
        path.write_bytes(mutated(whole[:head], rng) + whole[head:])
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
        outcome = fuzz_messages(count, rng, settings, open_bag(sys.argv[5]))
    print(json.dumps(outcome))


if __name__ == "__main__":
    main()
