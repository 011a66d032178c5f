from __future__ import annotations

import sqlite3
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import make_keyframe
from typer.testing import CliRunner

from umf_ros.commands.stores import places as app
from umf_ros.core.config import Database
from umf_ros.core.errors import UmfError
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import StoredSession, delete_sessions, stored_identity, stored_sessions


def database(path: Path) -> PlaceDatabase:
    return PlaceDatabase(Database(path=str(path)), "test", 16)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    places = database(tmp_path / "map.sqlite")
    for i in range(6):
        places.add(make_keyframe(i, seed=i, session=i // 2))
    places.close()
    return tmp_path / "map.sqlite"


def test_sessions_are_counted(path: Path) -> None:
    assert stored_sessions(path)[1] == StoredSession(1, 2, 2 * 10**9, 3 * 10**9)


def test_only_the_named_sessions_are_deleted(path: Path) -> None:
    assert delete_sessions(path, [0, 2]) == 4
    places = database(path)
    assert [places[i].stamp_ns for i in range(len(places))] == [2 * 10**9, 3 * 10**9]


def test_nothing_is_deleted_from_a_store_in_use_or_by_a_wrong_number(path: Path) -> None:
    with pytest.raises(UmfError, match="has no session 7"):
        delete_sessions(path, [0, 7])
    places = database(path)
    with pytest.raises(UmfError, match="is in use"):
        delete_sessions(path, [0])
    assert sum(session.keyframes for session in stored_sessions(path)) == len(places) == 6


def test_the_command_asks_first(path: Path) -> None:
    run = CliRunner().invoke
    assert run(app, ["delete", str(path), "--session", "1"], input="n\n").exit_code == 1
    assert len(stored_sessions(path)) == 3
    assert "session 1: 2 keyframes, 1970-01-01 00:00:02" in run(app, ["list", str(path)]).output
    assert run(app, ["delete", str(path), "--session", "1"], input="y\n").exit_code == 0
    assert [session.number for session in stored_sessions(path)] == [0, 2]


def test_other_files_are_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("nothing of the kind")
    for name in ("text", "missing"):
        with pytest.raises(UmfError) as caught:
            stored_sessions(tmp_path / name)
        assert "\n" not in str(caught.value)


LIES = ["[]", "null", "5", "[" * 100_000, "9" * 5000, '{"schema": "3", "embedder": [1], "dimension": "16"}']


@pytest.mark.parametrize("lie", LIES, ids=lambda lie: lie[:10])
def test_a_damaged_identity_is_refused_in_one_line(path: Path, lie: str) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE about SET content = ?", (lie,))
    for use in (stored_identity, database):
        with pytest.raises(UmfError, match=r"cannot be used as a place database|is damaged") as caught:
            use(path)
        assert "\n" not in str(caught.value)


ENDLESS = "WITH RECURSIVE r(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM r) SELECT"
FOREIGN = r"its (table|index) \w+ is not that of a place database"
NO_NUMBER = "the stamp, session or path length of keyframe 2 is not a number"
DAMAGES = {
    "view": (
        ["DROP TABLE keyframe", f"CREATE VIEW keyframe AS {ENDLESS} i id, i stamp_ns, 0 session FROM r"],
        "it holds a view",
    ),
    "trigger": (
        [f"CREATE TRIGGER t AFTER INSERT ON keyframe BEGIN INSERT INTO about {ENDLESS} i FROM r; END"],
        "it holds a trigger",
    ),
    "computed": (["ALTER TABLE keyframe ADD COLUMN large AS (zeroblob(900000000))"], "it holds a table with computed"),
    "constraint": (
        [
            "ALTER TABLE keyframe RENAME TO old",
            "CREATE TABLE keyframe (id INTEGER PRIMARY KEY, stamp_ns INTEGER NOT NULL CHECK (length(zeroblob(9e8)) "
            "> 1), session INTEGER NOT NULL, travelled_m REAL, descriptor BLOB NOT NULL, data BLOB NOT NULL)",
            "INSERT INTO keyframe SELECT * FROM old",
            "DROP TABLE old",
        ],
        FOREIGN,
    ),
    "index on an expression": (["CREATE INDEX i ON keyframe (abs(stamp_ns))"], FOREIGN),
    "partial index": (["CREATE UNIQUE INDEX i ON keyframe (session) WHERE session >= 0 AND id < 2"], FOREIGN),
    "another column": (["ALTER TABLE keyframe ADD COLUMN more TEXT DEFAULT 'x'"], FOREIGN),
    "constraint of another table": (
        ["DROP TABLE submap", "CREATE TABLE submap (id INTEGER PRIMARY KEY, keypoints BLOB CHECK (0))"],
        FOREIGN,
    ),
    **{
        value: ([f"UPDATE keyframe SET {value} WHERE id = 2"], NO_NUMBER)
        for value in ("stamp_ns = 'yesterday'", "session = x'00'", "travelled_m = 'far'", "stamp_ns = 1.5")
    },
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_files_that_compute_or_differ_are_refused(path: Path, damage: str) -> None:
    statements, message = DAMAGES[damage]
    with sqlite3.connect(path) as connection:
        for statement in statements:
            connection.execute(statement)
    reads = [] if message == NO_NUMBER else [stored_identity]
    for use in (stored_sessions, partial(delete_sessions, numbers=[0]), database, *reads):
        with pytest.raises(UmfError, match=message):
            use(path)


def test_a_descriptor_that_is_not_finite_is_refused(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        (blob,) = connection.execute("SELECT descriptor FROM keyframe WHERE id = 2").fetchone()
        wrong = np.frombuffer(blob, np.float32).copy()
        wrong[3] = np.nan
        connection.execute("UPDATE keyframe SET descriptor = ? WHERE id = 2", (wrong.tobytes(),))
    with pytest.raises(UmfError, match="the descriptor of keyframe 2 is not finite"):
        database(path)
