"""The file of a place database: found again, copied, foreign, old and damaged."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
import threading
import weakref
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from conftest import make_keyframe
from recordings import traverse, write_db3

from umf_ros.core.config import Database, Loop
from umf_ros.core.errors import OutputError, UmfError
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import KeyframeStore, delete_sessions

IDENTITY = ("test", 16)
RULES = Loop(min_similarity=-1, min_time_gap_s=20, min_travel_m=15, top_k=50)


def store(path: Path | None = None, cached: int = 20) -> KeyframeStore:
    return KeyframeStore(path, IDENTITY, cached)


def database(path: Path) -> PlaceDatabase:
    return PlaceDatabase(Database(path=str(path)), "test", 16)


def filled(path: Path, count: int = 5) -> Path:
    """A closed database of `count` keyframes, one per second and 4 m, the last one without odometry."""
    places = database(path)
    for i in range(count):
        places.add(make_keyframe(i, float("nan") if i == count - 1 else 4.0 * i, seed=i, session=i // 3))
    places.close()
    return path


def change(path: Path, statement: str, *values: object) -> None:
    connection = sqlite3.connect(path)
    with connection:
        connection.execute(statement, values)
    connection.close()


def test_keys_and_descriptors_are_those_of_the_keyframes(tmp_path: Path) -> None:
    opened = store(filled(tmp_path / "map.sqlite"))
    assert len(opened) == 5 and opened.keys["id"].tolist() == [1, 2, 3, 4, 5]
    for i in range(5):
        keyframe = opened[i]
        assert (opened.keys["stamp_ns"][i], opened.keys["session"][i]) == (keyframe.stamp_ns, keyframe.session)
        np.testing.assert_array_equal(opened.keys["travelled_m"][i], keyframe.path_length_m)
    rows = np.array([4, 0, 2])
    expected = np.stack([opened[i].embedding.descriptor for i in rows])
    np.testing.assert_array_equal(opened.descriptors(rows), expected)
    assert opened.descriptors(rows).dtype == np.float32


def test_keyframes_are_found_by_stamp_also_where_stamps_repeat() -> None:
    opened = store()
    for session in (0, 1):
        for i in range(4):
            opened.add(make_keyframe(i, seed=i, session=session))
    assert opened.rows_at(2 * 10**9) == [2, 6] and opened.rows_at(77) == []


def test_opening_does_not_read_the_keyframes_themselves(tmp_path: Path) -> None:
    path = filled(tmp_path / "map.sqlite")
    change(path, "UPDATE keyframe SET data = ?", b"no keyframe")
    places = database(path)
    assert len(places) == 5
    found = places.query(make_keyframe(100, 100, seed=3, session=1), RULES)
    assert found[0].stamp_ns == 3 * 10**9 and found[0].similarity == pytest.approx(1, abs=1e-6)


def test_a_reopened_database_answers_like_the_one_that_was_closed(tmp_path: Path) -> None:
    query = make_keyframe(24.5, 30, seed=77, session=0)
    places = database(tmp_path / "map.sqlite")
    for i in range(30):
        places.add(make_keyframe(i, 1.0 * i, seed=i, session=0))
    before = places.query(query, RULES)
    places.close()
    assert database(tmp_path / "map.sqlite").query(query, RULES) == before
    # at 24.5 s and 30 m: at least 20 s older leaves 0 to 4 s, and those lie 26 m back or more
    assert sorted(candidate.index for candidate in before) == [0, 1, 2, 3, 4]


def test_places_added_after_reopening_come_after_the_old_ones(tmp_path: Path) -> None:
    path = filled(tmp_path / "map.sqlite")
    places = database(path)
    assert places.next_session == 2
    assert places.add(make_keyframe(50, seed=50, session=places.next_session)) == 5
    places.close()
    again = database(path)
    assert [again[i].stamp_ns for i in range(6)] == [0, 10**9, 2 * 10**9, 3 * 10**9, 4 * 10**9, 50 * 10**9]
    assert again.next_session == 3


def test_keypoints_of_submaps_are_stored_until_their_keyframes_are_deleted(tmp_path: Path) -> None:
    path = filled(tmp_path / "places.sqlite")
    keypoints = np.arange(4 * 130, dtype=np.float32).reshape(4, 130)
    with closing(store(path)) as kept:
        kept.add_keypoints(2, keypoints)
        kept.add_keypoints(3, keypoints[:0])
    with closing(store(path)) as again:
        assert {row: found.tolist() for row, found in again.keypoints().items()} == {2: keypoints.tolist(), 3: []}
        numbers = again.keys["session"].tolist()
    delete_sessions(path, set(numbers))
    with closing(store(path)) as emptied:
        assert emptied.keypoints() == {}


def test_a_file_without_submaps_is_read(tmp_path: Path) -> None:
    path = filled(tmp_path / "places.sqlite")
    change(path, "DROP TABLE submap")
    with closing(KeyframeStore(path, IDENTITY, 20, read_only=True)) as old:
        assert len(old) == 5 and old.keypoints() == {}


def test_the_least_recently_used_keyframe_leaves_the_cache() -> None:
    opened = store(cached=3)
    alive: list[weakref.ref[np.ndarray]] = []
    for i in range(3):
        keyframe = make_keyframe(i, seed=i)
        alive.append(weakref.ref(keyframe.points))
        opened.add(keyframe)
    del keyframe
    assert opened[0].stamp_ns == 0  # the oldest is used again: now the second is the one to go
    opened.add(make_keyframe(9, seed=9))
    assert [reference() is not None for reference in alive] == [True, False, True]
    assert opened[1].stamp_ns == 10**9


def run(script: str, *arguments: Path, **environment: str) -> subprocess.Popen[str]:
    """A process that fills a store without end, once it has said that it began."""
    body = "from conftest import make_keyframe; from umf_ros.places.store import KeyframeStore;" + script
    process = subprocess.Popen(
        [sys.executable, "-c", body, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    return process


FILL = """
import sys
from pathlib import Path
path = Path(sys.argv[1]) if len(sys.argv) > 1 else None
store = KeyframeStore(path, ("test", 16), 20)
for i in range(10**6):
    store.add(make_keyframe(i, seed=i))
    if i == 20:
        print("begun", flush=True)
