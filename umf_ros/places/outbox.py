"""Which keyframes of a store still have to be told to a fleet's server."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from uuid import UUID, uuid4

_TABLES = (
    "CREATE TABLE fleet (store TEXT NOT NULL)",
    "CREATE TABLE outbox (id INTEGER PRIMARY KEY)",
    # what was stored before there was a fleet goes there too
    "INSERT INTO outbox SELECT id FROM keyframe",
)


class Outbox:
    """A list in the store itself, so that neither a cut link nor a killed process loses a keyframe.

    It enters in the transaction that stores it, and leaves when the server has it.

    Args:
        connection: of the store; the caller holds its lock at every call.

    Attributes:
        store: names the file among all those of a rover.
    """

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        with connection:
            connection.execute("BEGIN IMMEDIATE")
            if not connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'outbox'").fetchone():
                for statement in _TABLES:
                    connection.execute(statement)
                connection.execute("INSERT INTO fleet VALUES (?)", (str(uuid4()),))
            self.store = UUID(connection.execute("SELECT store FROM fleet").fetchone()[0])

    def __len__(self) -> int:
        return int(self._connection.execute("SELECT count(*) FROM outbox JOIN keyframe USING (id)").fetchone()[0])

    def put(self, keyframe_id: int) -> None:
        """Enter a keyframe; part of the caller's transaction."""
        self._connection.execute("INSERT OR IGNORE INTO outbox VALUES (?)", (keyframe_id,))

    def oldest(self, count: int) -> list[int]:
        """The first keyframes that wait, by their ids."""
        statement = "SELECT id FROM outbox JOIN keyframe USING (id) ORDER BY id LIMIT ?"
        return [one for (one,) in self._connection.execute(statement, (count,))]

    def remove(self, keyframe_ids: Sequence[int]) -> None:
        """The server has them."""
        with self._connection:
            self._connection.executemany("DELETE FROM outbox WHERE id = ?", [(one,) for one in keyframe_ids])
