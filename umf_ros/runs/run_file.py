"""One SQLite file per run, written as it goes, and the CSV tables that are exported from it.

A damaged file or table raises an `UmfError`, one that cannot be written an `OutputError`.
"""

from __future__ import annotations

import csv
import json
import sqlite3
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from umf_ros.absolute.measurement import AbsoluteMeasurement, AbsoluteReason, AbsoluteVerdict, Aid
from umf_ros.core.errors import UmfError, writing
from umf_ros.core.frames import Candidate, LoopClosure, Points
from umf_ros.core.geometry import Array, from_quaternion, to_quaternion
from umf_ros.core.io import Schema, SqliteFile, write_table
from umf_ros.core.limits import LONGEST_LINE
from umf_ros.core.trajectory import Trajectory
from umf_ros.pose_graph.closures import VERDICT_COLUMNS, ClosureReason, ClosureVerdict, State
from umf_ros.sensors.decode import OdometrySample
from umf_ros.verification.hypothesis import ACCEPTED, Hypothesis, RejectReason

NAME = "run.sqlite"
POSE = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]
SIGMA = ["sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rx_rad", "sigma_ry_rad", "sigma_rz_rad"]
CLOSURES = ["query_stamp_ns", "match_stamp_ns", *POSE, *SIGMA, "probability", "similarity", "covariance"]
STAGES = ("embed", "query", "verify", "submaps", "total")
COLUMNS = {
    "keyframes": ["stamp_ns", "session", "travelled_m"],
    "latencies": ["stamp_ns", *STAGES],
    "candidates": ["query_stamp_ns", "match_stamp_ns", "similarity", "reason", "detail", "numbers"],
    "closures": CLOSURES,
    "inliers": ["query_stamp_ns", "match_stamp_ns", "query_u", "query_v", "match_u", "match_v"],
    "closures_between": ["match_robot", *CLOSURES],
    "localization": ["stamp_ns", *POSE, *SIGMA, "probability"],
}
"""Columns of each table, exported as `<name>.csv`."""
ALWAYS = ("keyframes", "latencies", "candidates", "closures", "inliers")
"""Tables that are also exported without rows."""
KEYFRAME = np.dtype([("stamp_ns", np.int64), ("session", np.int64), ("path_length_m", float)])
SCHEMA = Schema(
    "run",
    migrations=(
        (
            # the columns hold the text of the CSV file
            *(f"CREATE TABLE {name} ({', '.join(columns)})" for name, columns in COLUMNS.items()),
            # odometry messages that came before the closure
            "ALTER TABLE closures ADD COLUMN odometry_before INTEGER",
            "CREATE TABLE descriptor (stamp_ns INTEGER, data BLOB NOT NULL)",
            "CREATE TABLE odometry (number INTEGER PRIMARY KEY, stamp_ns INTEGER, odom_T_body BLOB)",
            "CREATE TABLE about (name TEXT PRIMARY KEY, value)",
        ),
        ("ALTER TABLE odometry ADD COLUMN covariance BLOB",),
        (
            "CREATE TABLE absolute (source TEXT, stamp_ns INTEGER, odometry_before INTEGER, data BLOB NOT NULL, "
            "PRIMARY KEY (source, stamp_ns))",
        ),
        ("CREATE TABLE picture (stamp_ns INTEGER, jpeg BLOB, width INTEGER, height INTEGER, scan BLOB NOT NULL)",),
    ),
)
SCAN_UNIT_M = 0.02
"""Unit of the points of a `Picture`."""
Row = TypeVar("Row")

Endpoints = tuple[int, int]
"""Stamps in ns of a closure's query and match."""


class Picture(NamedTuple):
    """Small pictures of a keyframe for the report.

    Attributes:
        stamp_ns: of the keyframe.
        jpeg: reduced left image, empty without one.
        width, height: pixels of the image before it was reduced.
        scan: (N, 3) int16 points in `SCAN_UNIT_M`, body frame.
    """

    stamp_ns: int
    jpeg: bytes
    width: int
    height: int
    scan: NDArray[np.int16]


GraphInput = LoopClosure | OdometrySample | AbsoluteMeasurement
"""Inputs of a pose graph."""