"""


def test_a_killed_process_leaves_no_temporary_file(tmp_path: Path) -> None:
    process = run(FILL, TMPDIR=str(tmp_path), SQLITE_TMPDIR=str(tmp_path))
    process.kill()
    process.wait()
    assert list(tmp_path.iterdir()) == []


def test_a_killed_process_loses_no_keyframe_and_holds_no_lock(tmp_path: Path) -> None:
    process = run(FILL, tmp_path / "map.sqlite")
    with pytest.raises(UmfError, match=rf"map\.sqlite is in use by another process \({process.pid}\)") as caught:
        database(tmp_path / "map.sqlite")
    assert "\n" not in str(caught.value)
    reader = sqlite3.connect(tmp_path / "map.sqlite")
    assert reader.execute("SELECT count(*) FROM keyframe").fetchone()[0] > 20  # readers are welcome
    reader.close()
    process.kill()
    process.wait()
    places = database(tmp_path / "map.sqlite")
    assert [places[i].stamp_ns for i in range(len(places))] == [i * 10**9 for i in range(len(places))]
    assert len(places) > 20


def test_a_file_that_was_refused_can_be_opened_later(tmp_path: Path) -> None:
    path = filled(tmp_path / "map.sqlite")
    with pytest.raises(UmfError, match="made with"):
        KeyframeStore(path, ("test", 99), 20)
    assert len(database(path)) == 5


def test_several_threads_read_while_one_writes() -> None:
    opened = store(cached=20)
    for i in range(60):
        opened.add(make_keyframe(i, seed=i))
    wrong: list[object] = []

    def read(start: int) -> None:
        try:
            wrong.extend(i for i in range(start, 60, 3) if opened[i].stamp_ns != i * 10**9)
        except Exception as error:
            wrong.append(error)

    readers = [threading.Thread(target=read, args=(start,)) for start in range(3)]
    for reader in readers:
        reader.start()
    for i in range(60, 80):
        opened.add(make_keyframe(i, seed=i))
    for reader in readers:
        reader.join()
    assert wrong == [] and len(opened) == 80


def test_a_file_of_an_unsupported_format_is_refused_in_one_line_and_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "old.sqlite"
    change(path, "CREATE TABLE about (content TEXT NOT NULL)")
    change(path, "CREATE TABLE keyframe (id INTEGER PRIMARY KEY, data BLOB NOT NULL)")
    change(path, "INSERT INTO about VALUES (?)", '{"schema": "1", "embedder": "test", "dimension": "16"}')
    before = path.read_bytes()
    with pytest.raises(
        UmfError, match=r"old\.sqlite is no place database, or one of an earlier version: it holds about, keyframe"
    ) as caught:
        database(path)
    assert "\n" not in str(caught.value)
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == ["old.sqlite"]


def test_another_kind_of_database_is_refused_and_unchanged(tmp_path: Path) -> None:
    (bag,) = write_db3(tmp_path / "bag", traverse(0.3)).glob("*.db3")
    before = bag.read_bytes()
    with pytest.raises(UmfError, match=r"is no place database, or .*: it holds .*messages"):
        database(bag)
    assert bag.read_bytes() == before and not list(bag.parent.glob("*-wal"))


def test_an_empty_file_becomes_a_database(tmp_path: Path) -> None:
    path = tmp_path / "new.sqlite"
    path.touch()
    places = database(path)
    assert len(places) == 0
    places.close()
    filled(path, 2)
    assert len(database(path)) == 2


@pytest.mark.parametrize(("other", "said"), [(("test", 99), "dimension 16"), (("99", 16), "embedder test")])
def test_another_embedder_is_refused_with_both_names(tmp_path: Path, other: tuple[str, int], said: str) -> None:
    path = filled(tmp_path / "map.sqlite", 1)
    with pytest.raises(UmfError, match=rf"map\.sqlite was made with {said}, not 99$"):
        KeyframeStore(path, other, 20)


@pytest.mark.parametrize("data", [b"\x00\x01", "text where bytes belong"])
def test_a_damaged_keyframe_is_named_and_the_others_are_read(tmp_path: Path, data: bytes | str) -> None:
    path = filled(tmp_path / "map.sqlite")
    change(path, "UPDATE keyframe SET data = ? WHERE id = 3", data)
    places = database(path)
    with pytest.raises(UmfError, match=r"map\.sqlite is damaged at its keyframe 3") as caught:
        places[2]
    assert "\n" not in str(caught.value)
    assert places[3].stamp_ns == 3 * 10**9


@pytest.mark.parametrize(("start", "zeros"), [(4096, True), (20_000, True), (9000, False)])
def test_a_damaged_file_is_one_clear_line(tmp_path: Path, start: int, zeros: bool) -> None:
    path = filled(tmp_path / "map.sqlite", 40)
    content = path.read_bytes()
    path.write_bytes(content[:start] + bytes(len(content) - start if zeros else 0))
    with pytest.raises(UmfError, match=r"map\.sqlite (is damaged|cannot be used)") as caught:
        places = database(path)
        for i in range(len(places)):
            places[i]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("session", 2**63 - 1, "session is out of range"),
        ("id", 2**63 - 1, "id is out of range"),
        ("id", -5, "id is out of range"),
        ("descriptor", b"1234", r"map\.sqlite is damaged"),
    ],
)
def test_values_that_cannot_be_are_refused(tmp_path: Path, column: str, value: object, message: str) -> None:
    path = filled(tmp_path / "map.sqlite")
    change(path, f"UPDATE keyframe SET {column} = ? WHERE id = 4", value)
    with pytest.raises(UmfError, match=message):
        database(path)


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(UmfError, match="cannot write"):
        database(tmp_path)


def test_a_path_below_a_file_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"cannot write .*file/map\.sqlite"):
        database(tmp_path / "file" / "map.sqlite")


def test_a_copy_is_complete_although_the_log_was_not_written_back(tmp_path: Path) -> None:
    places = database(tmp_path / "map.sqlite")
    for i in range(7):
        places.add(make_keyframe(i, seed=i))
    places.store.save(tmp_path / "copy.sqlite")
    # one file is all of it: no log beside it is needed
    shutil.move(tmp_path / "copy.sqlite", tmp_path / "elsewhere.sqlite")
    copied = database(tmp_path / "elsewhere.sqlite")
    assert [copied[i].stamp_ns for i in range(7)] == [i * 10**9 for i in range(7)]
    assert not list(tmp_path.glob("*.part"))


def test_a_copy_makes_nobody_wait_who_writes(tmp_path: Path) -> None:
    """That of a long drive takes a minute, and the front-end goes on meanwhile."""
    places = database(filled(tmp_path / "map.sqlite", 5))
    with places.store._lock:  # as while a keyframe is added
        copying = threading.Thread(target=places.store.save, args=(tmp_path / "copy.sqlite",), daemon=True)
        copying.start()
        copying.join(20.0)
        assert not copying.is_alive()
    assert len(database(tmp_path / "copy.sqlite")) == 5


def test_a_copy_replaces_an_older_one(tmp_path: Path) -> None:
    target = filled(tmp_path / "copy.sqlite", 9)
    places = database(tmp_path / "map.sqlite")
    places.add(make_keyframe(1))
    places.store.save(target)
    assert len(database(target)) == 1
