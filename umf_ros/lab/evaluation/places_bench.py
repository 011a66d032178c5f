"""Query time, memory and disk of place databases with up to a million places, each opened in a fresh process."""

from __future__ import annotations

import math
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from umf_ros.core.config import Database, Loop
from umf_ros.core.frames import Embedding, Keyframe, Points, StereoCamera
from umf_ros.core.io import memory_mb
from umf_ros.places.database import PlaceDatabase, PlaceIndex, Rows
from umf_ros.places.store import pack

DIMENSION = 768
PER_DRIVE = 250
STEP_NS = 5 * 10**8
ALIKE = 0.91
"""Similarity of one keyframe to the next (*measured*: the median of a demo drive, `umf_scene`)."""
REVISIT = 0.9
"""Similarity of a query to the place it shows again (*measured*, as above)."""
ASKED = 100
TOP = 20


class StoreFigures(NamedTuple):
    """Measurements of one store.

    Attributes:
        query_ms: median time of `PlaceDatabase.query`.
        query_cpu_ms: the same in processor time, which other processes do not change.
        open_s, open_cpu_s: to open the store, whose files are in the operating system's cache, in both times.
        ram, disk: bytes per keyframe.
        recall: share of the 20 best that search found.
        exact: whether the search compares every descriptor.
    """

    query_ms: float
    query_cpu_ms: float
    open_s: float
    open_cpu_s: float
    ram: float
    disk: float
    recall: float
    exact: bool


def made_up_drives(count: int, rng: np.random.Generator, drives_at_once: int = 100) -> Iterator[Points]:
    """(N, 768) unit descriptors with the statistics of drives through many worlds, in parts.

    Neighbours are similar, every drive has an offset, and the variance falls with the rank of the direction: more
    slowly than in one drive, whose first 64 directions hold 97 % of it; here they hold 84 %.
    """
    spread = ((np.arange(DIMENSION) + 4.0) ** -0.75).astype(np.float32)
    common = 0.4 * rng.standard_normal(DIMENSION, dtype=np.float32)
    for first in range(0, count, drives_at_once * PER_DRIVE):
        drives = math.ceil(min(drives_at_once * PER_DRIVE, count - first) / PER_DRIVE)
        own = common + 0.6 * rng.standard_normal((drives, DIMENSION), dtype=np.float32)
        state = rng.standard_normal((drives, DIMENSION), dtype=np.float32)
        made = np.empty((drives, PER_DRIVE, DIMENSION), np.float32)
        for step in range(PER_DRIVE):
            noise = rng.standard_normal((drives, DIMENSION), dtype=np.float32)
            state = ALIKE * state + np.float32(math.sqrt(1 - ALIKE**2)) * noise
            made[:, step] = (state + own) * spread
        yield _unit(made.reshape(-1, DIMENSION)[: count - first])


def repeated(drive: Points, count: int, rng: np.random.Generator) -> Iterator[Points]:
    """(N, D) descriptors of a real drive, repeated with noise: `REVISIT` is their similarity to the originals."""
    for first in range(0, count, 25_000):
        rows = np.arange(first, min(first + 25_000, count)) % len(drive)
        yield _again(drive[rows], rng)


def measure_places(
    sizes: tuple[int, ...], drive: Points | None, seed: int, report: Callable[[str], None]
) -> list[StoreFigures]:
    """Write and measure a store of each size.

    Args:
        sizes: keyframes.
        drive: (N, D) descriptors of a real drive to repeat; None: random drives.
        seed: of the descriptors.
        report: called with a line for the console before each step.
    """
    found = []
    for size in sizes:
        rng = np.random.default_rng(seed)
        with tempfile.TemporaryDirectory(prefix="umf_bench_") as folder:
            path = Path(folder) / "places.sqlite"
            report(f"storing {size:,} places")
            fill(path, made_up_drives(size, rng) if drive is None else repeated(drive, size, rng))
            report(f"searching among {size:,} places")
            with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
                found.append(fresh.submit(measure_store, path, seed).result())
            shutil.rmtree(folder)
    return found


