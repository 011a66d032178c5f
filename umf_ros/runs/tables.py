"""The CSV tables of a run, appended row by row so that an interrupted run keeps what it found."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar

import numpy as np

from umf_ros.errors import UmfError, writing
from umf_ros.frames import LoopClosure
from umf_ros.geometry import Array, from_quaternion, to_quaternion

if TYPE_CHECKING:
    from umf_ros.verification import Verdict

POSE = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]
SIGMA = ["sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rx_rad", "sigma_ry_rad", "sigma_rz_rad"]
COVARIANCE = "covariance"
CLOSURES = ["query_stamp_ns", "match_stamp_ns", *POSE, *SIGMA, "probability", "similarity", COVARIANCE]
CANDIDATES = ["query_stamp_ns", "match_stamp_ns", "similarity", "reason", "numbers"]
KEYFRAMES = ["stamp_ns", "session", "travelled_m"]
INLIERS = ["query_stamp_ns", "match_stamp_ns", "query_u", "query_v", "match_u", "match_v"]
Row = TypeVar("Row")


class CsvTable:
    """A CSV file with a header, flushed after every block of rows."""

    def __init__(self, path: Path, columns: list[str]) -> None:
        with writing(path):
            self._file: TextIO = path.open("w", newline="", encoding="utf-8")
        self._path = path
        self._writer = csv.writer(self._file)
        self.append([columns])

    def append(self, rows: list[Any]) -> None:
        """Write rows and hand them to the operating system."""
        with writing(self._path):
            self._writer.writerows(rows)
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


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
    """What `parse` makes of every row, given by column.

    Raises:
        UmfError: the file cannot be read; names the line that is damaged.
    """
    rows: list[Row] = []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            for row in reader:
                rows.append(parse(row))
    except OSError as error:
        raise UmfError(f"cannot read {path}: {error.strerror}") from None
    except (KeyError, TypeError, ValueError, csv.Error):
        raise UmfError(f"{path}, line {reader.line_num}: not a row of this table") from None
    return rows


def read_closures(path: Path) -> list[LoopClosure]:
    """The closures of a `closures.csv`; with a diagonal covariance where an older version wrote no other.

    Raises:
        UmfError: the file cannot be read; names the line that is damaged.
    """
    return read_table(path, _closure)


def _closure(row: dict[str, str]) -> LoopClosure:
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
