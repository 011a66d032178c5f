"""Place database: all keyframes on disk, and a FAISS index of half-precision descriptors in memory."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Database, Loop
from umf_ros.core.errors import OutputError, UmfError, one_line
from umf_ros.core.frames import Candidate, Keyframe, Points, combine
from umf_ros.core.geometry import Array, evenly
from umf_ros.core.io import atomic_write
from umf_ros.core.limits import read_json
from umf_ros.places.store import KeyframeStore, index_path
from umf_ros.places.words import FITTED_ON, Code, fit_words, worth

logger = logging.getLogger(__name__)

SAME_KEYFRAME = 0.98
"""Least similarity of two keyframes of one stamp that count as one measurement (*by hand*: runtimes of the
network differ by less than 0.001; clocks that begin at 0 give the same stamps to different scans)."""
VISITS = 4
"""Most sessions in which one place is returned (*by hand*): as many as get a metric pose."""
WIDER = 10
"""Multiple of the requested candidates that is searched for diverse ones (*by hand*)."""
MARGIN = 24
"""Rows found in half precision beyond the requested ones: full precision orders them (*by hand*)."""
BATCH = 8192
"""Descriptors read from the store at once; as many new ones cause a new file of the index."""
SPOT_CHECKS = 64
"""Descriptors of the index that are compared with the store's when its file is opened."""
PLACES_OF_MAP = "places.sqlite"
"""Name of the place database in the folder of a map."""
EXACT_UP_TO = 50_000
"""Largest number of places that is searched exhaustively (*measured*: 4 ms with 768 numbers each)."""
SHORTLIST = 3000
"""Descriptors whose half-precision products decide in a larger database (*measured*, as above: recall)."""
DIRECTIONS = 96
"""Principal components of the compressed codes, of four bits each (*measured*, as above: recall)."""
SAMPLE = 16_384
"""Descriptors that the compressed codes are trained with (*by hand*)."""
SAME_NUMBER = 1e-3
"""Upper bound of the half-precision error of a component of a unit vector."""

Rows = NDArray[np.intp]
Mask = NDArray[np.bool_]
Admissible = Callable[[Rows | slice], Mask]
"""Mask of the rows that may be returned, among some rows or a slice of all."""


def is_past(age_ns: NDArray[np.int64], path_m: Array, rules: Loop, same_session: Mask | bool = True) -> Mask:
    """Return whether earlier keyframes are old enough and far enough back to be a revisited place.

    Args:
        age_ns: (...) age relative to the query, ns.
        path_m: (...) metres driven since; where it is unknown (NaN), age alone decides.
        rules: least age and path length.
        same_session: (...) path lengths are compared within a session only.
    """
    old = age_ns >= round(rules.min_time_gap_s * 1e9)
    near = path_m < rules.min_travel_m  # False for NaN
    return np.asarray(old & ~(near & same_session), bool)


