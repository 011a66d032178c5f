"""The growing memory of places."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from umf_ros.config import Database, Loop
from umf_ros.errors import UmfError
from umf_ros.frames import Candidate, Keyframe
from umf_ros.keyframes import is_past
from umf_ros.places.columns import Columns
from umf_ros.places.index import DescriptorIndex, Mask
from umf_ros.places.store import KeyframeStore, PlaceEntry

SAME_KEYFRAME = 0.98
"""Two keyframes of one stamp whose descriptors are this similar are one measurement read twice (*by hand*: runtimes of
the network differ by less than 0.001; clocks that begin at 0 give the same stamps to scans of anything)."""
VISITS = 4
"""A place is handed on from at most so many sessions (*by hand*): as many as get a metric pose."""
WIDER = 10
"""So many times the candidates asked for are looked through for diverse ones (*by hand*)."""


PLACES_OF_MAP = "places.sqlite"
"""The store of places in the folder of a map."""


class PlaceDatabase:
    """Keyframes by index: descriptors in memory for exact search, everything else on disk.

    Nothing is ever deleted here: sessions end and new ones begin.

    Args:
        settings: where to keep the keyframes.
        embedder: name of the embedder; a stored database of another one is refused.
        dimension: numbers per descriptor.
        read_only: leave the file as it is, and to whoever else reads it.

    Raises:
        UmfError: the file is no place database, belongs to another embedder, or is in use.
    """

    def __init__(self, settings: Database, embedder: str, dimension: int, read_only: bool = False) -> None:
        path = Path(settings.path) if settings.path else None
        identity = {"embedder": embedder, "dimension": str(dimension)}
        self._store = KeyframeStore(path, identity, settings.cached_keyframes, read_only)
        self._index = DescriptorIndex(dimension)
        self._columns = Columns(stamp=np.int64, session=np.int64, travelled=np.float64)
        self._by_stamp: dict[int, tuple[int, ...]] = {}
        for entry in self._store.entries():
            self._register(entry)

    @classmethod
    def of_map(cls, folder: Path, embedder: str, dimension: int) -> PlaceDatabase:
        """The places of a map, to be read only.

        Raises:
            UmfError: there is no map, or it was made with another embedder.
        """
        path = folder / PLACES_OF_MAP
        if not path.is_file():
            raise UmfError(f"{folder} holds no map: {PLACES_OF_MAP} is missing (umf map makes one)")
        return cls(Database(path=str(path)), embedder, dimension, read_only=True)

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, index: int) -> Keyframe:
        return self._store[index]

    def index_of(self, stamp_ns: int, session: int) -> int | None:
        """Index of a keyframe by its key; None when it is not there."""
        rows = self._by_stamp.get(stamp_ns, ())
        return next((row for row in reversed(rows) if self._columns["session"][row] == session), None)

    def newest_at(self, stamp_ns: int) -> int | None:
        """Index of the newest keyframe of a stamp; None when there is none."""
        return next(reversed(self._by_stamp.get(stamp_ns, ())), None)

    def recognise(self, keyframe: Keyframe) -> int | None:
        """Index of the same measurement, stored before, as when a recording is played again; or None."""
        rows = self._by_stamp.get(keyframe.stamp_ns, ())
        descriptor = keyframe.embedding.descriptor
        similarity = {row: float(self._index.descriptors[row] @ descriptor) for row in rows}
        best = max(similarity, key=lambda row: similarity[row], default=None)
        return best if best is not None and similarity[best] >= SAME_KEYFRAME else None

    @property
    def next_session(self) -> int:
        """A session number no stored keyframe has."""
        return int(self._columns["session"].max(initial=-1)) + 1

    def add(self, keyframe: Keyframe) -> int:
        """Remember a keyframe and return its index."""
        self._store.add(keyframe)
        return self._register(PlaceEntry.of(keyframe))

    def query(self, keyframe: Keyframe, rules: Loop, sessions: range | None = None) -> list[Candidate]:
        """The most similar earlier places, best first, by exhaustive search.

        Keyframes must be older than `min_time_gap_s`, and those of the same session further back along
        the path than `min_travel_m`; where either path length is unknown, time alone decides. A place that was
        visited in many sessions does not crowd out the others.

        Args:
            keyframe: what is looked for.
            rules: which places may be candidates.
            sessions: look among the places of these sessions, whatever their age.
        """
        descriptor, wanted = keyframe.embedding.descriptor, rules.top_k * WIDER
        admissible = self._admissible(keyframe, rules) if sessions is None else self._of_sessions(sessions)
        found = self._index.search(descriptor, wanted, admissible)
        similar = [(row, similarity) for row, similarity in found if similarity >= rules.min_similarity]
        stamps = self._columns["stamp"]
        chosen = self._diverse(similar, rules.top_k)
        return [Candidate(row, int(stamps[row]), similarity) for row, similarity in chosen]

    def save(self, path: Path) -> None:
        """Write a copy of the database to `path`."""
        self._store.save(path)

    def close(self) -> None:
        """Release the file."""
        self._store.close()

    def _diverse(self, found: list[tuple[int, float]], count: int) -> list[tuple[int, float]]:
        """The best `count`, but of one place those of `VISITS` sessions only.

        Two keyframes of different sessions show one place when they are more like each other than like the query.
        """
        sessions = self._columns["session"]
        if len(found) <= count or len({int(sessions[row]) for row, _ in found}) <= VISITS:
            return found[:count]
        chosen: list[tuple[int, float]] = []
        for row, similarity in found:
            rows = np.array([one for one, _ in chosen], np.intp)
            alike = self._index.descriptors[rows] @ self._index.descriptors[row] > similarity
            visits = set(sessions[rows[alike]].tolist())
            if len(visits) < VISITS or int(sessions[row]) in visits:
                chosen.append((row, similarity))
            if len(chosen) == count:
                break
        return chosen

    def _register(self, entry: PlaceEntry) -> int:
        row = self._index.add(entry.descriptor)
        self._columns.append(stamp=entry.stamp_ns, session=entry.session, travelled=entry.travelled_m)
        self._by_stamp[entry.stamp_ns] = (*self._by_stamp.get(entry.stamp_ns, ()), row)
        return row

    def _admissible(self, keyframe: Keyframe, rules: Loop) -> Mask:
        age_ns = keyframe.stamp_ns - self._columns["stamp"]
        way_m = keyframe.travelled_m - self._columns["travelled"]
        return is_past(age_ns, way_m, rules, self._columns["session"] == keyframe.session)

    def _of_sessions(self, sessions: range) -> Mask:
        numbers = self._columns["session"]
        return np.asarray((numbers >= sessions.start) & (numbers < sessions.stop))
