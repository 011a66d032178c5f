"""The growing memory of places."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from umf_ros.config import Database, Loop
from umf_ros.frames import Candidate, Keyframe
from umf_ros.keyframes import is_past
from umf_ros.places.index import DescriptorIndex, Mask
from umf_ros.places.store import KeyframeStore, PlaceEntry


class PlaceDatabase:
    """Keyframes by index: descriptors in memory for exact search, everything else on disk.

    Args:
        settings: where to keep the keyframes.
        embedder: name of the embedder; a stored database of another one is refused.
        dimension: numbers per descriptor.

    Raises:
        UmfError: the file is no place database, or belongs to another embedder.
    """

    def __init__(self, settings: Database, embedder: str, dimension: int) -> None:
        path = Path(settings.path) if settings.path else None
        identity = {"embedder": embedder, "dimension": str(dimension)}
        self._store = KeyframeStore(path, identity, settings.cached_keyframes)
        self._index = DescriptorIndex(dimension)
        self._stamps: list[int] = []
        self._travelled: list[float] = []
        self._sessions: list[int] = []
        self._by_key: dict[tuple[int, int], int] = {}
        for entry in self._store.entries():
            self._register(entry)

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, index: int) -> Keyframe:
        return self._store[index]

    def index_of(self, stamp_ns: int, session: int) -> int | None:
        """Index of a keyframe by its key; None when it is not, or no longer, there."""
        return self._by_key.get((session, stamp_ns))

    @property
    def next_session(self) -> int:
        """A session number no stored keyframe has."""
        return max(self._sessions, default=-1) + 1

    def add(self, keyframe: Keyframe) -> int:
        """Remember a keyframe and return its index."""
        self._store.add(keyframe)
        return self._register(PlaceEntry.of(keyframe))

    def query(self, keyframe: Keyframe, rules: Loop) -> list[Candidate]:
        """The most similar earlier places, best first, by exhaustive search.

        Keyframes must be older than `min_time_gap_s`, and those of the same session further back along
        the path than `min_travel_m`; where either path length is unknown, time alone decides.
        """
        found = self._index.search(keyframe.embedding.descriptor, rules.top_k, self._admissible(keyframe, rules))
        return [
            Candidate(i, self._stamps[i], similarity) for i, similarity in found if similarity >= rules.min_similarity
        ]

    def forget_from(self, stamp_ns: int, first_session: int = 0) -> int:
        """Forget keyframes from `stamp_ns` on, as when a recording starts over; returns how many.

        Args:
            stamp_ns: the first that is forgotten.
            first_session: earlier sessions (of earlier runs) are kept whatever their stamps.
        """
        earlier = np.array(self._sessions, np.int64) < first_session
        keep = earlier | (np.array(self._stamps, np.int64) < stamp_ns)
        kept = np.flatnonzero(keep).tolist()
        forgotten = len(self) - len(kept)
        if forgotten:
            self._store.keep(kept)
            self._index.keep(keep)
            self._stamps = [self._stamps[i] for i in kept]
            self._travelled = [self._travelled[i] for i in kept]
            self._sessions = [self._sessions[i] for i in kept]
            self._by_key = {key: i for i, key in enumerate(zip(self._sessions, self._stamps, strict=True))}
        return forgotten

    def save(self, path: Path) -> None:
        """Write a copy of the database to `path`."""
        self._store.save(path)

    def close(self) -> None:
        """Release the file."""
        self._store.close()

    def _register(self, entry: PlaceEntry) -> int:
        self._stamps.append(entry.stamp_ns)
        self._travelled.append(entry.travelled_m)
        self._sessions.append(entry.session)
        self._by_key[entry.session, entry.stamp_ns] = len(self._index)
        return self._index.add(entry.descriptor)

    def _admissible(self, keyframe: Keyframe, rules: Loop) -> Mask:
        age_ns = keyframe.stamp_ns - np.array(self._stamps, np.int64)
        way_m = keyframe.travelled_m - np.array(self._travelled, np.float64)
        return is_past(age_ns, way_m, rules, np.array(self._sessions, np.int64) == keyframe.session)
