"""A growing stack of equal rows in one array."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray


class Rows:
    """An array that grows at its end in amortised constant time, and can be cut back."""

    def __init__(self, shape: tuple[int, ...] = (), dtype: DTypeLike = float) -> None:
        self._data: NDArray[Any] = np.empty((64, *shape), dtype)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def view(self) -> NDArray[Any]:
        """The rows so far; valid until the next change."""
        return self._data[: self._size]

    def extend(self, rows: ArrayLike) -> None:
        """Append (N, ...) rows."""
        added = np.asarray(rows)
        size = self._size + len(added)
        if size > len(self._data):
            grown = np.empty((max(size, 2 * len(self._data)), *self._data.shape[1:]), self._data.dtype)
            grown[: self._size] = self.view
            self._data = grown
        self._data[self._size : size] = added
        self._size = size

    def truncate(self, size: int) -> None:
        """Keep the first `size` rows."""
        self._size = min(size, self._size)
