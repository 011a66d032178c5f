"""SQLite files of ours: opened in the same steps, safe against the end of the process."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from umf_ros.core.errors import UmfError, one_line, shortened, writing

Step = Callable[[sqlite3.Connection], None]


def open_sqlite(path: Path | None, kind: str, step: Step) -> sqlite3.Connection:
    """Open a file, or make it, for any thread of the process.

    Args:
        path: the file; None: a temporary one, which no end of the process leaves behind.
        kind: what it is to be, for error messages.
        step: looks at it, and raises a `UmfError` where it is something else; then makes what is not there.

    Raises:
        UmfError: the file is something else, or damaged.
        OutputError: the file cannot be written.
    """
    name = str(path or f"temporary {kind}")
    with writing(name, sqlite3.Error):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
        # without a name SQLite keeps a file that no folder lists
        connection = sqlite3.connect(path or "", check_same_thread=False)
    return take_up(connection, name, kind, step)


def take_up(connection: sqlite3.Connection, name: str, kind: str, step: Step) -> sqlite3.Connection:
    """A connection after its first step; where that fails it is closed, and the reason is one line.

    Raises:
        UmfError: the step's own, or the file is damaged.
    """
    try:
        _check_plain(connection)
        step(connection)
    except Exception as error:  # damaged bytes provoke anything
        connection.close()
        if isinstance(error, UmfError):
            raise
        raise UmfError(f"{name} cannot be used as a {kind}: {one_line(error)}") from None
    return connection


@contextmanager
def looked_at(path: Path, kind: str) -> Iterator[sqlite3.Connection]:
    """A file of ours for a few statements, also one that another process writes.

    Raises:
        UmfError: it is missing, something else, or damaged.
    """
    if not path.is_file():
        raise UmfError(f"there is no {kind} {shortened(path)}")
    try:
        with closing(sqlite3.connect(path)) as connection:
            _check_plain(connection)
            yield connection
    except UmfError:
        raise
    except Exception as error:  # damaged bytes provoke anything
        raise UmfError(f"{path} cannot be used as a {kind}: {one_line(error)}") from None


def _check_plain(connection: sqlite3.Connection) -> None:
    """See that there is nothing but tables and indices: a view, a trigger or a computed column runs what it likes.

    Raises:
        ValueError: there is.
    """
    connection.execute("PRAGMA trusted_schema = OFF")
    for kind, name in connection.execute("SELECT type, name FROM sqlite_master"):
        if kind not in ("table", "index"):
            raise ValueError(f"it holds a {kind}")
        columns = connection.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,)) if kind == "table" else ()
        if any(hidden for (hidden,) in columns):
            raise ValueError("it holds a table with computed columns")


def survive_crashes(connection: sqlite3.Connection) -> None:
    """Write ahead, without a sync per row: a process that is killed loses nothing."""
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")


def tables_of(connection: sqlite3.Connection) -> set[str]:
    """Names of the tables of a file."""
    return {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