class PlaceDatabase:
    """Keyframes of all sessions by index, and the search among their descriptors.

    Keyframes are only added. The index of a large file is kept beside it, `<path>.faiss`, and rebuilt without a match.

    Args:
        settings: where to keep the keyframes.
        embedder: name of the embedder; a stored database of another one is refused.
        dimension: numbers per descriptor.
        read_only: only read the file; another process may write it.

    Attributes:
        listed: sessions that the map of these places lists; None where they are of no map.
        words: fitted to the first keyframes of the database and kept from then on; None before.

    Raises:
        UmfError: the file is no place database, belongs to another embedder, or is in use.
    """

    def __init__(self, settings: Database, embedder: str, dimension: int, read_only: bool = False) -> None:
        path = Path(settings.path) if settings.path else None
        outgoing = settings.backend == "postgres" and not read_only
        self.store = KeyframeStore(path, (embedder, dimension), settings.cached_keyframes, read_only, outgoing)
        self._index_path = index_path(path) if path is not None else None
        self.listed: range | None = None
        self._begun: dict[int, int] = {}  # of sessions: closures name stamps, and later clocks may begin again there
        try:
            self.index = self._open_index(dimension)
            self.words = self.store.words()
            self._learn_words()  # a process may have been killed between its last keyframe and the words
        except BaseException:
            self.store.close()
            raise

    @classmethod
    def of_map(cls, folder: Path, embedder: str, dimension: int) -> PlaceDatabase:
        """Open the places of a map for reading; those of sessions that it does not list are of an unfinished addition.

        Raises:
            UmfError: there is no map, or it was made with another embedder.
        """
        path = folder / PLACES_OF_MAP
        if not path.is_file():
            raise UmfError(f"{folder} is not a map: {PLACES_OF_MAP} is missing; make one with umf map")
        places = cls(Database(path=str(path)), embedder, dimension, read_only=True)
        try:
            sessions = read_json(folder / "map.json")["sessions"]
            places.listed = range(max((one["first_number"] + one["numbers"] for one in sessions), default=0))
        except (OSError, ValueError, LookupError, TypeError):
            places.close()
            raise UmfError(f"{folder / 'map.json'} is missing or damaged") from None
        return places

    def __len__(self) -> int:
        return len(self.store)

    def __getitem__(self, index: int) -> Keyframe:
        return self.store[index]

    def find_duplicate(self, keyframe: Keyframe) -> int | None:
        """Return the index of the same measurement, stored in an earlier replay of the recording; None without one.

        The scan alone tells it, too: when a recording is played, the image of a scan may be lost once and not again.
        """
        if not (rows := self.store.rows_at(keyframe.stamp_ns)):
            return None
        similarity = self.store.descriptors(np.array(rows)) @ keyframe.embedding.descriptor
        best = int(similarity.argmax())
        if similarity[best] >= SAME_KEYFRAME:
            return rows[best]
        has_scan = len(keyframe.points) > 0
        return next((row for row in rows if has_scan and np.array_equal(self[row].points, keyframe.points)), None)

    @property
    def next_session(self) -> int:
        """Number of a new session."""
        return int(self.store.keys["session"].max(initial=-1)) + 1

    def add(self, keyframe: Keyframe) -> int:
        """Store a keyframe and return its index."""
        row = self.store.add(keyframe, self._describe(keyframe))
        self._begun.setdefault(keyframe.session, keyframe.stamp_ns)
        self.index.add(keyframe.embedding.descriptor[None])
        self.index.compress()
        if len(self.index) - self._saved >= max(BATCH, self._saved // 4):
            self._save_index()
        self._learn_words()
        return row

    def query(self, keyframe: Keyframe, rules: Loop, sessions: range | None = None) -> list[Candidate]:
        """Return the most similar earlier places, best first.

        Keyframes must lie far enough back, by `is_past`. A place of many sessions does not displace the others.
        A keyframe of one sensor is compared by the words, too (*measured*: of keyframes with image and scan, they add
        nothing to the descriptor).

        Args:
            keyframe: the query.
            rules: the places that may be candidates.
            sessions: search the places of these sessions, of any age.
        """
        admissible, descriptor = partial(self.admissible, keyframe, rules, sessions), keyframe.embedding.descriptor
        for wanted in (2 * rules.top_k, WIDER * rules.top_k):
            rows = np.sort(self.index.search(descriptor, wanted + MARGIN, admissible))
            similarity, words = self.store.descriptors(rows) @ descriptor, self._compare_words(keyframe, rows)
            order = np.argsort(-combine(similarity, words), kind="stable")[:wanted]  # equal ones by row
            order = order[similarity[order] >= rules.min_similarity]
            similar = [(int(rows[i]), float(similarity[i])) for i in order]
            alike = dict(zip(rows.tolist(), words.tolist(), strict=True))
            chosen = self._diverse(similar, rules.top_k)
            if len(chosen) == rules.top_k or len(similar) < wanted:
                break
        stamps = self.store.keys["stamp_ns"]
        return [Candidate(row, int(stamps[row]), similarity, words=alike[row]) for row, similarity in chosen]

    def admissible(self, keyframe: Keyframe, rules: Loop, sessions: range | None, rows: Rows | slice) -> Mask:
        """Return which of some rows may be candidates of a keyframe, as in `query`."""
        keys = self.store.keys[rows]
        if sessions is not None:
            return np.asarray((keys["session"] >= sessions.start) & (keys["session"] < sessions.stop))
        age_ns, path_m = keyframe.stamp_ns - keys["stamp_ns"], keyframe.path_length_m - keys["travelled_m"]
        own = keys["session"] == keyframe.session
        named = own | (keys["stamp_ns"] < self._begun.get(keyframe.session, keyframe.stamp_ns))
        return is_past(age_ns, path_m, rules, own) & named

    def close(self) -> None:
        """Close the files."""
        if len(self.index) - self._saved >= BATCH:
            self._save_index()
        self.store.close()

    def _learn_words(self) -> None:
        """Fit words, once there are enough local vectors, and describe all places with them."""
        if self.words is not None or self.store.read_only or self.store.with_scene < FITTED_ON:
            return
        words = fit_words([self[row].embedding.scene for row in self.store.rows_with_scene(FITTED_ON)])
        self.store.freeze_words(words)
        self.words = words

    def _describe(self, keyframe: Keyframe) -> Code | None:
        return None if self.words is None else self.words.describe(keyframe.embedding.scene)

    def _compare_words(self, keyframe: Keyframe, rows: Rows) -> Points:
        """Return similarities (R,) of places by the words; 0 without words, or for keyframes of both sensors."""
        similarity = np.zeros(len(rows), np.float32)
        if self.words is None or not len(rows) or not (share := worth(keyframe.embedding)):
            return similarity
        if (code := self._describe(keyframe)) is not None:
            known, codes = self.store.codes(rows, len(code))
            similarity[known] = share * self.words.compare(code, codes)
        return similarity

    def _open_index(self, dimension: int) -> PlaceIndex:
        """Return the index of the file, if it matches the store, completed from the store."""
        path, size = self._index_path, len(self.store)
        index = PlaceIndex.load(path, dimension) if path is not None and path.is_file() else None
        if index is None or not self._matches(index):
            if path is not None and not self.store.read_only:
                path.unlink(missing_ok=True)
            index = PlaceIndex(dimension)
        self._saved = len(index)
        for first in range(len(index), size, BATCH):
            index.add(self.store.descriptors(np.arange(first, min(first + BATCH, size))))
        index.compress()
        return index

    def _matches(self, index: PlaceIndex) -> bool:
        if not 0 < len(index) <= len(self.store):
            return False
        rows = evenly(len(index), SPOT_CHECKS)
        return bool(np.abs(index.descriptors(rows) - self.store.descriptors(rows)).max() < SAME_NUMBER)

    def _save_index(self) -> None:
        self._saved = len(self.index)
        if self._index_path is None or self.store.read_only:
            return
        try:
            self.index.save(self._index_path)
        except OutputError as error:
            logger.warning("%s; the index is rebuilt at the next start", error)

    def _diverse(self, found: list[tuple[int, float]], count: int) -> list[tuple[int, float]]:
        """Return the best `count`, with keyframes of one place from `VISITS` sessions at most.

        Two keyframes of different sessions show one place when they are more similar to each other than to the query.
        """
        sessions = self.store.keys["session"]
        if len(found) <= count or len({int(sessions[row]) for row, _ in found}) <= VISITS:
            return found[:count]
        descriptors = self.store.descriptors(np.array([row for row, _ in found]))
        similarities = descriptors @ descriptors.T
        chosen: list[int] = []
        for position, (row, similarity) in enumerate(found):
            alike = [one for one in chosen if similarities[one, position] > similarity]
            visits = {int(sessions[found[one][0]]) for one in alike}
            if len(visits) < VISITS or int(sessions[row]) in visits:
                chosen.append(position)
            if len(chosen) == count:
                break
        return [found[position] for position in chosen]


class PlaceIndex:
    """Growing index of unit descriptors in half precision, searched by inner product on one thread.

    Up to `EXACT_UP_TO` descriptors the search is exact. In a larger index compressed codes select a shortlist, whose
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

    def add(self, descriptors: Points) -> None:
        """Append (N, D) descriptors."""
        with _one_thread():
            self._index.add(np.ascontiguousarray(descriptors, np.float32))

    def compress(self) -> None:
        """Build the codes of an index that has become too large for exact search: some seconds of one core."""
        if not self.is_exact or len(self) <= EXACT_UP_TO:
            return
        size = min(DIRECTIONS, self._flat.d)
        with _one_thread() as faiss:
            sample = self.descriptors(evenly(len(self), SAMPLE))
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

    def descriptors(self, rows: Rows) -> Points:
        """Return (N, D) descriptors of some rows, in half precision."""
        return np.asarray(self._flat.reconstruct_batch(rows))

    def search(self, descriptor: Points, count: int, admissible: Admissible, exact: bool = False) -> Rows:
        """Return the rows of the `count` descriptors that are most similar to a unit vector (D,), best first.

        A large index is searched through its shortlist; exhaustively where too few of it are admissible, or if `exact`.
        """
        if not (exact or self.is_exact):
            with _one_thread():
                _, found = self._index.search(descriptor[None], min(SHORTLIST, len(self)))
            rows: Rows = found[0][found[0] >= 0]
            rows = rows[admissible(rows)]
            if len(rows) >= count:
                return rows[:count]
        _, found = self.nearest(descriptor[None], count, admissible(slice(None)))
        return np.asarray(found[0][found[0] >= 0])

    def nearest(self, descriptors: Points, count: int, admissible: Mask) -> tuple[Points, Rows]:
        """Return similarities and rows (Q, K <= count) of the admissible ones, best first; -1 where there are none."""
        with _one_thread() as faiss:
            rules = faiss.SearchParameters(sel=faiss.IDSelectorBitmap(np.packbits(admissible, bitorder="little")))
            similarities, rows = self._flat.search(descriptors, max(min(count, len(self)), 1), params=rules)
        return similarities, rows

    def save(self, path: Path) -> None:
        """Write the index to a file for `load`."""
        with atomic_write(path, RuntimeError) as part, _one_thread() as faiss:
            faiss.write_index(self._index, str(part))

    @classmethod
    def load(cls, path: Path, dimension: int) -> PlaceIndex | None:
        """Return the index in a file; None where it has none of this kind and dimension."""
        index = cls(dimension)
        with _one_thread() as faiss:
            try:
                stored = faiss.read_index(str(path))
            except Exception as error:  # damaged bytes raise any exception
                logger.warning("%s cannot be read and is rebuilt: %s", path, one_line(error))
                return None
            flat = faiss.downcast_index(stored.refine_index) if isinstance(stored, faiss.IndexRefine) else stored
            if not isinstance(flat, faiss.IndexScalarQuantizer) or flat.d != dimension:
                return None
            index._index, index._flat = stored, flat
        return index


@contextmanager
def _one_thread() -> Iterator[Any]:
    """Run FAISS on the calling thread only: waiting OpenMP threads would take cores from the network."""
    import faiss

    threads = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    try:
        yield faiss
    finally:
        faiss.omp_set_num_threads(threads)
