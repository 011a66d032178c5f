"""What a person may do to a store of places that no process uses: look at its sessions, and delete some."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from umf_ros.core.errors import UmfError
from umf_ros.core.locks import FileLock
from umf_ros.core.sqlite_files import looked_at
from umf_ros.places.schema import KIND, read_identity


@dataclass(frozen=True, slots=True)
class StoredSession:
    """One session of a store.

    Attributes:
        number: of the session.
        keyframes: how many it has.
        first_ns, last_ns: their first and last stamp.
    """

    number: int
    keyframes: int
    first_ns: int
    last_ns: int


def stored_sessions(path: Path) -> list[StoredSession]:
    """The sessions of a store, also of one in use.

    Raises:
        UmfError: the file is missing or no place database.
    """
    with looked_at(path, KIND) as connection:
        columns = "SELECT session, count(*), min(stamp_ns), max(stamp_ns) FROM keyframe GROUP BY session"
        return [StoredSession(*row) for row in connection.execute(columns)]


def stored_identity(path: Path) -> tuple[str, int]:
    """Embedder and numbers per descriptor of a store, also of one in use.

    Raises:
        UmfError: the file is missing or no place database.
    """
    with looked_at(path, KIND) as connection:
        stored = read_identity(connection)
    try:
        return stored["embedder"], int(stored["dimension"])
    except (KeyError, ValueError):
        raise UmfError(f"{path} does not say which network it was made with") from None


def check_sessions(path: Path, numbers: Collection[int]) -> None:
    """See that a store has these sessions.

    Raises:
        UmfError: the file is no place database, or lacks one of them.
    """
    unknown = set(numbers) - {session.number for session in stored_sessions(path)}
    if unknown:
        raise UmfError(f"{path} has no session {', '.join(map(str, sorted(unknown)))}")


def delete_sessions(path: Path, numbers: Collection[int]) -> int:
    """Delete whole sessions for good; returns how many keyframes that were.

    Raises:
        UmfError: the file is no place database, is in use, or lacks one of the sessions.
    """
    check_sessions(path, numbers)
    lock = FileLock(path)
    try:
        with looked_at(path, KIND) as connection, connection:
            statement = "DELETE FROM keyframe WHERE session = ?"
            return sum(connection.execute(statement, (number,)).rowcount for number in set(numbers))
    finally:
        lock.release()
