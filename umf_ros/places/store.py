"""Durable storage of keyframes in SQLite, each as safetensors without loss, and the sessions of a stored database."""

from __future__ import annotations

import json
import sqlite3
import threading
from collections import OrderedDict
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any, NamedTuple
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Embedding, Keyframe, LocalFeatures, ScanMotion, StereoCamera
from umf_ros.core.io import Schema, SqliteFile
from umf_ros.core.limits import LARGEST_TEXT, check_size
from umf_ros.places.words import WORDS, Code, Words

SCHEMA = Schema(
    "place database",
    migrations=(
        (
            "CREATE TABLE about (content TEXT NOT NULL)",
            # the blob comes last, so that the columns before it are read without it
            "CREATE TABLE keyframe (id INTEGER PRIMARY KEY, stamp_ns INTEGER NOT NULL, session INTEGER NOT NULL, "
            "travelled_m REAL, descriptor BLOB NOT NULL, data BLOB NOT NULL)",
        ),
        # covers the keys of all keyframes on a hundredth of the pages
        ("CREATE INDEX IF NOT EXISTS keyframe_by_stamp ON keyframe (stamp_ns, session, travelled_m)",),
        ("CREATE TABLE submap (id INTEGER PRIMARY KEY, keypoints BLOB NOT NULL)",),
        (
            "CREATE TABLE words (name TEXT NOT NULL, centres BLOB NOT NULL)",
            # a row for every keyframe with local vectors of its image; empty until there are words
            "CREATE TABLE code (id INTEGER PRIMARY KEY, code BLOB NOT NULL)",
        ),
    ),
)
OUTBOX = Schema(
    "outbox",
    migrations=(
        (
            "CREATE TABLE fleet (store TEXT NOT NULL)",
            "CREATE TABLE outbox (id INTEGER PRIMARY KEY)",
            # keyframes stored before the fleet was set up are sent too
            "INSERT INTO outbox SELECT id FROM keyframe",
            "INSERT INTO fleet VALUES (lower(hex(randomblob(16))))",
        ),
    ),
)
LARGEST_NUMBER = 2**53
MOTION = "motion"
FEATURES = ("image", "cloud")
_SHAPES = {"descriptor": (), "points": (3,), "body_T_camera": (4, 4), "body_T_lidar": (4, 4), "odom_T_body": (4, 4)}
"""Last dimensions of the geometric arrays."""
_KEYS = np.dtype([("id", np.int64), ("stamp_ns", np.int64), ("session", np.int64), ("travelled_m", np.float64)])