class RunFile:
    """File of a run. A transaction is stored completely or not at all, also when the process is killed.

    Args:
        folder: of the run.
        read_only: the file must exist; another process may write it.

    Raises:
        UmfError: the file is damaged, or another process writes it.
        OutputError: the file cannot be written.
    """

    def __init__(self, folder: Path, read_only: bool = False) -> None:
        self._folder, self._path = folder, folder / NAME
        self._read_only = read_only
        if not read_only and not self._path.exists():
            _set_aside(folder)
        self._file = SqliteFile(self._path, SCHEMA, read_only=read_only)
        self._received = 0
        self._odometry: deque[tuple[int, int, bytes]] = deque()
        self._absolute: list[tuple[str, int, int, bytes]] = []

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Open a transaction, which also writes the odometry received since the last one."""
        with self._file.writing() as connection:
            connection.executemany("INSERT OR IGNORE INTO odometry VALUES (?, ?, ?, NULL)", self._odometry)
            connection.executemany("INSERT OR IGNORE INTO absolute VALUES (?, ?, ?, ?)", self._absolute)
            yield
        self._odometry.clear()
        self._absolute.clear()

    def append(self, table: str, rows: Iterable[Sequence[Any]]) -> None:
        """Add rows to a table, within a transaction; closures with the number of odometry messages before them."""
        before = {"odometry_before": self._received} if table == "closures" else {}
        columns = [*COLUMNS[table], *before]
        statement = f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})"
        self._file.connection.executemany(statement, ([*row, *before.values()] for row in rows))

    def append_descriptor(self, stamp_ns: int, descriptor: Points) -> None:
        """Add the descriptor (D,) of a keyframe in half precision, within a transaction."""
        data = np.asarray(descriptor, np.float16).tobytes()
        self._file.connection.execute("INSERT INTO descriptor VALUES (?, ?)", (stamp_ns, data))

    def append_picture(self, picture: Picture) -> None:
        """Add the pictures of a keyframe, within a transaction."""
        values = (*picture[:4], picture.scan.astype("<i2").tobytes())
        self._file.connection.execute("INSERT INTO picture VALUES (?, ?, ?, ?, ?)", values)

    def append_odometry(self, odometry: OdometrySample) -> None:
        """Add the next odometry of the recording with the next transaction; a known one stays."""
        numbers = np.ascontiguousarray(odometry.odom_T_body[:3], np.float64).tobytes()
        self._odometry.append((self._received, odometry.stamp_ns, numbers))
        self._received += 1

    def append_absolute(self, measurement: AbsoluteMeasurement) -> None:
        """Add the next measurement of the recording with the next transaction; a known one stays."""
        numbers = np.ascontiguousarray(measurement.numbers, np.float64).tobytes()
        self._absolute.append((measurement.source.value, measurement.stamp_ns, self._received, numbers))

    def note(self, **values: Any) -> None:
        """Write facts about the run by name, within a transaction."""
        self._file.connection.executemany("INSERT OR REPLACE INTO about VALUES (?, ?)", values.items())

    def facts(self) -> dict[str, Any]:
        """Return facts about the run by name."""
        with self._file.reading() as connection:
            return dict(connection.execute("SELECT name, value FROM about"))

    def rows(self, table: str) -> list[tuple[Any, ...]]:
        """Return the rows of a table in the columns of its CSV file, in the order of their arrival."""
        with self._file.reading() as connection:
            return connection.execute(f"SELECT {', '.join(COLUMNS[table])} FROM {table} ORDER BY rowid").fetchall()

    def closures(self) -> list[LoopClosure]:
        """Return the closures of the run."""
        with self._file.reading():
            return [parse_closure(dict(zip(CLOSURES, row, strict=True))) for row in self.rows("closures")]

    def odometry(self) -> list[OdometrySample]:
        """Return the odometry of the run in the order of arrival.

        An `UmfError` refuses poses that an earlier release estimated from keyframe to keyframe.
        """
        found = []
        with self._file.reading() as connection:
            for _, stamp_ns, data, estimated in connection.execute("SELECT * FROM odometry ORDER BY number"):
                if estimated is not None:
                    raise UmfError(f"{self._path} has no odometry, only estimates between keyframes: map it again")
                pose = np.vstack([np.frombuffer(data, np.float64).reshape(3, 4), (0, 0, 0, 1)])
                found.append(OdometrySample(int(stamp_ns), pose))
        return found

    def graph_inputs(self) -> Iterator[GraphInput]:
        """Yield the odometry, closures and absolute measurements in the order in which the graph received them."""
        inputs: list[tuple[int, GraphInput]] = []
        with self._file.reading() as connection:
            before = connection.execute("SELECT odometry_before FROM closures ORDER BY rowid").fetchall()
            for source, stamp_ns, number, data in connection.execute("SELECT * FROM absolute ORDER BY rowid"):
                numbers = np.frombuffer(data, np.float64)
                inputs.append((number, AbsoluteMeasurement.stored(source, stamp_ns, numbers)))
        inputs += zip((number for (number,) in before), self.closures(), strict=True)
        waiting = deque(sorted(inputs, key=lambda one: one[0]))
        for number, odometry in enumerate(self.odometry()):
            while waiting and waiting[0][0] <= number:
                yield waiting.popleft()[1]
            yield odometry
        yield from (item for _, item in waiting)

    def descriptors(self) -> dict[int, Points]:
        """Return the descriptors (D,) float32 of the keyframes by stamp, in order."""
        with self._file.reading() as connection:
            rows = connection.execute("SELECT stamp_ns, data FROM descriptor ORDER BY rowid")
            return {int(stamp): np.frombuffer(data, np.float16).astype(np.float32) for stamp, data in rows}

    def pictures(self) -> Iterator[Picture]:
        """Yield the pictures of the keyframes."""
        with self._file.reading() as connection:
            for stamp_ns, jpeg, width, height, scan in connection.execute("SELECT * FROM picture ORDER BY rowid"):
                yield Picture(stamp_ns, jpeg, width, height, np.frombuffer(scan, "<i2").reshape(-1, 3))

    def export(self, localizing: bool = False) -> None:
        """Write the CSV tables; that of poses in a map also without rows if the run is localising."""
        for name, columns in COLUMNS.items():
            rows = self.rows(name)
            if rows or name in ALWAYS or (localizing and name == "localization"):
                write_table(self._folder / f"{name}.csv", columns, rows)

    def close(self) -> None:
        """Write the remaining odometry, and close the file."""
        if self._odometry or self._absolute:
            with self.writing():
                pass
        if not self._read_only:
            with suppress(sqlite3.Error):  # another process reads it
                self._file.connection.execute("PRAGMA journal_mode = DELETE")  # readers leave no files beside it
        self._file.close()
        if not self._read_only:
            with suppress(OSError):
                self._path.with_name(f"{NAME}.lock").unlink()


def _set_aside(folder: Path) -> None:
    """Rename the tables of an earlier release, which a new run would overwrite."""
    for path in [found for name in COLUMNS if (found := folder / f"{name}.csv").exists()]:
        with writing(path):
            path.rename(next(name for i in count(1) if not (name := path.with_suffix(f".{i}.csv")).exists()))


def read_descriptors(folder: Path) -> dict[int, Points]:
    """Return the descriptors (D,) float32 of the keyframes of a run by stamp, in order."""
    with closing(RunFile(folder, read_only=True)) as file:
        return file.descriptors()


def read_odometry_of(folder: Path) -> Trajectory | None:
    """Return the recorded odometry messages of a run with increasing stamps; None without any."""
    with closing(RunFile(folder, read_only=True)) as file:
        return Trajectory.rising(file.odometry())


def closure_row(closure: LoopClosure, similarity: float) -> list[Any]:
    """Return the row of `closures.csv`: `match_T_query`, one sigma per axis of the match body, probability, covariance.

    The upper triangle of the covariance is written row by row, 21 numbers in one cell.
    """
    numbers = [*pose_numbers(closure.match_T_query, closure.covariance), closure.probability, similarity]
    triangle = " ".join(f"{value:.9g}" for value in closure.covariance[np.triu_indices(6)])
    return [*closure.endpoints, *(f"{number:.9g}" for number in numbers), triangle]


def as_stored(closure: LoopClosure) -> LoopClosure:
    """Return a closure with the numbers of its row, which are rounded."""
    return parse_closure(dict(zip(CLOSURES, closure_row(closure, float("nan")), strict=True)))


def pose_numbers(pose: Array, covariance: Array) -> list[float]:
    """Return the values of `POSE` and `SIGMA` of a pose (4, 4) and its covariance (6, 6): roots of the diagonal."""
    return [*pose[:3, 3], *to_quaternion(pose), *np.sqrt(np.diag(covariance))]


def candidate_row(hypothesis: Hypothesis) -> list[Any]:
    """Return the row of `candidates.csv`: the reason with its figures, and all measurements as JSON."""
    numbers = json.dumps({name: float(f"{value:.6g}") for name, value in hypothesis.numbers.items()})
    reason = hypothesis.reason.value if hypothesis.reason else ACCEPTED
    similarity = f"{hypothesis.candidate.similarity:.6f}"
    return [*hypothesis.endpoints, similarity, reason, hypothesis.detail, numbers]


def inlier_rows(hypothesis: Hypothesis) -> list[list[Any]]:
    """Return the rows of `inliers.csv`: pixels of the same point in both left images."""
    pixels = hypothesis.inlier_pixels.tolist()
    return [[*hypothesis.endpoints, *(f"{value:.1f}" for value in one)] for one in pixels]


def read_table(path: Path, parse: Callable[[dict[str, str]], Row]) -> list[Row]:
    """Return the result of `parse` for every row, which is given by column."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(iter(partial(file.readline, LONGEST_LINE), ""))
            return [parse(row) for row in reader]
    except OSError as error:
        raise UmfError(f"cannot read {path}: {error.strerror}") from None
    except (KeyError, TypeError, ValueError, csv.Error):
        raise UmfError(f"{path}, line {reader.line_num}: not a row of this table") from None


