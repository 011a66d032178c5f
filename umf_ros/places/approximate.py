"""Search among more places than an exhaustive one has the time for: FAISS, where it is installed."""

from __future__ import annotations

import logging
import threading
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.errors import writing
from umf_ros.places.codes import CodeTable, Rows, Scores
from umf_ros.places.projection import principal_axes

logger = logging.getLogger(__name__)

APPROXIMATE_FROM = 100_000
"""Up to so many places search is exact."""
SHORTLIST = 3000
"""So many of a million are compared more closely (*measured*: what `umf bench places` prints as recall)."""
DIRECTIONS = 96
"""Principal components that are looked at, four bits of each (*measured*, as above)."""
SAMPLE = 32_768
"""So many descriptors say which directions and which steps those are (*by hand*)."""
BATCH = 8192


class ApproximateIndex:
    """Four bits for each of a few principal components of every descriptor, all compared at once.

    Args:
        index: of FAISS.
    """

    def __init__(self, index: Any) -> None:
        self._index = index

    def __len__(self) -> int:
        return int(self._index.ntotal)

    @classmethod
    def of(cls, table: CodeTable) -> ApproximateIndex:
        """The index of all descriptors of a table: some ten seconds' work of one core for a million.

        Raises:
            ModuleNotFoundError: FAISS is not installed.
        """
        import faiss

        rows = np.unique(np.linspace(0, len(table) - 1, SAMPLE).astype(np.intp))
        axes = principal_axes(table.descriptors(rows), DIRECTIONS)
        # not centred, as faiss would: products keep their order along the axes alone
        projection = faiss.LinearTransform(table.dimension, axes.shape[1], False)
        faiss.copy_array_to_vector(np.ascontiguousarray(axes.T).ravel(), projection.A)
        projection.is_trained = projection.is_orthonormal = True
        codes = faiss.index_factory(axes.shape[1], f"PQ{axes.shape[1]}x4fs", faiss.METRIC_INNER_PRODUCT)
        index = cls(faiss.IndexPreTransform(projection, codes))
        index._index.train(table.descriptors(rows))
        index.extend(table, len(table))
        return index

    def extend(self, table: CodeTable, count: int) -> None:
        """Take up the rows of a table that came since, up to the first `count`."""
        for first in range(len(self), count, BATCH):
            self._index.add(table.descriptors(slice(first, min(first + BATCH, count))))

    def search(self, descriptor: Scores, wider: int = 1) -> Rows:
        """Rows of the descriptors that are most similar as far as so few bits tell, in order.

        Args:
            descriptor: (D,) float32 unit vector.
            wider: so many times the usual number.
        """
        _, rows = self._index.search(descriptor[None], min(len(self), wider * SHORTLIST))
        return np.sort(rows[0][rows[0] >= 0]).astype(np.intp)

    def save(self, path: Path) -> None:
        """Write a file for `load`, in one step.

        Raises:
            OutputError: it cannot be written.
        """
        import faiss

        part = path.with_name(path.name + ".part")
        with writing(path, RuntimeError):
            try:
                faiss.write_index(self._index, str(part))
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: Path, table: CodeTable) -> ApproximateIndex | None:
        """The index that was saved for the first rows of a table; None where there is none that fits."""
        if not path.is_file() or not has_faiss():
            return None
        import faiss

        try:
            index = faiss.read_index(str(path))
        except RuntimeError as error:
            logger.warning("%s is made anew: %s", path, str(error).splitlines()[0][:200])
            return None
        return cls(index) if index.d == table.dimension and index.ntotal <= len(table) else None


class Builder:
    """Makes an index in a thread of its own, so that places are found meanwhile as before."""

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._made: ApproximateIndex | None = None

    def start(self, table: CodeTable) -> None:
        """Begin, unless it is at work; rows that the table gets from now on are not in the index."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._make, args=(table.frozen(),), daemon=True)
            self._thread.start()

    def wait(self) -> None:
        """Wait until the index is made."""
        if self._thread is not None:
            self._thread.join()

    def take(self) -> ApproximateIndex | None:
        """The index, once, when it is made."""
        made, self._made = self._made, None
        if made is not None:
            self._thread = None
        return made

    def _make(self, table: CodeTable) -> None:
        self._made = ApproximateIndex.of(table)


@cache
def has_faiss() -> bool:
    """Whether FAISS is installed; says so, once, where it is not."""
    if find_spec("faiss") is None:
        logger.warning("search stays exhaustive, and grows slow: faiss is not installed (umf_ros[fleet])")
        return False
    return True