class KeyframeStore:
    """A table of keyframes in SQLite, in the order in which they were added, with a bounded cache.

    Local features of days of driving do not fit in memory. Every keyframe is written when it is added, so a killed
    process loses none. One process writes a file; others may read it.

    Args:
        path: the file, opened when it exists; None: a temporary file that disappears with the process.
        identity: the embedder's name and dimension; a stored file of another embedder is refused.
        cached: keyframes kept in memory.
        read_only: the file must exist and is only read; another process may write it.
        outgoing: whether every keyframe is queued for a fleet's server.

    Attributes:
        with_scene: number of keyframes with local vectors of their image.

    Raises:
        UmfError: the file is no place database, belongs to another embedder, or is in use; any method: it is damaged.
        OutputError: the file cannot be written.
    """

    def __init__(
        self, path: Path | None, identity: tuple[str, int], cached: int, read_only: bool = False, outgoing: bool = False
    ) -> None:
        self.path, self.read_only = path, read_only
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, Keyframe] = OrderedDict()
        self._cached, self._dimension, self._outgoing = cached, identity[1], outgoing
        name = str(path)
        self._file = SqliteFile(path, SCHEMA, read_only=read_only, check=lambda db: _check_identity(db, name, identity))
        try:
            with self._reading() as connection:
                if not connection.execute("SELECT 1 FROM about").fetchone():
                    with self._file.writing():
                        about = json.dumps({"embedder": identity[0], "dimension": str(identity[1])})
                        connection.execute("INSERT INTO about VALUES (?)", (about,))
                if outgoing:
                    self._file.migrate(OUTBOX)
                self._keys = _read_keys(connection)
                self.with_scene = _count_scenes(connection)
        except BaseException:
            self._file.close()
            raise
        self._count = len(self._keys)

    def __len__(self) -> int:
        return self._count

    @property
    def keys(self) -> NDArray[np.void]:
        """(N,) `id` in the file, `stamp_ns`, `session` and `travelled_m` of all keyframes; NaN m without odometry."""
        return self._keys[: self._count]

    def __getitem__(self, index: int) -> Keyframe:
        """Return the keyframe of an index."""
        row = int(self.keys["id"][index])
        with self._lock:
            if row not in self._cache:
                self._remember(row, self._read(row))
            self._cache.move_to_end(row)
            return self._cache[row]

    def descriptors(self, rows: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return (N, D) float32 descriptors of some indices, 30,000 at most, in their order."""
        ids = self.keys["id"][rows].tolist()
        statement = f"SELECT id, descriptor FROM keyframe WHERE id IN ({','.join('?' * len(ids))})"
        with self._reading() as connection:
            blobs = dict(connection.execute(statement, ids))
            found = np.frombuffer(b"".join(blobs[one] for one in ids), np.float32).reshape(-1, self._dimension)
            if not np.isfinite(found).all():
                row = ids[int(np.argmin(np.isfinite(found).all(axis=1)))]
                raise ValueError(f"the descriptor of keyframe {row} is not finite")
            return found

    def rows_at(self, stamp_ns: int) -> list[int]:
        """Return indices of the keyframes of a stamp, in order."""
        return self._rows("SELECT id FROM keyframe WHERE stamp_ns = ? ORDER BY id", stamp_ns)

    def add(self, keyframe: Keyframe, code: Code | None = None) -> int:
        """Append a keyframe, with its code by the words of the file, and return its index."""
        with self._lock:
            row = int(self.keys["id"][-1]) + 1 if len(self) else 1
            key = row, keyframe.stamp_ns, keyframe.session, keyframe.path_length_m
            descriptor = np.ascontiguousarray(keyframe.embedding.descriptor, np.float32).tobytes()
            with self._file.writing() as connection:
                connection.execute("INSERT INTO keyframe VALUES (?, ?, ?, ?, ?, ?)", (*key, descriptor, pack(keyframe)))
                if keyframe.embedding.scene is not None:
                    connection.execute("INSERT INTO code VALUES (?, ?)", (row, b"" if code is None else code.tobytes()))
                if self._outgoing:
                    connection.execute("INSERT OR IGNORE INTO outbox VALUES (?)", (row,))
            if self._count == len(self._keys):
                self._keys = np.concatenate([self._keys, np.empty(max(256, self._count // 4), _KEYS)])
            self._keys[self._count] = key
            self._count += 1
            self.with_scene += keyframe.embedding.scene is not None
            self._remember(row, keyframe)
            return self._count - 1

    def add_keypoints(self, index: int, keypoints: NDArray[np.float32]) -> None:
        """Store the keypoints (K, 130) of the submap around a keyframe, in half precision."""
        row = int(self.keys["id"][index]), keypoints.astype(np.float16).tobytes()
        with self._lock, self._file.writing() as connection:
            connection.execute("INSERT OR REPLACE INTO submap VALUES (?, ?)", row)

    def keypoints(self) -> dict[int, NDArray[np.float32]]:
        """Return the stored keypoints (K, 130) by the index of their keyframe; none of a file of an earlier release."""
        with self._reading() as connection:
            if not connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'submap'").fetchone():
                return {}
            found = dict(connection.execute("SELECT id, keypoints FROM submap"))
            rows = np.searchsorted(self.keys["id"], list(found)).tolist()
            stored = [np.frombuffer(blob, np.float16).reshape(-1, 130).astype(np.float32) for blob in found.values()]
            return dict(zip(rows, stored, strict=True))

    def words(self) -> Words | None:
        """Return the words of the file; None before they are fitted, and of a file of an earlier release."""
        with self._reading() as connection:
            if not connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'words'").fetchone():
                return None
            if (row := connection.execute("SELECT name, centres FROM words").fetchone()) is None:
                return None
            words = Words(np.frombuffer(row[1], np.float32).reshape(WORDS, -1))
            if words.name != row[0]:
                raise ValueError("its words are not those that their name states")
            return words

    def rows_with_scene(self, count: int) -> list[int]:
        """Return indices of the first keyframes with local vectors of their image."""
        return self._rows("SELECT id FROM code JOIN keyframe USING (id) ORDER BY id LIMIT ?", count)

    def freeze_words(self, words: Words) -> None:
        """Store words, and the codes of all keyframes so far, in one transaction."""
        codes = []
        for index in self.rows_with_scene(len(self)):
            code = words.describe(self[index].embedding.scene)
            codes.append((b"" if code is None else code.tobytes(), int(self.keys["id"][index])))
        with self._lock, self._file.writing() as connection:
            connection.execute("INSERT INTO words VALUES (?, ?)", (words.name, words.centres.tobytes()))
            connection.executemany("UPDATE code SET code = ? WHERE id = ?", codes)

    def codes(self, rows: NDArray[np.intp], size: int) -> tuple[NDArray[np.intp], NDArray[np.uint8]]:
        """Return which of some indices (N,) have a code of `size` bytes, as positions (K,), and the codes (K, size)."""
        ids = self.keys["id"][rows].tolist()
        statement = f"SELECT id, code FROM code WHERE id IN ({','.join('?' * len(ids))})"
        with self._reading() as connection:
            blobs = {one: blob for one, blob in connection.execute(statement, ids) if len(blob) == size}
        places = [place for place, one in enumerate(ids) if one in blobs]
        found = np.frombuffer(b"".join(blobs[ids[place]] for place in places), np.uint8)
        return np.array(places, np.intp), found.reshape(-1, size)

    @property
    def store_id(self) -> UUID:
        """Identifier of the file among all files of a rover; of a store with an outbox."""
        with self._reading() as connection:
            return UUID(connection.execute("SELECT store FROM fleet").fetchone()[0])

    def outgoing(self, count: int) -> list[int]:
        """Return indices of the first keyframes that the fleet's server does not have yet."""
        return self._rows("SELECT id FROM outbox JOIN keyframe USING (id) ORDER BY id LIMIT ?", count)

    def waiting(self) -> int:
        """Return the number of keyframes that the fleet's server does not have yet."""
        with self._reading() as connection:
            return int(connection.execute("SELECT count(*) FROM outbox JOIN keyframe USING (id)").fetchone()[0])

    def delivered(self, rows: Sequence[int]) -> None:
        """Remove keyframes that the fleet's server has from the outbox."""
        with self._lock, self._file.writing() as connection:
            connection.executemany("DELETE FROM outbox WHERE id = ?", self.keys["id"][list(rows)][:, None].tolist())

    def save(self, path: Path) -> None:
        """Write a copy to `path` while the store stays in use."""
        with self._lock if self._file.is_temporary else nullcontext():
            self._file.copy(path)

    def close(self) -> None:
        """Close the file; a temporary one is deleted."""
        with self._lock:
            self._file.close()

    def _remember(self, row: int, keyframe: Keyframe) -> None:
        self._cache[row] = keyframe
        while len(self._cache) > self._cached:
            self._cache.popitem(last=False)

    def _read(self, row: int) -> Keyframe:
        try:
            (blob,) = self._file.connection.execute("SELECT data FROM keyframe WHERE id = ?", (row,)).fetchone()
            return unpack(blob)
        except (sqlite3.Error, SafetensorError, LookupError, ValueError, TypeError, OverflowError) as error:
            raise UmfError(f"{self._file.name} is damaged at its keyframe {row}: {error}") from None

    def _rows(self, statement: str, value: int) -> list[int]:
        with self._reading() as connection:
            ids = [one for (one,) in connection.execute(statement, (value,))]
            return [int(row) for row in np.searchsorted(self.keys["id"], ids)]

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with self._lock, self._file.reading() as connection:
            yield connection


def pack(keyframe: Keyframe) -> bytes:
    """Return a keyframe as one safetensors blob."""
    embedding = keyframe.embedding
    arrays: dict[str, Any] = {
        "stamp_session": np.array([keyframe.stamp_ns, keyframe.session], np.int64),
        "camera": np.array(astuple(keyframe.camera), np.float64),
        "body_T_camera": keyframe.body_T_camera,
        "body_T_lidar": keyframe.body_T_lidar,
        "points": keyframe.points,
        "travelled_m": np.array([keyframe.path_length_m]),
        "descriptor": embedding.descriptor,
    }
    if embedding.scene is not None:
        arrays["scene"] = embedding.scene
    if keyframe.odom_T_body is not None:
        arrays["odom_T_body"] = keyframe.odom_T_body
    groups = {group: getattr(embedding, group) for group in FEATURES} | {MOTION: keyframe.motion}
    for group, found in groups.items():
        if found is not None:
            # scans are of submaps alone
            arrays |= {f"{group}.{i.name}": getattr(found, i.name) for i in fields(found) if i.name != "scans"}
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()})


