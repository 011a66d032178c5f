from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from conftest import unit

from umf_ros.places import index as index_module
from umf_ros.places.codes import CodeTable, still_possible
from umf_ros.places.index import PROJECTED_FROM, DescriptorIndex
from umf_ros.places.projection import Projection


def units(rng: np.random.Generator, count: int, dimension: int = 32) -> np.ndarray:
    rows = rng.standard_normal((count, dimension)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def along_drives(rng: np.random.Generator, count: int, dimension: int = 32) -> np.ndarray:
    """Neighbours are alike, and few directions say most."""
    spread = 1 / np.arange(1, dimension + 1)
    rows = np.cumsum(rng.standard_normal((count, dimension)), axis=0) % 40 * spread + 0.3 * rng.standard_normal(
        dimension
    )
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def index_of(rows: np.ndarray) -> DescriptorIndex:
    table = CodeTable(rows.shape[1])
    table.extend(rows)
    return DescriptorIndex(table, rows.__getitem__)


def brute_force(rows: np.ndarray, query: np.ndarray, top_k: int, admissible: np.ndarray | bool = True) -> list[int]:
    return [int(row) for row in np.argsort(-np.where(admissible, rows @ query, -9), kind="stable")[:top_k]]


@pytest.mark.parametrize("count", [1, 4, 5, 300])
@pytest.mark.parametrize("top_k", [1, 7, 1000])
def test_search_finds_what_brute_force_finds(rng: np.random.Generator, count: int, top_k: int) -> None:
    rows, query = units(rng, count), unit(rng.standard_normal(32))
    found = index_of(rows).search(query, top_k, np.ones(count, bool))
    assert [row for row, _ in found] == brute_force(rows, query, top_k)
    np.testing.assert_allclose([similarity for _, similarity in found], np.sort(rows @ query)[::-1][:top_k], atol=1e-6)


@pytest.mark.parametrize("make", [units, along_drives])
def test_search_among_many_is_as_exact(rng: np.random.Generator, make: Callable[..., np.ndarray]) -> None:
    count = PROJECTED_FROM + 500
    rows = make(rng, count)
    index = index_of(rows)
    admissible = np.arange(count) % 5 != 0
    for _ in range(20):
        query = unit(rows[rng.integers(count)] + 0.05 * rng.standard_normal(32))
        found = [row for row, _ in index.search(query, 40, admissible)]
        assert found == brute_force(rows, query, 40, admissible)


def test_bounds_hold_and_are_close(rng: np.random.Generator) -> None:
    rows, query = along_drives(rng, 3000, 64), unit(rng.standard_normal(64))
    table = CodeTable(64)
    table.extend(rows)
    lower, upper = table.bounds(query)
    true = rows @ query
    assert (lower <= true).all() and (true <= upper).all() and (upper - lower).max() < 0.08
    some = np.array([5, 2999, 17])
    np.testing.assert_allclose(table.bounds(query, some)[0], lower[some], atol=1e-6)
    _, outlined = Projection(table).scores(query)
    assert (true <= outlined).all()


def test_projections_take_up_later_rows(rng: np.random.Generator) -> None:
    rows = along_drives(rng, 500, 64)
    table = CodeTable(64)
    table.extend(rows[:300])
    projection = Projection(table)
    table.extend(rows[300:])
    projection.extend()
    score, upper = projection.scores(rows[0])
    assert len(score) == 500 and (rows @ rows[0] <= upper).all()


def test_only_what_may_be_among_the_best_is_left() -> None:
    lower, upper = np.array([0.1, 0.5, 0.4, 0.0]), np.array([0.2, 0.6, 0.5, 0.45])
    assert still_possible(lower, upper, 2).tolist() == [1, 2, 3]
    assert still_possible(lower, upper, 9).tolist() == [0, 1, 2, 3]


def test_equal_descriptors_come_in_order_of_row(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.tile(np.array([[1, 0]], np.float32), (50, 1))
    found = index_of(rows).search(rows[0], 10, np.ones(50, bool))
    assert [row for row, _ in found] == list(range(10))
    monkeypatch.setattr(index_module, "FETCHED", 20)  # a rover that sees nothing but fog
    assert index_of(rows).search(rows[0], 10, np.ones(50, bool)) == found


def test_inadmissible_rows_are_never_returned(rng: np.random.Generator) -> None:
    rows = units(rng, 40)
    admissible = np.arange(40) % 3 == 0
    found = index_of(rows).search(rows[1], 40, admissible)
    assert sorted(row for row, _ in found) == np.flatnonzero(admissible).tolist()
    assert index_of(rows).search(rows[1], 5, np.zeros(40, bool)) == []


def test_growth_keeps_every_descriptor_and_a_frozen_table_stays(rng: np.random.Generator) -> None:
    rows = units(rng, 1000, 8)
    table = CodeTable(8)
    for row in rows[:600]:
        table.extend(row[None])
    frozen = table.frozen()
    table.extend(rows[600:])
    assert (len(frozen), len(table)) == (600, 1000)
    np.testing.assert_allclose(table.descriptors(slice(None)), rows, atol=0.005)
    np.testing.assert_array_equal(frozen.descriptors(slice(None)), table.descriptors(np.arange(600)))


def test_wrong_dimension_is_refused() -> None:
    with pytest.raises(ValueError, match="expected \\(N, 4\\)"):
        CodeTable(4).extend(np.zeros((1, 5), np.float32))
