"""Columns and rows of the CSV tables of a run.

A table that cannot be read raises an `UmfError`, which names the file and the damaged line.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from umf_ros.core.errors import UmfError
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, from_quaternion, to_quaternion
from umf_ros.core.io import atomic_write
from umf_ros.pose_graph.closures import VERDICT_COLUMNS, State

if TYPE_CHECKING:
    from umf_ros.verification import Verdict

POSE = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]
SIGMA = ["sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rx_rad", "sigma_ry_rad", "sigma_rz_rad"]
COVARIANCE = "covariance"
CLOSURES = ["query_stamp_ns", "match_stamp_ns", *POSE, *SIGMA, "probability", "similarity", COVARIANCE]
CLOSURES_BETWEEN = ["match_robot", *CLOSURES]
CANDIDATES = ["query_stamp_ns", "match_stamp_ns", "similarity", "reason", "numbers"]
KEYFRAMES = ["stamp_ns", "session", "travelled_m"]
STAGES = ("embed", "query", "verify", "submaps", "total")
LATENCIES = ["stamp_ns", *STAGES]
INLIERS = ["query_stamp_ns", "match_stamp_ns", "query_u", "query_v", "match_u", "match_v"]
LOCALIZATION = ["stamp_ns", *POSE, *SIGMA, "probability"]
COLUMNS = {
    "keyframes": KEYFRAMES,
    "latencies": LATENCIES,
    "candidates": CANDIDATES,
    "closures": CLOSURES,
    "inliers": INLIERS,
    "closures_between": CLOSURES_BETWEEN,
    "localization": LOCALIZATION,
}
"""Columns of each table, which is exported as `<name>.csv`."""
Row = TypeVar("Row")

Endpoints = tuple[int, int]
"""Stamps in ns of a closure's query and match."""


@dataclass(frozen=True, slots=True)
class TestedCandidate:
    """A row of `candidates.csv`.

    Attributes:
        query_stamp_ns, match_stamp_ns: keys of both keyframes.
        similarity: of the global descriptors.
        reason: "accepted", or what stopped it.
        numbers: what was measured, by name.
    """

    query_stamp_ns: int
    match_stamp_ns: int
    similarity: float
    reason: str
    numbers: dict[str, float]

    @property
    def endpoints(self) -> Endpoints:
        """Stamps of query and match."""
        return self.query_stamp_ns, self.match_stamp_ns

    @property
    def probability(self) -> float | None:
        """That the pose found is right; None where no pose was found or tried."""
        return self.numbers.get("probability")

    @classmethod
    def parse(cls, row: dict[str, str]) -> TestedCandidate:
        """The candidate in a row by column."""
        numbers = {name: float(value) for name, value in json.loads(row["numbers"]).items()}
        stamps = int(row["query_stamp_ns"]), int(row["match_stamp_ns"])
        return cls(*stamps, float(row["similarity"]), row["reason"], numbers)


@dataclass(frozen=True, slots=True)
class GraphVerdict:
    """A row of `graph_verdicts.csv`: what the pose graph did with a closure in the end.

    Attributes:
        state: a `pose_graph.closures.State`.
        reason: a short phrase.
        sigma: Mahalanobis distance to the map, NaN where unknown.
        misfit_m: distance in metres between the closure's and the map's opinion, NaN where unknown.
    """

    state: str
    reason: str
    sigma: float
    misfit_m: float

    @property
    def figures(self) -> str:
        """Distances to the map in brackets; empty where they are unknown."""
        return f" ({self.sigma:.1f} sigma, {self.misfit_m:.2f} m)" if np.isfinite(self.sigma) else ""

    @classmethod
    def parse(cls, row: dict[str, str]) -> tuple[Endpoints, GraphVerdict]:
        """Endpoints and verdict in a row by column."""
        match, query, state, reason, sigma, misfit_m = (row[name] for name in VERDICT_COLUMNS)
        return (int(query), int(match)), cls(State(state), reason, float(sigma), float(misfit_m))


@dataclass(frozen=True, slots=True)
class KeyframeRow:
    """A row of `keyframes.csv`: stamp in ns, session, and path length in m, NaN without odometry."""

    stamp_ns: int
    session: int
    path_length_m: float

    @classmethod
    def parse(cls, row: dict[str, str]) -> KeyframeRow:
        """The keyframe in a row by column."""
        return cls(int(row["stamp_ns"]), int(row["session"]), float(row["travelled_m"]))


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV file in one step.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def closure_row(closure: LoopClosure, similarity: float) -> list[Any]:
    """Row of `closures.csv`: `match_T_query`, one sigma per axis of the match body, probability, covariance.

    Of the covariance the upper triangle is written, row by row, 21 numbers in one cell.
    """
    pose = closure.match_T_query
    sigma = np.sqrt(np.diag(closure.covariance))
    numbers = [*pose[:3, 3], *to_quaternion(pose), *sigma, closure.probability, similarity]
    triangle = " ".join(f"{value:.9g}" for value in closure.covariance[np.triu_indices(6)])
    return [closure.query_stamp_ns, closure.match_stamp_ns, *(f"{number:.9g}" for number in numbers), triangle]


def candidate_row(query_stamp_ns: int, verdict: Verdict) -> list[Any]:
    """Row of `candidates.csv`: everything that was measured, as JSON."""
    numbers = json.dumps({name: float(f"{value:.6g}") for name, value in verdict.numbers.items()})
    candidate = verdict.candidate
    return [query_stamp_ns, candidate.stamp_ns, f"{candidate.similarity:.6f}", verdict.reason, numbers]


def inlier_rows(query_stamp_ns: int, verdict: Verdict) -> list[list[Any]]:
    """Rows of `inliers.csv`: pixels of both left images that see the same point."""
    return [
        [query_stamp_ns, verdict.candidate.stamp_ns, *(f"{value:.1f}" for value in pixels)]
        for pixels in verdict.inlier_pixels.tolist()
    ]


def read_table(path: Path, parse: Callable[[dict[str, str]], Row]) -> list[Row]:
    """Return the result of `parse` for every row, which is given by column."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            return [parse(row) for row in reader]
    except OSError as error:
        raise UmfError(f"cannot read {path}: {error.strerror}") from None
    except (KeyError, TypeError, ValueError, csv.Error):
        raise UmfError(f"{path}, line {reader.line_num}: not a row of this table") from None


def read_keyframes(path: Path) -> list[KeyframeRow]:
    """The keyframes in the order of their stamps."""
    return read_table(path, KeyframeRow.parse)


def read_closures(path: Path) -> list[LoopClosure]:
    """The closures of a `closures.csv`; with a diagonal covariance where an older version wrote no other."""
    return read_table(path, parse_closure)


def parse_closure(row: dict[str, str]) -> LoopClosure:
    """The closure in a row of `closures.csv`."""
    numbers = [float(row[name]) for name in CLOSURES[2:16]]
    return LoopClosure(
        query_stamp_ns=int(row["query_stamp_ns"]),
        match_stamp_ns=int(row["match_stamp_ns"]),
        match_T_query=from_quaternion(numbers[:3], numbers[3:7]),
        covariance=_covariance(row, numbers[7:13]),
        probability=numbers[13],
    )


def _covariance(row: dict[str, str], sigmas: list[float]) -> Array:
    triangle = [float(number) for number in (row.get(COVARIANCE) or "").split()]
    if not triangle:
        return np.diag(np.square(sigmas))
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = triangle
    return upper + np.triu(upper, 1).T