def unpack(blob: bytes) -> Keyframe:
    """Return the keyframe in a blob of `pack`.

    Raises:
        SafetensorError, ValueError, LookupError, TypeError: the bytes are no such blob.
    """
    check_size(int.from_bytes(blob[:8], "little"), "its header", LARGEST_TEXT)
    arrays = load(blob)
    for name, shape in _SHAPES.items():
        found = arrays.get(name)
        if found is not None and (found.shape[found.ndim - len(shape) :] != shape or not np.isfinite(found).all()):
            raise ValueError(f"{name} has a wrong shape or is not finite")
    stamp_ns, session = (int(number) for number in arrays["stamp_session"])
    width, height, *rest = (float(number) for number in arrays["camera"])
    features = {group: _group(arrays, group, LocalFeatures) for group in FEATURES}
    return Keyframe(
        stamp_ns=stamp_ns,
        embedding=Embedding(arrays["descriptor"], **features, scene=arrays.get("scene")),
        camera=StereoCamera(int(width), int(height), *rest),
        body_T_camera=arrays["body_T_camera"],
        body_T_lidar=arrays["body_T_lidar"],
        points=arrays["points"],
        odom_T_body=arrays.get("odom_T_body"),
        path_length_m=float(arrays["travelled_m"][0]),
        session=session,
        motion=_group(arrays, MOTION, ScanMotion),
    )


