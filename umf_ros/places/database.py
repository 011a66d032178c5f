"""The growing memory of places."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from umf_ros.core.config import Database, Loop
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.keyframes import is_past
from umf_ros.places.codes import Rows
from umf_ros.places.index import Mask
from umf_ros.places.search import PlaceSearch
from umf_ros.places.store import KeyframeStore

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
    """Keyframes by index: a kilobyte of each in memory to search among them, everything on disk.

    Nothing is ever deleted here: sessions end and new ones begin.

    Args:
        settings: where to keep the keyframes.
        embedder: name of the embedder; a stored database of another one is refused.
        dimension: numbers per descriptor.
        read_only: leave the file as it is, and to whoever else reads it.

    Attributes:
        store: the keyframes.
        search: finds descriptors.

    Raises:
        UmfError: the file is no place database, belongs to another embedder, or is in use.
    """

    def __init__(self, settings: Database, embedder: str, dimension: int, read_only: bool = False) -> None:
        path = Path(settings.path) if settings.path else None
        identity = {"embedder": embedder, "dimension": str(dimension)}
        outgoing = settings.backend == "postgres" and not read_only
        self.store = KeyframeStore(path, identity, settings.cached_keyframes, read_only, outgoing)
        self.search = PlaceSearch(self.store, dimension)

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
        return len(self.store)

    def __getitem__(self, index: int) -> Keyframe:
        return self.store[index]

    def index_of(self, stamp_ns: int, session: int) -> int | None:
        """Index of a keyframe by its key; None when it is not there."""
        sessions = self.store.keys["session"]
        return next((row for row in reversed(self.store.rows_at(stamp_ns)) if sessions[row] == session), None)

    def newest_at(self, stamp_ns: int) -> int | None:
        """Index of the newest keyframe of a stamp; None when there is none."""
        return next(reversed(self.store.rows_at(stamp_ns)), None)

    def find_duplicate(self, keyframe: Keyframe) -> int | None:
        """Index of the same measurement, stored before, as when a recording is played again; or None."""
        rows = self.store.rows_at(keyframe.stamp_ns)
        if not rows:
            return None
        similarity = self.store.descriptors(np.array(rows)) @ keyframe.embedding.descriptor
        best = int(similarity.argmax())
        return rows[best] if similarity[best] >= SAME_KEYFRAME else None

    @property
    def next_session(self) -> int:
        """A session number no stored keyframe has."""
        return int(self.store.keys["session"].max(initial=-1)) + 1

    def add(self, keyframe: Keyframe) -> int:
        """Remember a keyframe and return its index."""
        row = self.store.add(keyframe)
        self.search.add(keyframe.embedding.descriptor)
        return row

    def query(self, keyframe: Keyframe, rules: Loop, sessions: range | None = None) -> list[Candidate]:
        """The most similar earlier places, best first.

        Keyframes must be older than `min_time_gap_s`, and those of the same session further back along
        the path than `min_travel_m`; where either path length is unknown, time alone decides. A place that was
        visited in many sessions does not crowd out the others.

        Args:
            keyframe: what is looked for.
            rules: which places may be candidates.
            sessions: look among the places of these sessions, whatever their age.
        """
        descriptor, stamps = keyframe.embedding.descriptor, self.store.keys["stamp_ns"]

        def admissible(rows: Rows | slice) -> Mask:
            return self._admissible(keyframe, rules, rows) if sessions is None else self._of_sessions(sessions, rows)

        for wanted in (2 * rules.top_k, WIDER * rules.top_k):
            found = self.search(descriptor, wanted, admissible)
            similar = [(row, similarity) for row, similarity in found if similarity >= rules.min_similarity]
            chosen = self._diverse(similar, rules.top_k)
            if len(chosen) == rules.top_k or len(similar) < wanted:
                break
        return [Candidate(row, int(stamps[row]), similarity) for row, similarity in chosen]

    def save(self, path: Path) -> None:
        """Write a copy of the database to `path`."""
        self.store.save(path)

    def close(self) -> None:
        """Release the file."""
        self.search.close()
        self.store.close()

    def _diverse(self, found: list[tuple[int, float]], count: int) -> list[tuple[int, float]]:
        """The best `count`, but of one place those of `VISITS` sessions only.

        Two keyframes of different sessions show one place when they are more like each other than like the query.
        """
        sessions = self.store.keys["session"]
        if len(found) <= count or len({int(sessions[row]) for row, _ in found}) <= VISITS:
            return found[:count]
        descriptors = self.store.descriptors(np.array([row for row, _ in found]))
        likeness = descriptors @ descriptors.T
        chosen: list[int] = []
        for position, (row, similarity) in enumerate(found):
            alike = [one for one in chosen if likeness[one, position] > similarity]
            visits = {int(sessions[found[one][0]]) for one in alike}
            if len(visits) < VISITS or int(sessions[row]) in visits:
                chosen.append(position)
            if len(chosen) == count:
                break
        return [found[position] for position in chosen]

    def _admissible(self, keyframe: Keyframe, rules: Loop, rows: Rows | slice) -> Mask:
        keys = self.store.keys
        age_ns = keyframe.stamp_ns - keys["stamp_ns"][rows]
        way_m = keyframe.path_length_m - keys["travelled_m"][rows]
        return is_past(age_ns, way_m, rules, keys["session"][rows] == keyframe.session)

    def _of_sessions(self, sessions: range, rows: Rows | slice) -> Mask:
        numbers = self.store.keys["session"][rows]
        return np.asarray((numbers >= sessions.start) & (numbers < sessions.stop))
