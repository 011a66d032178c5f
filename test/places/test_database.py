from __future__ import annotations

import math
import weakref
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from conftest import make_keyframe, unit

from umf_ros.core.config import Database, Loop
from umf_ros.core.errors import OutputError, UmfError
from umf_ros.core.frames import Keyframe
from umf_ros.places.database import VISITS, PlaceDatabase
from umf_ros.places.store import pack, stored_identity, unpack

RULES = Loop(min_similarity=-1, min_time_gap_s=20, min_travel_m=15, top_k=50)


def database(path: Path | None = None, embedder: str = "test", cached: int = 400) -> PlaceDatabase:
    return PlaceDatabase(Database(path=str(path or ""), cached_keyframes=cached), embedder, 16)


def assert_same(a: Keyframe, b: Keyframe) -> None:
    assert (a.stamp_ns, a.session, a.camera) == (b.stamp_ns, b.session, b.camera)
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.path_length_m, b.path_length_m)
    assert (a.odom_T_body is None) == (b.odom_T_body is None)
    for name in ("image", "cloud"):
        left, right = getattr(a.embedding, name), getattr(b.embedding, name)
        assert (left is None) == (right is None)
        for item in fields(left) if left is not None else ():
            np.testing.assert_array_equal(getattr(left, item.name), getattr(right, item.name))
            assert getattr(left, item.name).dtype == getattr(right, item.name).dtype


@pytest.mark.parametrize("path_length_m", [3.5, math.nan])
def test_packing_loses_nothing(path_length_m: float) -> None:
    keyframe = make_keyframe(1667.123456789, path_length_m, session=3)
    assert_same(unpack(pack(keyframe)), keyframe)


def stamps_found(places: PlaceDatabase, query: Keyframe) -> list[float]:
    return sorted(found.stamp_ns / 1e9 for found in places.query(query, RULES))


def test_matches_must_be_old_and_far_along_the_path() -> None:
    places = database()
    for stamp_s, path_length_m in [(0, 0), (10, 80), (30, 86), (79, 90), (81, 10)]:
        places.add(make_keyframe(stamp_s, path_length_m))
    # (30, 86): old enough but 14 m back; (79, 90) and (81, 10): too recent
    assert stamps_found(places, make_keyframe(100, 100)) == [0, 10]


def test_without_odometry_time_alone_decides() -> None:
    places = database()
    places.add(make_keyframe(0))
    places.add(make_keyframe(1, 99))
    places.add(make_keyframe(90))
    assert stamps_found(places, make_keyframe(100, 100)) == [0]
    assert stamps_found(places, make_keyframe(100)) == [0, 1]


def test_other_sessions_may_lie_near_along_the_path_but_never_in_the_future() -> None:
    places = database()
    for second in (0, 99, 100, 101):  # the last three: the same recording, played before
        places.add(make_keyframe(second, 99, session=0))
    assert stamps_found(places, make_keyframe(100, 100, session=1)) == [0]
    assert stamps_found(places, make_keyframe(100, 100, session=0)) == []
    assert places.next_session == 1


def test_a_stamp_that_comes_again_means_the_newer_keyframe() -> None:
    """Closures name keyframes by their stamps alone: those of a boot before, with a clock that began at 0 as well."""
    places = database()
    for second in (0, 30, 60):
        places.add(make_keyframe(second, second, session=0))
    assert stamps_found(places, make_keyframe(100, 0, session=1)) == [0, 30, 60]
    places.add(make_keyframe(20, 0, session=1))
    places.add(make_keyframe(30, 10, session=1))
    assert stamps_found(places, make_keyframe(120, 100, session=1)) == [0, 20, 30]


def test_best_match_comes_first_and_weak_ones_can_be_cut() -> None:
    places = database()
    for seed in range(30):
        places.add(make_keyframe(seed * 0.1, seed=seed))
    query = make_keyframe(100, descriptor=places[17].embedding.descriptor)
    best = places.query(query, RULES)[0]
    assert best.index == 17 and best.similarity == pytest.approx(1, abs=1e-6)
    assert len(places.query(query, Loop(min_similarity=0.99))) == 1


def test_memory_is_bounded_and_every_keyframe_is_read_from_disk() -> None:
    places = database(cached=20)
    scans: list[weakref.ref[np.ndarray]] = []
    for i in range(100):
        keyframe = make_keyframe(i, seed=i)
        scans.append(weakref.ref(keyframe.points))
        places.add(keyframe)
    del keyframe
    assert [scan() is not None for scan in scans] == [False] * 80 + [True] * 20
    for index in (0, 57, 99):
        assert_same(places[index], make_keyframe(index, seed=index))


