"""Where in a store the descriptors most like a query are: exactly, or among very many places approximately."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from umf_ros.core.errors import OutputError
from umf_ros.places.approximate import APPROXIMATE_FROM, ApproximateIndex, Builder, has_faiss
from umf_ros.places.code_file import CodeFile
from umf_ros.places.codes import CodeTable, Rows, Scores
from umf_ros.places.index import DescriptorIndex, Found, Mask
from umf_ros.places.store import KeyframeStore

logger = logging.getLogger(__name__)

SAVED_EVERY = 4096
"""After so many keyframes their codes are written: what is read from the store at an opening after a crash."""
WIDER = (1, 8)
"""Where too few of what is near are admissible, so many times as much is looked through."""
ADDED_EVERY = 512
"""So many keyframes are taken into the approximate index at once; until then they are compared one by one."""

Admissible = Callable[[Rows | slice], Mask]


class PlaceSearch:
    """Keeps the codes of a store's descriptors, and finds the best rows by them.

    A store with a path gets two files beside it, `.codes` and, of many places, `.faiss`. Both are made anew when they
    are missing or do not fit.

    Args:
        store: has the keyframes; every one that is added to it has to be added here.
        dimension: numbers per descriptor.
    """

    def __init__(self, store: KeyframeStore, dimension: int) -> None:
        self._store = store
        self._table = CodeTable(dimension)
        self._exact = DescriptorIndex(self._table, store.descriptors)
        self._builder = Builder()
        self._approximate: ApproximateIndex | None = None
        self._file = self._many_path = None
        if store.path is not None:
            self._file = CodeFile(store.path.with_name(store.path.name + ".codes"), dimension)
            self._many_path = store.path.with_name(store.path.name + ".faiss")
        self._saved_many = 0
        self._open()

    def __call__(self, descriptor: Scores, wanted: int, admissible: Admissible) -> Found:
        """The best rows with their cosine similarity, best first.

        Args:
            descriptor: (D,) float32 unit vector.
            wanted: how many at most.
            admissible: says of rows which may be returned.
        """
        if self._approximate is not None:
            tail = np.arange(len(self._approximate), len(self._table))
            for wider in WIDER:
                rows = np.concatenate([self._approximate.search(descriptor, wider), tail])
                rows = rows[admissible(rows)]
                if len(rows) >= wanted:
                    return self._exact.best_of(descriptor, rows, wanted)
        return self.exhaustive(descriptor, wanted, admissible)

    def exhaustive(self, descriptor: Scores, wanted: int, admissible: Admissible) -> Found:
        """The same, exactly, however long it takes."""
        return self._exact.search(descriptor, wanted, admissible(slice(None)))

    def __len__(self) -> int:
        return len(self._table)

    @property
    def is_exact(self) -> bool:
        """Whether every place is looked at."""
        return self._approximate is None

    def add(self, descriptor: Scores) -> None:
        """Take up the descriptor of the keyframe that was added last."""
        self._table.extend(descriptor[None])
        if len(self._table) % ADDED_EVERY == 0:
            self._look_after_many()
        if len(self._table) % SAVED_EVERY == 0:
            self._save()

    def prepare(self) -> None:
        """Wait until the approximate index is made, where there are places enough."""
        self._look_after_many()
        self._builder.wait()
        self._look_after_many()

    def close(self) -> None:
        """Write what the next opening needs."""
        self._save(last=True)

    def _open(self) -> None:
        known = self._file.load(self._table, self._store.keys, self._store.descriptors) if self._file else 0
        if known and self._many_path is not None:
            self._approximate = ApproximateIndex.load(self._many_path, self._table)
            self._saved_many = len(self._approximate or ())
        for first in range(known, len(self._store), SAVED_EVERY):
            rows = np.arange(first, min(first + SAVED_EVERY, len(self._store)))
            self._table.extend(self._store.descriptors(rows))
        self._look_after_many()

    def _look_after_many(self) -> None:
        """Take up what is new; make the approximate index when there are places enough."""
        count = len(self._table)
        made = self._builder.take()
        if made is not None:
            self._approximate, self._saved_many = made, 0
        if self._approximate is not None:
            self._approximate.extend(self._table, count)
        elif count > APPROXIMATE_FROM and has_faiss():
            self._builder.start(self._table)

    def _save(self, last: bool = False) -> None:
        if self._file is None or self._store.read_only or not len(self._table):
            return
        self._file.save(self._table, self._store.keys)
        many = self._approximate
        # a tenth of it is soon taken up again
        if many is None or len(many) < (1.0 if last else 1.1) * self._saved_many + 1:
            return
        if self._many_path is not None and self._file.whole:
            try:
                many.save(self._many_path)
            except OutputError as error:
                logger.warning("%s; it is made anew at the next opening", error)
            self._saved_many = len(many)
