"""Search among more places than an exhaustive one has the time for: FAISS, where it is installed."""

from __future__ import annotations

import logging
import threading
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.errors import writing
from umf_ros.places.codes import CodeTable, Rows, Scores

logger = logging.getLogger(__name__)

APPROXIMATE_FROM = 100_000
"""Up to so many places search is exact."""
PROBED = 512
"""Cells looked into, of thousands (*measured*: what `umf bench places` prints as recall)."""
SHORTLIST = 500
"""So many of what is found there are compared more closely (*measured*, as above)."""
DIRECTIONS = 96
"""Principal components that the cells know (*by hand*)."""
PER_CELL = 40
"""Descriptors per cell that say where the cells are: as many as FAISS wants at least."""
BATCH = 8192


class ApproximateIndex:
    """Descriptors in cells around typical ones, eight bits for each of their principal components.

    Args:
        index: of FAISS.
    """

    def __init__(self, index: Any) -> None:
        self._index = index

    def __len__(self) -> int:
        return int(self._index.ntotal)

    @classmethod
    def of(cls, table: CodeTable) -> ApproximateIndex:
        """The index of all descriptors of a table: a minute's work of one core for a million.

        Raises:
            ModuleNotFoundError: FAISS is not installed.
        """
        import faiss

        count, directions = len(table), min(DIRECTIONS, table.dimension)
        cells = int(2 ** np.round(np.log2(4 * np.sqrt(count))))
        rows = np.unique(np.linspace(0, count - 1, PER_CELL * cells).astype(np.intp))
        kind = f"PCA{directions},IVF{cells},SQ8"
        index = cls(faiss.index_factory(table.dimension, kind, faiss.METRIC_INNER_PRODUCT))
        index._index.train(table.descriptors(rows))
        index.extend(table, count)
        return index

    @property
    def suits(self) -> int:
        """Up to so many places its cells are small enough: four times as many as they were made for."""
        import faiss

        return 4 * (faiss.extract_index_ivf(self._index).nlist // 4) ** 2

    def extend(self, table: CodeTable, count: int) -> None:
        """Take up the rows of a table that came since, up to the first `count`."""
        for first in range(len(self), count, BATCH):
            self._index.add(table.descriptors(slice(first, min(first + BATCH, count))))

    def search(self, descriptor: Scores, wider: int = 1) -> Rows:
        """Rows of the most similar descriptors, as far as they lie in the cells nearest to the query, in order.

        Args:
            descriptor: (D,) float32 unit vector.
            wider: looks into so many times the cells, for so many times the rows.
        """
        import faiss

        faiss.extract_index_ivf(self._index).nprobe = wider * PROBED
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