def _group(arrays: dict[str, Any], group: str, kind: Any) -> Any:
    names = [item.name for item in fields(kind)]
    if f"{group}.{names[0]}" not in arrays:
        return None
    # an older file has no fields with a default
    return kind(**{name: arrays[f"{group}.{name}"] for name in names if f"{group}.{name}" in arrays})


class StoredSession(NamedTuple):
    """A session of a place database: its number, number of keyframes, first and last stamp in ns."""

    number: int
    keyframes: int
    first_ns: int
    last_ns: int


def stored_sessions(path: Path) -> list[StoredSession]:
    """Return the sessions of a place database; another process may write it."""
    columns = "SELECT session, count(*), min(stamp_ns), max(stamp_ns) FROM keyframe GROUP BY session"
    with _open_read_only(path) as connection:
        _check_keys(connection)
        return [StoredSession(*row) for row in connection.execute(columns)]


def stored_identity(path: Path) -> tuple[str, int]:
    """Return the embedder and numbers per descriptor of a place database; another process may write it."""
    with _open_read_only(path) as connection:
        return _identity(connection)


def check_sessions(path: Path, numbers: Collection[int]) -> None:
    """Raise an `UmfError` if a place database lacks one of these sessions."""
    unknown = set(numbers) - {session.number for session in stored_sessions(path)}
    if unknown:
        raise UmfError(f"{path} has no session {', '.join(map(str, sorted(unknown)))}")