def test_a_stored_database_is_opened_again(tmp_path: Path) -> None:
    first = database(tmp_path / "map.sqlite")
    for i in range(5):
        first.add(make_keyframe(i, i, seed=i))
    first.close()
    second = database(tmp_path / "map.sqlite")
    assert len(second) == 5 and second.next_session == 1
    assert_same(second[3], make_keyframe(3, 3, seed=3))


def test_a_place_of_many_sessions_does_not_displace_the_others() -> None:
    rng = np.random.default_rng(0)
    query, elsewhere = rng.standard_normal((2, 16))
    places = database()
    for session in range(40):
        near = unit(query + 0.3 * elsewhere + 0.02 * rng.standard_normal(16))
        places.add(make_keyframe(100 * session, session=session, descriptor=near))
    right = places.add(make_keyframe(50, session=0, descriptor=unit(query - 0.5 * elsewhere)))
    found = places.query(make_keyframe(9000, session=99, descriptor=unit(query)), Loop(top_k=20))
    assert right in [candidate.index for candidate in found]
    assert len(found) == VISITS + 1
    best = [candidate.similarity for candidate in found]
    assert best == sorted(best, reverse=True)


def test_neighbours_along_one_drive_are_all_candidates() -> None:
    places = database()
    descriptor = make_keyframe(0, seed=1).embedding.descriptor
    for i in range(30):
        places.add(make_keyframe(0.1 * i, descriptor=descriptor))
    assert len(places.query(make_keyframe(100, descriptor=descriptor), Loop(top_k=20))) == 20


def test_a_duplicate_is_found_and_another_keyframe_of_its_stamp_is_not() -> None:
    places = database()
    places.add(make_keyframe(1, seed=1))
    row = places.add(make_keyframe(1, seed=2, session=3))
    assert places.find_duplicate(make_keyframe(1, seed=2, session=9)) == row
    assert places.find_duplicate(make_keyframe(1, seed=5)) is None
    assert places.find_duplicate(make_keyframe(2, seed=2)) is None
    assert places.store.rows_at(10**9)[-1] == row and not places.store.rows_at(7)
    without_image = replace(make_keyframe(1, seed=2), embedding=make_keyframe(1, seed=5).embedding)
    assert places.find_duplicate(without_image) == row
    empty = np.empty((0, 3), np.float32)
    places.add(replace(make_keyframe(3, seed=2), points=empty))
    assert places.find_duplicate(replace(make_keyframe(3, seed=5), points=empty)) is None


def test_saving_copies_everything(tmp_path: Path) -> None:
    places = database()
    places.add(make_keyframe(1))
    places.store.save(tmp_path / "sub" / "copy.sqlite")
    places.add(make_keyframe(2))
    assert len(database(tmp_path / "sub" / "copy.sqlite")) == 1


def test_a_foreign_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not a database, but long enough to be looked at " * 20)
    with pytest.raises(UmfError, match=r"notes\.txt cannot be used as a place database"):
        database(path)
    assert path.read_text().startswith("not a database")


def test_an_unwritable_copy_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        database().store.save(tmp_path / "file" / "copy.sqlite")


def test_places_of_named_sessions_are_found_whatever_their_age(tmp_path: Path) -> None:
    places = database(tmp_path / "a.sqlite")
    for session, stamp in ((0, 500.0), (1, 10.0), (2, 900.0)):
        places.add(make_keyframe(stamp, path_length_m=0.0, seed=session, session=session))
    query = make_keyframe(20.0, path_length_m=0.0, seed=1, session=2)
    assert [found.index for found in places.query(query, Loop())] == []
    assert sorted(found.index for found in places.query(query, Loop(), range(2))) == [0, 1]
    assert [found.index for found in places.query(query, Loop(), range(1, 2))] == [1]


def test_a_reader_opens_a_database_in_use_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    writer = database(path)
    writer.add(make_keyframe(1.0))
    reader = PlaceDatabase(Database(path=str(path)), *stored_identity(path), read_only=True)
    assert reader[0].stamp_ns == 10**9 and len(reader) == 1
    with pytest.raises(UmfError, match="read"):
        reader.add(make_keyframe(2.0))
    reader.close()
    with pytest.raises(UmfError, match="there is no place database"):
        PlaceDatabase(Database(path=str(tmp_path / "b.sqlite")), "x", 16, read_only=True)
    assert not (tmp_path / "b.sqlite").exists()
