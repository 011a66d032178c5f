from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import make_keyframe, unit

from umf_ros.core.config import Database, Loop
from umf_ros.core.frames import Keyframe
from umf_ros.places import search as search_module
from umf_ros.places.approximate import ApproximateIndex
from umf_ros.places.codes import CodeTable, Rows
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.search import PlaceSearch
from umf_ros.places.store import KeyframeStore
from umf_ros.places.upkeep import delete_sessions

DIMENSION = 16


def database(path: Path, read_only: bool = False) -> PlaceDatabase:
    return PlaceDatabase(Database(path=str(path)), "test", DIMENSION, read_only)


def filled(path: Path, count: int, first: int = 0) -> Path:
    places = database(path)
    for i in range(first, first + count):
        places.add(make_keyframe(i, seed=i, session=i // 50))
    places.close()
    return path


def everywhere(rows: Rows | slice) -> np.ndarray:
    return np.ones(3000, bool)[rows] if isinstance(rows, slice) else np.ones(len(rows), bool)


def best(places: PlaceDatabase, seed: int) -> list[int]:
    query = make_keyframe(10**6, seed=seed, session=999)
    return [found.index for found in places.query(query, Loop(top_k=5, min_similarity=-1))]


def test_codes_beside_the_store_answer_like_the_store(tmp_path: Path) -> None:
    path = filled(tmp_path / "map.sqlite", 100)
    codes = tmp_path / "map.sqlite.codes"
    assert codes.stat().st_size == 100 * (8 + 8 + 4 + 4 + DIMENSION)
    with_codes = database(path)
    answers = [best(with_codes, seed) for seed in range(8)]
    with_codes.close()
    codes.unlink()
    without = database(path)
    assert [best(without, seed) for seed in range(8)] == answers


def test_codes_that_do_not_belong_to_the_places_are_made_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = filled(tmp_path / "map.sqlite", 100)
    delete_sessions(path, [0])
    with caplog.at_level(logging.WARNING):
        places = database(path)
    assert "does not belong to the places as they are now" in caplog.text
    assert best(places, 77)[0] == 27 and len(places) == len(places.search) == 50


def test_codes_of_other_descriptors_are_told_from_the_stores(tmp_path: Path) -> None:
    """The same recording, embedded anew after somebody deleted the store and not what lies beside it."""
    path = filled(tmp_path / "map.sqlite", 60)
    codes = (tmp_path / "map.sqlite.codes").read_bytes()
    path.unlink()
    places = database(path)
    for i in range(60):
        places.add(make_keyframe(i, seed=1000 + i, session=i // 50))
    places.close()
    (tmp_path / "map.sqlite.codes").write_bytes(codes)
    assert best(database(path), 1007)[0] == 7


@pytest.mark.parametrize("cut", [-5, -40 * 30])
def test_codes_cut_short_by_a_crash_are_completed(tmp_path: Path, cut: int) -> None:
    path = filled(tmp_path / "map.sqlite", 100)
    codes = tmp_path / "map.sqlite.codes"
    whole = codes.read_bytes()
    codes.write_bytes(whole[:cut])
    places = database(path)
    assert best(places, 99)[0] == 99
    places.close()
    assert codes.read_bytes() == whole


def test_a_reader_leaves_the_codes_alone(tmp_path: Path) -> None:
    path = filled(tmp_path / "map.sqlite", 10)
    (tmp_path / "map.sqlite.codes").unlink()
    reader = database(path, read_only=True)
    assert best(reader, 3)[0] == 3
    reader.close()
    assert not (tmp_path / "map.sqlite.codes").exists()


@pytest.fixture
def few_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("faiss")
    monkeypatch.setattr(search_module, "APPROXIMATE_FROM", 2000)


def many_places(tmp_path: Path, rng: np.random.Generator, count: int = 3000) -> tuple[KeyframeStore, np.ndarray]:
    opened = KeyframeStore(tmp_path / "map.sqlite", {"embedder": "test", "dimension": str(DIMENSION)}, 20)
    rows = np.stack([unit(row) for row in rng.standard_normal((count, DIMENSION)) / np.arange(1, DIMENSION + 1)])
    blank = make_keyframe(0)
    for i, row in enumerate(rows):
        opened.add(make_keyframe(i, descriptor=row) if i < 3 else _with(blank, i, row))
    return opened, rows


def _with(blank: Keyframe, i: int, row: np.ndarray) -> Keyframe:
    return replace(blank, stamp_ns=i * 10**9, embedding=replace(blank.embedding, descriptor=row))


@pytest.mark.usefixtures("few_are_many")
def test_among_very_many_nearly_all_of_the_best_are_found_and_all_that_is_new(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("umf_ros.places.approximate.SHORTLIST", 300)
    opened, rows = many_places(tmp_path, rng)
    search = PlaceSearch(opened, DIMENSION)
    assert search.is_exact  # until the other index is made, as before
    search.prepare()
    assert not search.is_exact
    hits = 0
    for query in rows[:50]:
        true = {row for row, _ in search.exhaustive(query, 20, everywhere)}
        hits += len(true & {row for row, _ in search(query, 20, everywhere)})
    assert hits >= 990
    new = _with(make_keyframe(0), 5000, unit(rng.standard_normal(DIMENSION)))
    opened.add(new)
    search.add(new.embedding.descriptor)
    assert search(new.embedding.descriptor, 1, everywhere)[0][0] == 3000
    # where hardly anything is admissible, everything is looked through
    only = np.zeros(3001, bool)
    only[[5, 17]] = True
    assert sorted(row for row, _ in search(rows[900], 5, only.__getitem__)) == [5, 17]


@pytest.mark.usefixtures("few_are_many")
def test_the_index_of_very_many_is_there_again_after_a_restart(tmp_path: Path, rng: np.random.Generator) -> None:
    opened, rows = many_places(tmp_path, rng)
    search = PlaceSearch(opened, DIMENSION)
    search.prepare()
    found = search(rows[7], 20, everywhere)
    search.close()
    again = PlaceSearch(opened, DIMENSION)
    assert not again.is_exact and again(rows[7], 20, everywhere) == found
    (tmp_path / "map.sqlite.faiss").write_bytes(b"nonsense")
    assert PlaceSearch(opened, DIMENSION).is_exact


def test_an_index_of_other_places_is_not_taken(tmp_path: Path, rng: np.random.Generator) -> None:
    pytest.importorskip("faiss")
    table, smaller = CodeTable(DIMENSION), CodeTable(DIMENSION)
    table.extend(rng.standard_normal((300, DIMENSION)).astype(np.float32))
    smaller.extend(rng.standard_normal((200, DIMENSION)).astype(np.float32))
    ApproximateIndex.of(table).save(tmp_path / "x.faiss")
    assert ApproximateIndex.load(tmp_path / "x.faiss", smaller) is None
    assert len(ApproximateIndex.load(tmp_path / "x.faiss", table) or ()) == 300
