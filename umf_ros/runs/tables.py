"""Columns and rows of the CSV tables of a run.

A table that cannot be read raises an `UmfError`, which names the file and the damaged line.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Candidate, LoopClosure
from umf_ros.core.geometry import Array, from_quaternion, to_quaternion
from umf_ros.core.io import atomic_write
from umf_ros.pose_graph.closures import VERDICT_COLUMNS, ClosureReason, ClosureVerdict, State
from umf_ros.verification.hypothesis import ACCEPTED, Hypothesis, RejectReason

POSE = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]
SIGMA = ["sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rx_rad", "sigma_ry_rad", "sigma_rz_rad"]
COVARIANCE = "covariance"
CLOSURES = ["query_stamp_ns", "match_stamp_ns", *POSE, *SIGMA, "probability", "similarity", COVARIANCE]
CLOSURES_BETWEEN = ["match_robot", *CLOSURES]
CANDIDATES = ["query_stamp_ns", "match_stamp_ns", "similarity", "reason", "detail", "numbers"]
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
_REASONS = {reason.value for reason in RejectReason}
_VERDICT_REASONS = {reason.value for reason in ClosureReason}
Row = TypeVar("Row")

Endpoints = tuple[int, int]
"""Stamps in ns of a closure's query and match."""


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


def candidate_row(hypothesis: Hypothesis) -> list[Any]:
    """Row of `candidates.csv`: the reason with its figures, and all measurements as JSON."""
    numbers = json.dumps({name: float(f"{value:.6g}") for name, value in hypothesis.numbers.items()})
    reason = hypothesis.reason.value if hypothesis.reason else ACCEPTED
    similarity = f"{hypothesis.candidate.similarity:.6f}"
    return [*hypothesis.endpoints, similarity, reason, hypothesis.detail, numbers]


def inlier_rows(hypothesis: Hypothesis) -> list[list[Any]]:
    """Rows of `inliers.csv`: pixels of both left images that see the same point."""
    return [
        [*hypothesis.endpoints, *(f"{value:.1f}" for value in pixels)] for pixels in hypothesis.inlier_pixels.tolist()
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


def parse_candidate(row: dict[str, str]) -> Hypothesis:
    """The hypothesis in a row of `candidates.csv`; a reason of another version is kept as its detail."""
    numbers = {name: float(value) for name, value in json.loads(row["numbers"]).items()}
    candidate = Candidate(-1, int(row["match_stamp_ns"]), float(row["similarity"]))
    found = Hypothesis(int(row["query_stamp_ns"]), candidate, probability=numbers.pop("probability", None))
    found.measurements = {"similarity": candidate.similarity} | numbers
    reason, detail = row["reason"], row.get("detail") or ""
    if reason in _REASONS:
        found.reject(RejectReason(reason), detail)
    elif reason != ACCEPTED:
        found.reject(RejectReason.UNKNOWN, reason)
    return found


def read_verdicts(path: Path, closures: Iterable[LoopClosure]) -> dict[Endpoints, ClosureVerdict]:
    """The graph's verdicts on closures of a run by their endpoints; none without a graph."""
    known = {(one.query_stamp_ns, one.match_stamp_ns): one for one in closures}

    def parse(row: dict[str, str]) -> tuple[Endpoints, ClosureVerdict] | None:
        match, query, state, reason, residual, residual_m = (row[name] for name in VERDICT_COLUMNS)
        closure = known.get((int(query), int(match)))
        if closure is None:
            return None
        told = ClosureReason(reason) if reason in _VERDICT_REASONS else ClosureReason.UNKNOWN
        found = ClosureVerdict(closure, State(state), told, float(residual), float(residual_m))
        return (int(query), int(match)), found

    return dict(filter(None, read_table(path, parse))) if path.is_file() else {}


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
