"""Search among descriptors: as brute force finds them, at every size, and again after a restart."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import make_keyframe, unit

from umf_ros.core.config import Database, Loop
from umf_ros.places import database as database_module
from umf_ros.places.database import PlaceDatabase, PlaceIndex
from umf_ros.places.store import KeyframeStore, delete_sessions, index_path

DIMENSION = 16


def units(rng: np.random.Generator, count: int, dimension: int = 32) -> np.ndarray:
    rows = rng.standard_normal((count, dimension)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def index_of(rows: np.ndarray) -> PlaceIndex:
    index = PlaceIndex(rows.shape[1])
    index.add(rows)
    return index


def database(path: Path | None, read_only: bool = False) -> PlaceDatabase:
    return PlaceDatabase(Database(path=str(path or "")), "test", DIMENSION, read_only)


def fill(places: PlaceDatabase, descriptors: np.ndarray, first: int = 0) -> None:
    blank = make_keyframe(0)
    for i, row in enumerate(descriptors, first):
        embedding = replace(blank.embedding, descriptor=row)
        places.add(replace(blank, stamp_ns=i * 10**9, session=i // 50, embedding=embedding))


def best(places: PlaceDatabase, descriptor: np.ndarray, count: int = 5) -> list[tuple[int, float]]:
    query = make_keyframe(10**6, session=999, descriptor=descriptor)
    return [(found.index, found.similarity) for found in places.query(query, Loop(top_k=count, min_similarity=-1))]


@pytest.mark.parametrize("count", [1, 4, 5, 300])
@pytest.mark.parametrize("top_k", [1, 7, 1000])
def test_an_index_finds_the_rows_that_brute_force_finds(rng: np.random.Generator, count: int, top_k: int) -> None:
    rows, query = units(rng, count), unit(rng.standard_normal(32))
    admissible = np.arange(count) % 4 != 1
    found = index_of(rows).search(query, top_k, admissible.__getitem__)
    similarity = np.where(admissible, rows @ query, -9)
    expected = np.sort(similarity)[::-1][: min(top_k, admissible.sum())]
    assert len(set(found.tolist())) == len(expected)
    np.testing.assert_allclose(similarity[found], expected, atol=5e-4)


def test_nothing_is_found_in_an_empty_index_or_among_inadmissible_rows(rng: np.random.Generator) -> None:
    index, query = PlaceIndex(32), unit(rng.standard_normal(32))
    assert index.search(query, 5, np.zeros(0, bool).__getitem__).tolist() == []
    index.add(units(rng, 40))
    assert index.search(query, 5, np.zeros(40, bool).__getitem__).tolist() == []


def test_candidates_have_the_similarities_of_full_precision(rng: np.random.Generator) -> None:
    """Descriptors that half precision cannot tell apart are ordered all the same; equal ones by row."""
    rows = np.tile(unit(rng.standard_normal(DIMENSION)), (60, 1)).astype(np.float32)
    rows[7] += np.float32(1e-5) * rows[7]
    places = database(None)
    fill(places, rows)
    found = best(places, rows[0], 20)
    # one place: the first keyframes of the four sessions at most, two sessions here
    assert found[0] == (7, pytest.approx(1 + 1e-5, abs=2e-7))
    assert [row for row, _ in found[1:8]] == [0, 1, 2, 3, 4, 5, 6]
    places.close()


@pytest.fixture
def few_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database_module, "EXACT_UP_TO", 2000)
    monkeypatch.setattr(database_module, "SHORTLIST", 300)
    monkeypatch.setattr(database_module, "BATCH", 500)


def spread(rng: np.random.Generator, count: int) -> np.ndarray:
    rows = rng.standard_normal((count, DIMENSION)) / np.arange(1, DIMENSION + 1)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.usefixtures("few_are_many")
def test_a_large_index_finds_nearly_all_of_the_best_and_every_new_row(rng: np.random.Generator) -> None:
    rows = spread(rng, 3000)
    index = index_of(rows)
    assert index.is_exact
    index.compress()
    assert not index.is_exact
    everywhere = np.ones(3001, bool)
    hits = 0
    for query in rows[:50]:
        true = set(np.argsort(-(rows @ query))[:20].tolist())
        hits += len(true & set(index.search(query, 20, everywhere[:3000].__getitem__).tolist()))
    assert hits >= 990
    new = units(rng, 1, DIMENSION)
    index.add(new)
    assert index.search(new[0], 1, everywhere.__getitem__).tolist() == [3000]
    # every descriptor is compared where hardly any row of the shortlist is admissible
    only = np.zeros(3001, bool)
    only[[5, 17]] = True
    assert sorted(index.search(rows[900], 5, only.__getitem__).tolist()) == [5, 17]


@pytest.mark.usefixtures("few_are_many")
def test_a_database_grows_past_exact_search_and_answers_alike_after_a_restart(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    path, rows = tmp_path / "map.sqlite", spread(rng, 2600)
    places = database(path)
    fill(places, rows)
    assert not places.index.is_exact
    found = [best(places, rows[i]) for i in range(0, 2600, 200)]
    assert [each[0][0] for each in found] == list(range(0, 2600, 200))
    places.close()
    assert index_path(path).is_file()
    again = database(path)
    assert not again.index.is_exact and [best(again, rows[i]) for i in range(0, 2600, 200)] == found
    fill(again, rows[:10] * np.float32(-1), 2600)
    assert best(again, -rows[3])[0][0] == 2603
    again.close()


@pytest.mark.usefixtures("few_are_many")
def test_a_killed_process_leaves_an_index_that_is_completed(tmp_path: Path, rng: np.random.Generator) -> None:
    path, rows = tmp_path / "map.sqlite", spread(rng, 1300)
    places = database(path)
    fill(places, rows)
    (copy := tmp_path / "killed").mkdir()
    places.store.save(copy / "map.sqlite")
    index_path(copy / "map.sqlite").write_bytes(index_path(path).read_bytes())  # of the first 1000 or so
    survivor = database(copy / "map.sqlite")
    assert len(survivor.index) == 1300 and [best(survivor, rows[i])[0][0] for i in (3, 1299)] == [3, 1299]
    survivor.close()
    places.close()


@pytest.mark.usefixtures("few_are_many")
@pytest.mark.parametrize("damage", ["deleted session", "other descriptors", "nonsense", "another index"])
def test_an_index_that_does_not_match_the_store_is_built_again(
    tmp_path: Path, rng: np.random.Generator, damage: str
) -> None:
    path, rows = tmp_path / "map.sqlite", spread(rng, 600)
    with_index = database(path)
    fill(with_index, rows)
    with_index.close()
    stored = index_path(path).read_bytes()
    if damage == "deleted session":
        assert delete_sessions(path, [0]) == 50
    elif damage == "other descriptors":
        path.unlink()
        other = database(path)
        fill(other, spread(rng, 600))
        other.close()
        index_path(path).write_bytes(stored)
    elif damage == "nonsense":
        index_path(path).write_bytes(b"nonsense")
    else:
        import faiss

        faiss.write_index(faiss.index_factory(DIMENSION, "Flat"), str(index_path(path)))
    places = database(path)
    for row in (0, 77, len(places) - 1):
        found = best(places, places[row].embedding.descriptor)[0]
        assert found == (row, pytest.approx(1, abs=1e-6))
    places.close()


@pytest.mark.usefixtures("few_are_many")
def test_a_reader_writes_no_index(tmp_path: Path, rng: np.random.Generator) -> None:
    path, rows = tmp_path / "map.sqlite", spread(rng, 600)
    places = database(path)
    fill(places, rows)
    places.close()
    index_path(path).unlink()
    reader = database(path, read_only=True)
    assert best(reader, rows[3])[0][0] == 3
    reader.close()
    assert not index_path(path).exists()


def test_a_small_database_is_one_file(tmp_path: Path, rng: np.random.Generator) -> None:
    places = database(tmp_path / "map.sqlite")
    fill(places, spread(rng, 60))
    places.close()
    assert not index_path(tmp_path / "map.sqlite").exists()


def test_a_search_leaves_the_threads_of_the_network_alone() -> None:
    code = (
        "import numpy as np, torch\n"
        "from umf_ros.places.database import PlaceIndex\n"
        "torch.set_num_threads(2)\n"
        "index = PlaceIndex(8)\n"
        "index.add(np.eye(8, dtype=np.float32))\n"
        "index.search(np.eye(8, dtype=np.float32)[0], 3, np.ones(8, bool).__getitem__)\n"
        "assert torch.get_num_threads() == 2, torch.get_num_threads()\n"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_store_of_half_its_descriptors_is_damage_and_not_a_crash(tmp_path: Path) -> None:
    opened = KeyframeStore(tmp_path / "map.sqlite", ("test", 16), 20)
    opened.add(make_keyframe(0, descriptor=np.ones(8, np.float32)))
    opened.close()
    with pytest.raises(Exception, match=r"map\.sqlite is damaged"):
        database(tmp_path / "map.sqlite")
