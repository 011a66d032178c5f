"""FAISS index of the global descriptors of all places."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import one_line
from umf_ros.core.io import atomic_write

logger = logging.getLogger(__name__)

EXACT_UP_TO = 50_000
"""Up to so many places every descriptor is compared (*measured*: 4 ms with 768 numbers each)."""
SHORTLIST = 3000
"""Descriptors whose half-precision products decide in a larger database (*measured*, as above: recall)."""
DIRECTIONS = 96
"""Principal components of the compressed codes, of four bits each (*measured*, as above: recall)."""
SAMPLE = 16_384
"""Descriptors that the compressed codes are trained with (*by hand*)."""
SAME_NUMBER = 1e-3
"""Half precision changes a component of a unit vector by less."""

Rows = NDArray[np.intp]
Mask = NDArray[np.bool_]
Descriptors = NDArray[np.float32]
Admissible = Callable[[Rows | slice], Mask]
"""Mask of the rows that may be returned, among some rows or a slice of all."""


class PlaceIndex:
    """Growing index of unit descriptors in half precision, searched by inner product on one thread.

    Up to `EXACT_UP_TO` descriptors all are compared. In a larger index compressed codes select a shortlist, whose
    half-precision products decide.

    Args:
        dimension: numbers per descriptor.
    """

    def __init__(self, dimension: int) -> None:
        with _one_thread() as faiss:
            half = faiss.ScalarQuantizer.QT_fp16
            self._flat = self._index = faiss.IndexScalarQuantizer(dimension, half, faiss.METRIC_INNER_PRODUCT)

    def __len__(self) -> int:
        return int(self._flat.ntotal)

    @property
    def is_exact(self) -> bool:
        """Whether a search compares every descriptor."""
        return self._index is self._flat

    def add(self, descriptors: Descriptors) -> None:
        """Append (N, D) descriptors."""
        with _one_thread():
            self._index.add(np.ascontiguousarray(descriptors, np.float32))

    def compress(self) -> None:
        """Build the codes of an index that has become too large for exact search: some seconds of one core."""
        if not self.is_exact or len(self) <= EXACT_UP_TO:
            return
        size = min(DIRECTIONS, self._flat.d)
        with _one_thread() as faiss:
            sample = self.descriptors(np.unique(np.linspace(0, len(self) - 1, SAMPLE).astype(np.intp)))
            # principal axes without centring, unlike those of faiss.PCAMatrix: it would change the order of products
            axes = np.linalg.eigh(sample.T @ sample)[1][:, -size:]
            projection = faiss.LinearTransform(self._flat.d, size, False)
            faiss.copy_array_to_vector(np.ascontiguousarray(axes.T).ravel(), projection.A)
            projection.is_trained = True
            quantizer = faiss.index_factory(size, f"PQ{size}x4fs", faiss.METRIC_INNER_PRODUCT)
            codes = faiss.IndexPreTransform(projection, quantizer)
            codes.train(sample)
            for first in range(0, len(self), SAMPLE):
                codes.add(self._flat.reconstruct_n(first, min(SAMPLE, len(self) - first)))
            self._index = faiss.IndexRefine(codes, self._flat)

    def descriptors(self, rows: Rows) -> Descriptors:
        """(N, D) descriptors of some rows, in half precision."""
        return np.asarray(self._flat.reconstruct_batch(rows))

    def search(self, descriptor: Descriptors, count: int, admissible: Admissible) -> Rows:
        """Rows of the `count` descriptors that are most similar to a unit vector (D,), best first.

        A large index is searched through its shortlist, and exhaustively where too few of the list are admissible.
        """
        if not self.is_exact:
            with _one_thread():
                _, found = self._index.search(descriptor[None], min(SHORTLIST, len(self)))
            rows: Rows = found[0][found[0] >= 0]
            rows = rows[admissible(rows)]
            if len(rows) >= count:
                return rows[:count]
        return self.search_exactly(descriptor, count, admissible)

    def search_exactly(self, descriptor: Descriptors, count: int, admissible: Admissible) -> Rows:
        """The same by comparing every descriptor, however many there are."""
        if not len(self):
            return np.empty(0, np.intp)
        with _one_thread() as faiss:
            selector = faiss.IDSelectorBitmap(np.packbits(admissible(slice(None)), bitorder="little"))
            rules = faiss.SearchParameters(sel=selector)
            _, found = self._flat.search(descriptor[None], min(count, len(self)), params=rules)
        return np.asarray(found[0][found[0] >= 0])

    def save(self, path: Path) -> None:
        """Write the index to a file for `load`."""
        with atomic_write(path, RuntimeError) as part, _one_thread() as faiss:
            faiss.write_index(self._index, str(part))

    @classmethod
    def load(cls, path: Path, dimension: int) -> PlaceIndex | None:
        """The index in a file; None where there is none of this kind and dimension."""
        if not path.is_file():
            return None
        index = cls(dimension)
        with _one_thread() as faiss:
            try:
                stored = faiss.read_index(str(path))
            except Exception as error:  # damaged bytes raise any exception
                logger.warning("%s cannot be read and is built again: %s", path, one_line(error))
                return None
            flat = faiss.downcast_index(stored.refine_index) if isinstance(stored, faiss.IndexRefine) else stored
            if not isinstance(flat, faiss.IndexScalarQuantizer) or flat.d != dimension:
                return None
            index._index, index._flat = stored, flat
        return index


@contextmanager
def _one_thread() -> Iterator[Any]:
    """FAISS on the calling thread alone: waiting OpenMP threads would take the cores from the network."""
    import faiss

    threads = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    try:
        yield faiss
    finally:
        faiss.omp_set_num_threads(threads)
