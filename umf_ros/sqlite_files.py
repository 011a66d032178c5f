"""SQLite files of ours: opened in the same steps, safe against the end of the process."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

from umf_ros.errors import UmfError, writing

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
        step(connection)
    except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
        connection.close()
        raise UmfError(f"{name} cannot be used as a {kind}: {error}") from None
    except BaseException:
        connection.close()
        raise
    return connection


def survive_crashes(connection: sqlite3.Connection) -> None:
    """Write ahead, without a sync per row: a process that is killed loses nothing."""
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")


def tables_of(connection: sqlite3.Connection) -> set[str]:
    """Names of the tables of a file."""
    return {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