def delete_sessions(path: Path, numbers: Collection[int]) -> int:
    """Delete whole sessions for good and return the number of their keyframes."""
    check_sessions(path, numbers)
    with closing(SqliteFile(path, SCHEMA)) as file, file.writing() as connection:
        index_path(path).unlink(missing_ok=True)
        statement = "DELETE FROM keyframe WHERE session = ?"
        deleted = sum(connection.execute(statement, (number,)).rowcount for number in set(numbers))
        for table in ("submap", "code"):  # ids are used again
            connection.execute(f"DELETE FROM {table} WHERE id NOT IN (SELECT id FROM keyframe)")
        return deleted


def index_path(path: Path) -> Path:
    """Return the file beside a place database that its index is kept in."""
    return path.with_name(path.name + ".faiss")


@contextmanager
def _open_read_only(path: Path) -> Iterator[sqlite3.Connection]:
    with closing(SqliteFile(path, SCHEMA, read_only=True)) as file, file.reading() as connection:
        yield connection


def _identity(connection: sqlite3.Connection) -> tuple[str, int]:
    """Return the embedder and dimension of a file; raise a `ValueError` if they cannot be read."""
    stored = json.loads(connection.execute("SELECT content FROM about").fetchone()[0])
    if not isinstance(stored["embedder"], str):
        raise ValueError("its embedder cannot be read")
    return stored["embedder"], int(stored["dimension"])


def _check_identity(connection: sqlite3.Connection, name: str, identity: tuple[str, int]) -> None:
    """Raise an `UmfError` if the file `name` has another embedder."""
    if not connection.execute("SELECT 1 FROM about").fetchone():  # its process was killed before it wrote them
        return
    both = zip(("embedder", "dimension"), _identity(connection), identity, strict=True)
    wrong = [f"{key} {stored}, not {value}" for key, stored, value in both if stored != value]
    if wrong:
        raise UmfError(f"{name} was made with {'; '.join(wrong)}")


def _check_keys(connection: sqlite3.Connection) -> None:
    """Raise a `ValueError` if a key is not a number: SQLite keeps values of any type in any column."""
    wrong = "typeof(stamp_ns) != 'integer' OR typeof(session) != 'integer' OR typeof(travelled_m) IN ('text', 'blob')"
    if found := connection.execute(f"SELECT id FROM keyframe WHERE {wrong} LIMIT 1").fetchone():
        raise ValueError(f"the stamp, session or path length of keyframe {found[0]} is not a number")


def _count_scenes(connection: sqlite3.Connection) -> int:
    """Return the number of keyframes with local vectors of their image; none of a file of an earlier release."""
    if not connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'code'").fetchone():
        return 0
    return int(connection.execute("SELECT count(*) FROM code").fetchone()[0])


def _read_keys(connection: sqlite3.Connection) -> NDArray[np.void]:
    _check_keys(connection)
    # SQLite keeps a NaN as NULL; 9e999 is infinity
    columns = "SELECT id, stamp_ns, session, ifnull(travelled_m, 9e999) FROM keyframe"
    keys = np.fromiter(connection.execute(columns), _KEYS)
    keys = keys[np.argsort(keys["id"])]
    for name in ("id", "session"):  # the next one must fit too
        if keys[name].min(initial=0) < 0 or keys[name].max(initial=0) > LARGEST_NUMBER:
            raise ValueError(f"a keyframe's {name} is out of range")
    keys["travelled_m"][np.isinf(keys["travelled_m"])] = np.nan
    return keys