def fill(path: Path, parts: Iterator[Points]) -> None:
    """Write keyframes without local features into a new store, as `KeyframeStore.add` would one by one."""
    dimension, row = 0, 0
    for part in parts:
        if not dimension:
            dimension = part.shape[1]
            _open(path, dimension).close()
            data = pack(bare_keyframe(0, 0, 0.0, part[0]))
        with closing(sqlite3.connect(path)) as connection, connection:
            rows = [
                (row + i + 1, (row + i) * STEP_NS, (row + i) // PER_DRIVE, 0.5 * i, descriptor.tobytes(), data)
                for i, descriptor in enumerate(part)
            ]
            connection.executemany("INSERT INTO keyframe VALUES (?, ?, ?, ?, ?, ?)", rows)
        row += len(part)


def measure_store(path: Path, seed: int) -> StoreFigures:
    """Open a store twice and query it; the first opening writes the file of the index."""
    dimension = _dimension(path)
    _open(path, dimension).close()
    before = memory_mb()
    wall, cpu = time.perf_counter(), time.process_time()
    places = _open(path, dimension)
    open_s, open_cpu_s = time.perf_counter() - wall, time.process_time() - cpu
    query_ms, query_cpu_ms, recall = _ask(places, np.random.default_rng(seed + 1))
    used = (memory_mb() - before) * 2**20
    disk = sum(file.stat().st_size for file in path.parent.iterdir())
    exact = places.index.is_exact
    places.close()
    size = len(places)
    return StoreFigures(query_ms, query_cpu_ms, open_s, open_cpu_s, used / size, disk / size, recall, exact)


def _ask(places: PlaceDatabase, rng: np.random.Generator) -> tuple[float, float, float]:
    rows = np.sort(rng.integers(0, len(places), ASKED))
    asked = _again(np.stack([places[int(row)].embedding.descriptor for row in rows]), rng)
    now_ns, session = len(places) * STEP_NS + 10**12, len(places) // PER_DRIVE + 1
    times, shares = [], []
    for descriptor in asked:
        wall, cpu = time.perf_counter(), time.process_time()
        places.query(bare_keyframe(now_ns, session, 0.0, descriptor), Loop())
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    for descriptor in asked:
        shares.append(_share(places.index, descriptor))
    wall_ms, cpu_ms = 1e3 * np.median(times, axis=0)
    return float(wall_ms), float(cpu_ms), float(np.mean(shares))


def _share(index: PlaceIndex, descriptor: Points) -> float:
    """Share of the true best that search finds."""

    def everywhere(rows: Rows | slice) -> np.ndarray:
        return np.ones(len(index), bool)[rows]

    true = set(index.search(descriptor, TOP, everywhere, exact=True).tolist())
    return len(true & set(index.search(descriptor, TOP, everywhere).tolist())) / len(true)


def _again(descriptors: Points, rng: np.random.Generator) -> Points:
    noise = rng.standard_normal(descriptors.shape, dtype=np.float32) / math.sqrt(descriptors.shape[1])
    return _unit(descriptors + np.float32(math.sqrt(1 / REVISIT**2 - 1)) * noise)


def _unit(rows: Points) -> Points:
    unit: Points = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return unit


def _open(path: Path, dimension: int) -> PlaceDatabase:
    return PlaceDatabase(Database(path=str(path)), "bench", dimension)


def _dimension(path: Path) -> int:
    with closing(sqlite3.connect(path)) as connection:
        return int(connection.execute("SELECT length(descriptor) FROM keyframe LIMIT 1").fetchone()[0]) // 4


def bare_keyframe(
    stamp_ns: int, session: int, path_length_m: float, descriptor: Points, points: Points | None = None
) -> Keyframe:
    """A keyframe without local features."""
    camera = StereoCamera(1, 1, 1.0, 1.0, 0.0, 0.0, 0.0)
    points = np.empty((0, 3), np.float32) if points is None else points
    return Keyframe(
        stamp_ns, Embedding(descriptor), camera, np.eye(4), points, path_length_m=path_length_m, session=session
    )
