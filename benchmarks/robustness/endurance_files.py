"""Files of every kind that is read, and how they are damaged or made to lie, for `endurance_fuzz.py`."""

from __future__ import annotations

import json
import pickle
import re
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np

from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.config import Database, load_settings
from umf_ros.core.frames import Embedding, Keyframe, StereoCamera
from umf_ros.core.resources import find
from umf_ros.durable_graph import DurableGraph
from umf_ros.lab.datasets.g2o import read_g2o
from umf_ros.lab.datasets.graph_recording import as_recording
from umf_ros.lab.datasets.s3li import load_data_frame, load_pickle
from umf_ros.lab.scan_files import read_scan
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, rover_loops
from umf_ros.networks.weights import load_weights
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import stored_identity, stored_sessions
from umf_ros.sensors.calibration import load_calibration
from umf_ros.sensors.decode import OdometrySample

Rng = np.random.Generator
Read = Callable[[Path], object]
WORDS = ["nan", "-inf", "1e300", "1e-300", "-1", "0", "9" * 5000, "1" + "0" * 30, "2147483648", "!!int ''"]
WORDS += ["!!bool maybe", "&a [*a]", "{a: {a: 1}}", "[" * 3000, "\0", "\u2603", "null", "'", "", "\t", "1e30 1e30"]
WORDS += ["true", ".nan", ".inf"]
NUMBERS = [None, 0, -1, 1, 2**31, 2**63 - 1, -(2**63), 1e300, "x", b"", b"\0" * 64, b"\xff" * 64, "[]", "[" * 9999]
TRAPS = [
    "CREATE VIEW v AS SELECT 1",
    "CREATE TRIGGER {table}_t AFTER INSERT ON {table} BEGIN DELETE FROM {table}; END",
    "ALTER TABLE {table} ADD COLUMN computed AS (zeroblob(900000000))",
    "ALTER TABLE {table} DROP COLUMN {column}",
    "ALTER TABLE {table} RENAME TO other",
    "DELETE FROM {table}",
    "DROP TABLE {table}",
]
SIZES: list[object] = [None, True, 0, -1, 1, 1.5, "x", [], [1, 2], [10**6] * 3, 10**7, 2**40, 1e308, {}]


def mutated(whole: bytes, rng: Rng) -> bytes:
    """A copy with a few bytes changed close together, or cut off, or both."""
    copy = bytearray(whole)
    first = int(rng.integers(0, len(copy)))
    for place in first + rng.integers(0, 64, rng.integers(1, 16)):
        copy[min(int(place), len(copy) - 1)] = int(rng.integers(0, 256))
    if rng.random() < 0.2:
        del copy[int(rng.integers(1, len(copy))) :]
    return bytes(copy)


def with_other_words(whole: bytes, rng: Rng) -> bytes:
    """A text in which a few words or numbers are others."""
    parts = re.split(r"([\s:,]+)", whole.decode())
    for place in rng.integers(0, (len(parts) + 1) // 2, rng.integers(1, 4)):
        parts[2 * int(place)] = WORDS[rng.integers(len(WORDS))]
    return "".join(parts).encode()


def lie_in_sqlite(path: Path, rng: Rng) -> None:
    """Change a SQLite file by statements: values that this package never writes, and triggers that run in use."""
    with closing(sqlite3.connect(path)) as connection, suppress(sqlite3.Error), connection:
        tables = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        table = tables[rng.integers(len(tables))]
        columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
        column = columns[rng.integers(len(columns))]
        if rng.random() < 0.3:
            connection.execute(TRAPS[rng.integers(len(TRAPS))].format(table=table, column=column))
            return
        where = "" if rng.random() < 0.5 else f"WHERE rowid % {int(rng.integers(2, 9))} = 0"
        value = NUMBERS[rng.integers(len(NUMBERS))]
        if isinstance(value, bytes) and rng.random() < 0.5:
            value = rng.choice([np.nan, np.inf, 1e300, -1.0, 0.0], int(rng.choice([8, 16, 53]))).tobytes()
        connection.execute(f"UPDATE OR IGNORE {table} SET {column} = ? {where}", (value,))


def with_other_architecture(whole: bytes, rng: Rng) -> bytes:
    """Weights that say something else of their network."""
    (length,) = struct.unpack_from("<Q", whole)
    head = json.loads(whole[8 : 8 + length])
    about = json.loads(head["__metadata__"]["architecture"])
    about[list(about)[rng.integers(len(about))]] = SIZES[rng.integers(len(SIZES))]
    head["__metadata__"]["architecture"] = json.dumps(about)
    content = json.dumps(head).encode()
    return struct.pack("<Q", len(content)) + content + whole[8 + length :]


def damage(path: Path, whole: bytes, rng: Rng) -> None:
    """Write a damaged copy: bytes changed anywhere, or lies of the kind that the file can tell."""
    is_weights = path.suffix == ".safetensors"
    head = 4096 if is_weights else len(whole)  # where names and shapes are
    path.write_bytes(whole)
    if rng.random() < 0.4:
        path.write_bytes(mutated(whole[:head], rng) + whole[head:])
    elif path.suffix == ".sqlite":
        lie_in_sqlite(path, rng)
    elif is_weights:
        path.write_bytes(with_other_architecture(whole, rng))
    elif path.suffix == ".pickle":
        path.write_bytes(mutated(mutated(whole, rng), rng))
    else:
        path.write_bytes(with_other_words(whole, rng))


def some_keyframe(stamp_ns: int, rng: Rng) -> Keyframe:
    """A keyframe of noise."""
    descriptor = rng.standard_normal(16).astype(np.float32)
    camera = StereoCamera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.2)
    points = rng.standard_normal((20, 3)).astype(np.float32)
    return Keyframe(stamp_ns, Embedding(descriptor / np.linalg.norm(descriptor)), camera, np.eye(4), points)


