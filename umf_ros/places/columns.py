"""What is known of every place, as columns that grow."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Columns:
    """Arrays of one length that grow at their end; each doubles when it is full.

    Args:
        types: data type of every column, by name.
    """

    def __init__(self, **types: type) -> None:
        self._columns: dict[str, NDArray[Any]] = {name: np.empty(256, kind) for name, kind in types.items()}
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, name: str) -> NDArray[Any]:
        """(N,) view of a column; valid until the next change."""
        return self._columns[name][: self._size]

    def append(self, **values: float) -> None:
        """Append one row."""
        for name, value in values.items():
            column = self._columns[name]
            if self._size == len(column):
                column = self._columns[name] = np.resize(column, 2 * self._size)
            column[self._size] = value
        self._size += 1
