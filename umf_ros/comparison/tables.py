"""Lists of pairs, and the verdicts about them, as CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.comparison.comparer import Comparison
from umf_ros.comparison.views import PlaceView
from umf_ros.core.errors import ConfigError
from umf_ros.core.geometry import to_quaternion

Pair = tuple[PlaceView, PlaceView]
Row = dict[str, Any]

VIEW_COLUMNS = ("match_scan", "query_scan", "match_left", "match_right", "query_left", "query_right")
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
SIGMA = ("sigma_x", "sigma_y", "sigma_z", "sigma_rx", "sigma_ry", "sigma_rz")
RESULT_COLUMNS = ("accepted", "probability", *POSE, *SIGMA, "reason", "milliseconds", "similarity")
"""`match_T_query` in m, its standard deviations in m and rad about the axes of the match body."""


def read_pairs(path: Path) -> list[Pair]:
    """Match and query of every row; paths relative to the list.

    Raises:
        ConfigError: the list cannot be read, names no views, or holds no pair.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            known = [name for name in reader.fieldnames or () if name in VIEW_COLUMNS]
            if not known:
                raise ConfigError(f"{path} has none of the columns {', '.join(VIEW_COLUMNS)}")
            pairs = [(_view("match", row, path.parent), _view("query", row, path.parent)) for row in reader]
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path} is no CSV file: {error}") from None
    if not pairs:
        raise ConfigError(f"{path} holds no pair")
    return pairs


def view_row(match: PlaceView, query: PlaceView, base: Path) -> dict[str, str]:
    """The columns of a list that name two views; paths relative to the list where they lie beside or below it."""
    names = {
        f"{role}_{part}": name for role, view in (("match", match), ("query", query)) for part, name in _parts(view)
    }
    return {column: _relative(names[column], base) for column in VIEW_COLUMNS}


def result_row(comparison: Comparison) -> Row:
    """The columns that say what was found, None where nothing was."""
    row: Row = dict.fromkeys(RESULT_COLUMNS)
    row |= {"accepted": int(comparison.closure is not None), "reason": comparison.reason}
    row |= {"milliseconds": round(comparison.milliseconds, 1), "similarity": round(comparison.similarity, 6)}
    if comparison.probability is not None:
        row["probability"] = round(comparison.probability, 6)
    if comparison.closure is not None:
        pose, sigma = comparison.closure.match_T_query, np.sqrt(np.diag(comparison.closure.covariance))
        numbers = [*pose[:3, 3], *to_quaternion(pose), *sigma]
        row |= dict(zip((*POSE, *SIGMA), (float(f"{number:.9g}") for number in numbers), strict=True))
    return row


def failed_row(reason: str) -> Row:
    """The same of a pair that could not be compared."""
    return dict.fromkeys(RESULT_COLUMNS) | {"accepted": 0, "reason": reason}


def _parts(view: PlaceView) -> Iterable[tuple[str, str]]:
    return ("scan", view.scan), ("left", view.left), ("right", view.right)


def _view(role: str, row: dict[str, str | None], base: Path) -> PlaceView:
    names = ((row.get(f"{role}_{part}") or "").strip() for part, _ in _parts(PlaceView()))
    return PlaceView(*(str(base / name) if name else "" for name in names))


def _relative(name: str, base: Path) -> str:
    path = Path(name)
    return str(path.relative_to(base)) if name and path.is_relative_to(base) else name