def parse_candidate(row: dict[str, str]) -> Hypothesis:
    """Return the hypothesis in a row of `candidates.csv`; a reason of another version is kept as its detail."""
    numbers = {name: float(value) for name, value in json.loads(row["numbers"]).items()}
    candidate = Candidate(-1, int(row["match_stamp_ns"]), float(row["similarity"]))
    probability, measurements = numbers.pop("probability", None), {"similarity": candidate.similarity} | numbers
    found = Hypothesis(int(row["query_stamp_ns"]), candidate, measurements, probability=probability)
    if row["reason"] != ACCEPTED:
        try:
            found.reject(RejectReason(row["reason"]), row.get("detail") or "")
        except ValueError:
            found.reject(RejectReason.UNKNOWN, row["reason"])
    return found


def read_verdicts(path: Path, closures: Iterable[LoopClosure]) -> dict[Endpoints, ClosureVerdict]:
    """Return the graph's verdicts on closures of a run by their endpoints; empty without a graph."""
    known = {one.endpoints: one for one in closures}

    def parse(row: dict[str, str]) -> ClosureVerdict | None:
        match, query, state, reason, residual, residual_m = (row[name] for name in VERDICT_COLUMNS)
        closure = known.get((int(query), int(match)))
        decision = State(state), ClosureReason(reason), float(residual), float(residual_m)
        return None if closure is None else ClosureVerdict(closure, *decision)

    found = read_table(path, parse) if path.is_file() else []
    return {one.closure.endpoints: one for one in found if one is not None}


