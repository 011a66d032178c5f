"""Arrays that grow."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Table:
    """Named columns, given as (0, ...) arrays, that grow in amortised constant time and can be cut back."""

    def __init__(self, **columns: NDArray[Any]) -> None:
        self._columns = columns
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return (N, ...) rows of a column; valid until the next change."""
        return self._columns[name][: self._size]

    def extend(self, **rows: ArrayLike) -> None:
        """Append (N, ...) rows of every column."""
        start, self._size = self._size, self._size + len(np.asarray(next(iter(rows.values()))))
        for name, column in self._columns.items():
            if self._size > len(column):
                column = self._columns[name] = np.resize(column, (2 * self._size, *column.shape[1:]))
            column[start : self._size] = rows[name]

    def truncate(self, size: int) -> None:
        """Keep the first `size` rows."""
        self._size = size