def write_files(folder: Path, rng: Rng) -> dict[str, tuple[bytes, Read]]:
    """A file of every kind that is read, and how it is read."""
    _write_stores(folder, rng)
    poses = "".join(f"{k}.5 {k} 0 0 0 0 0 1\n" for k in range(1, 30))
    positions = "".join(f"2021/07/07 10:00:{k}.000 37.75 15.0 26{k}.0 1\n" for k in range(10, 40))
    scan = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 1\n"
    scan += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ascii\n1 2 3\n4 5 6\n7 8 9\n"
    table = pickle.dumps({"a": [np.arange(9.0), "b"], "c": np.array([None], object)})
    return {
        "places.sqlite": ((folder / "places.sqlite").read_bytes(), _read_places),
        "graph.sqlite": ((folder / "graph.sqlite").read_bytes(), _read_graph),
        "settings.yaml": (find("config/loop_closure.yaml").read_bytes(), load_settings),
        "rig.yaml": (find("config/calibration/s3li_vulcano.yaml").read_bytes(), load_calibration),
        "graph.g2o": ((folder / "graph.g2o").read_bytes(), lambda path: as_recording(read_g2o(path))),
        "poses.tum": (poses.encode(), lambda path: read_ground_truth(None, path)),
        "positions.pos": (positions.encode(), lambda path: read_ground_truth(None, path)),
        "scan.pcd": (scan.encode(), read_scan),
        "weights.safetensors": (find("models/umf_scene.safetensors").read_bytes(), load_weights),
        "table.pickle": (table, load_pickle),
        "frame.pickle": (b"cpandas\nDataFrame\n)\x81}(X\x04\x00\x00\x00_mgrI3\nub.", load_data_frame),
    }


def _write_stores(folder: Path, rng: Rng) -> None:
    places = PlaceDatabase(Database(path=str(folder / "places.sqlite")), "noise", 16)
    for number in range(20):
        places.add(some_keyframe(number * 10**9, rng))
    places.close()
    settings = load_settings().pose_graph.model_copy(update={"max_gap_s": 3.0})
    graph = DurableGraph(settings, folder / "graph.sqlite", lambda _: None)
    world = rover_loops(250, 10005)
    for k, pose in enumerate(world.odometry):
        graph.take([OdometrySample((k + 1) * PERIOD_NS, pose)])
        for row, closure in enumerate(world.closures):
            if closure.second == k:
                graph.take([world.message(row)])
    graph.graph.write_g2o(folder / "graph.g2o")
    graph.close()


def _read_places(path: Path) -> None:
    stored_sessions(path)
    stored_identity(path)
    opened = PlaceDatabase(Database(path=str(path)), "noise", 16)
    try:
        for row in range(len(opened)):
            opened[row]
        opened.add(some_keyframe(10**13, np.random.default_rng(0)))
    finally:
        opened.close()


def _read_graph(path: Path) -> None:
    settings = load_settings().pose_graph.model_copy(update={"max_gap_s": 3.0})
    graph = DurableGraph(settings, path, lambda _: None)
    try:
        graph.take([OdometrySample(10**15, np.eye(4))])
        graph.write_results(path.parent)
    finally:
        graph.close()