def read_absolute_verdicts(path: Path) -> list[AbsoluteVerdict]:
    """Return the verdicts on absolute measurements of a run; empty without a table."""

    def parse(row: dict[str, str]) -> AbsoluteVerdict:
        decision = State(row["verdict"]), AbsoluteReason(row["reason"])
        figures = float(row["mahalanobis"]), float(row["misfit"])
        return AbsoluteVerdict(Aid(row["source"]), int(row["stamp_ns"]), *decision, *figures)

    return read_table(path, parse) if path.is_file() else []


def read_keyframes(path: Path) -> NDArray[np.void]:
    """Return the keyframes by stamp: (N,) `stamp_ns`, `session`, and `path_length_m`, NaN if unknown."""
    rows = read_table(path, lambda row: (int(row["stamp_ns"]), int(row["session"]), float(row["travelled_m"])))
    return np.array(rows, KEYFRAME)


def read_inliers(path: Path) -> dict[Endpoints, Array]:
    """Return the pixels (K, 4) of the inliers of every closure, in its query and its match."""
    query, match, *pixels = COLUMNS["inliers"]
    lines: dict[Endpoints, list[list[float]]] = defaultdict(list)

    def parse(row: dict[str, str]) -> None:
        lines[int(row[query]), int(row[match])].append([float(row[name]) for name in pixels])

    read_table(path, parse)
    return {key: np.array(rows) for key, rows in lines.items()}


def read_closures(path: Path) -> list[LoopClosure]:
    """Return the closures of a `closures.csv`; with a diagonal covariance from an older version."""
    return read_table(path, parse_closure)


def parse_closure(row: Mapping[str, Any]) -> LoopClosure:
    """Return the closure in a row of `closures.csv`."""
    numbers = [float(row[name]) for name in CLOSURES[2:16]]
    covariance = np.diag(np.square(numbers[7:13]))
    if triangle := (row.get("covariance") or "").split():
        covariance[np.triu_indices(6)] = [float(number) for number in triangle]
        covariance = np.triu(covariance) + np.triu(covariance, 1).T
    return LoopClosure(
        query_stamp_ns=int(row["query_stamp_ns"]),
        match_stamp_ns=int(row["match_stamp_ns"]),
        match_T_query=from_quaternion(numbers[:3], numbers[3:7]),
        covariance=covariance,
        probability=numbers[13],
    )
