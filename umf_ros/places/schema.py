"""The tables of a file of places: made, recognised, or refused."""

from __future__ import annotations

import json
import sqlite3
from typing import Any

from umf_ros.core.errors import UmfError
from umf_ros.core.sqlite_files import survive_crashes, tables_of

KIND = "place database"
SCHEMA_VERSION = 3
_TABLES = (
    "CREATE TABLE about (content TEXT NOT NULL)",
    # the blob comes last: whoever wants the columns before it does not read it
    "CREATE TABLE keyframe (id INTEGER PRIMARY KEY, stamp_ns INTEGER NOT NULL, session INTEGER NOT NULL, "
    "travelled_m REAL, descriptor BLOB NOT NULL, data BLOB NOT NULL)",
)
_ADDED = (
    # holds all that is wanted of every keyframe at once, on a hundredth of the pages
    "CREATE INDEX IF NOT EXISTS keyframe_by_stamp ON keyframe (stamp_ns, session, travelled_m)",
)
"""What later versions have added, in order; a file of an older one gets it when it is opened."""


def read_identity(connection: sqlite3.Connection) -> dict[str, Any]:
    """What a file says of itself: `schema`, `embedder` and `dimension`, as text.

    Raises:
        ValueError: it says nothing that can be read.
    """
    about = connection.execute("SELECT content FROM about").fetchone()
    stored = json.loads(about[0]) if about else {}
    if not isinstance(stored, dict) or not all(isinstance(value, str) for value in stored.values()):
        raise ValueError("it does not say what it is")
    return stored


def check_identity(connection: sqlite3.Connection, name: str, identity: dict[str, str]) -> None:
    """Look, and change nothing.

    Raises:
        UmfError: the file `name` holds something else, or places of another network or version.
    """
    tables = tables_of(connection)
    if not tables:
        return
    if not {"about", "keyframe"} <= tables:
        raise UmfError(f"{name} is no place database, but another one with {', '.join(sorted(tables))}")
    stored = read_identity(connection)
    if stored.get("schema") != str(SCHEMA_VERSION):
        raise UmfError(f"{name} was written by another version of umf_ros; name a new file (database.path)")
    wrong = [f"{key} {stored.get(key)}, not {value}" for key, value in identity.items() if stored.get(key) != value]
    if wrong:
        raise UmfError(f"{name} was made with {'; '.join(wrong)}")


def prepare(connection: sqlite3.Connection, identity: dict[str, str]) -> None:
    """Make an empty file a place database, and an older one as good as new; the caller holds its lock."""
    survive_crashes(connection)
    with connection:
        connection.execute("BEGIN IMMEDIATE")
        if not tables_of(connection):
            for table in _TABLES:
                connection.execute(table)
            content = json.dumps({"schema": str(SCHEMA_VERSION), **identity})
            connection.execute("INSERT INTO about VALUES (?)", (content,))
        for addition in _ADDED:
            connection.execute(addition)
