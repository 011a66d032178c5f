"""SQLite files of ours: opened in the same steps, safe against the end of the process."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

from umf_ros.errors import UmfError, writing


def open_sqlite(
    path: Path | None,
    kind: str,
    check: Callable[[sqlite3.Connection, set[str]], None],
    make: Callable[[sqlite3.Connection], None],
) -> sqlite3.Connection:
    """Open a file, or make it; for any thread of the process.

    Args:
        path: the file; None: a temporary one, which no end of the process leaves behind.
        kind: what it is to be, for error messages.
        check: looks at the tables of a file before anything is changed, and raises a `UmfError` where it is another.
        make: fills an empty file; it is there whole or not at all.

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
    try:
        tables = tables_of(connection)
        check(connection, tables)
        # WAL without a sync per row: safe against a crash of the process
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        if not tables_of(connection):
            with connection:
                connection.execute("BEGIN")
                make(connection)
    except sqlite3.Error as error:
        connection.close()
        raise UmfError(f"{name} cannot be used as a {kind}: {error}") from None
    except BaseException:
        connection.close()
        raise
    return connection


def tables_of(connection: sqlite3.Connection) -> set[str]:
    """Names of the tables of a file."""
    return {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
