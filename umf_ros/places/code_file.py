"""The codes of a store's descriptors beside it, so that a million places are there again in seconds."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from umf_ros.core.errors import OutputError, writing
from umf_ros.places.codes import CodeTable, Records
from umf_ros.places.index import Fetch
from umf_ros.places.store import Keys

logger = logging.getLogger(__name__)

CHECKED = 64
"""So many descriptors are compared with those of the store."""
BATCH = 8192


class CodeFile:
    """One record per keyframe: its key, and the code of its descriptor. The store is the truth: what disagrees goes.

    Args:
        path: the file; need not exist.
        dimension: numbers per descriptor.
    """

    def __init__(self, path: Path, dimension: int) -> None:
        self._path = path
        self._record = np.dtype(
            [("id", "<i8"), ("stamp", "<i8"), ("scale", "<f4"), ("error", "<f4"), ("code", "i1", (dimension,))]
        )
        self._saved = 0
        self._broken = False

    @property
    def whole(self) -> bool:
        """Whether all that was to be saved is."""
        return not self._broken

    def load(self, table: CodeTable, keys: Keys, fetch: Fetch) -> int:
        """Fill an empty table with what the file knows of the first rows of a store; returns how many that are.

        Args:
            table: to fill.
            keys: of the store.
            fetch: gives the store's descriptors.
        """
        size = self._path.stat().st_size if self._path.is_file() else 0
        count = size // self._record.itemsize
        if not count:
            return 0
        records = np.memmap(self._path, self._record, "r", shape=(count,))
        if count > len(keys) or not self._agrees(records, keys, fetch):
            logger.warning("%s does not belong to the places as they are now; it is made anew", self._path)
            return 0
        table.load(records)
        self._saved = count
        return count

    def save(self, table: CodeTable, keys: Keys) -> None:
        """Append what is new; a disk that is full costs time at the next opening, and nothing else."""
        try:
            with writing(self._path), self._path.open("ab" if self._saved else "wb") as file:
                file.truncate(self._saved * self._record.itemsize)
                for first in range(self._saved, len(keys), BATCH):
                    last = min(first + BATCH, len(keys))
                    records = np.empty(last - first, self._record)
                    records["id"], records["stamp"] = keys["id"][first:last], keys["stamp_ns"][first:last]
                    for name, column in table.records(first, last).items():
                        records[name] = column
                    file.write(records.tobytes())
                    self._saved = last
        except OutputError as error:
            if not self._broken:
                logger.warning("%s; the next opening takes longer", error)
            self._broken = True

    def _agrees(self, records: Records, keys: Keys, fetch: Fetch) -> bool:
        count = len(records)
        same = all(
            np.array_equal(records[column][first : first + BATCH], keys[name][:count][first : first + BATCH])
            for column, name in (("id", "id"), ("stamp", "stamp_ns"))
            for first in range(0, count, BATCH)
        )
        if not same:
            return False
        rows = np.unique(np.linspace(0, count - 1, CHECKED).astype(np.intp))
        true = CodeTable(self._record["code"].shape[0])
        true.extend(fetch(rows))
        return np.array_equal(true.records(0, len(rows))["code"], records["code"][rows])
