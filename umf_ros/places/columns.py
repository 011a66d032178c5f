"""What is known of every place, as columns that grow."""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

GROWTH = 1.25
"""A full column grows by this factor: adding costs a constant time on average, and a fifth at most stands empty."""


class Columns:
    """Arrays of one length that grow at their end.

    Args:
        types: data type of every column, by name; `(type, (n,))` for rows of n values.
    """

    def __init__(self, **types: DTypeLike) -> None:
        kinds = {name: np.dtype(kind) for name, kind in types.items()}
        self._columns: dict[str, NDArray[Any]] = {name: np.empty((0, *k.shape), k.base) for name, k in kinds.items()}
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, name: str) -> NDArray[Any]:
        """(N, ...) view of a column; valid until the next change."""
        return self._columns[name][: self._size]

    def frozen(self) -> Columns:
        """The columns as they are now: later rows do not reach them."""
        frozen = copy(self)
        frozen._columns = dict(self._columns)
        return frozen

    def append(self, **values: float) -> None:
        """Append one row."""
        self.extend(**{name: [value] for name, value in values.items()})

    def extend(self, **values: ArrayLike) -> None:
        """Append rows: an array for every column."""
        arrays = {name: np.asarray(value) for name, value in values.items()}
        (size,) = {self._size + len(array) for array in arrays.values()}
        for name, array in arrays.items():
            column = self._columns[name]
            if size > len(column):
                grown = np.empty((max(256, size, round(GROWTH * len(column))), *column.shape[1:]), column.dtype)
                grown[: self._size] = column[: self._size]
                column = self._columns[name] = grown
            column[self._size : size] = array
        self._size = size
