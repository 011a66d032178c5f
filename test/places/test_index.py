from __future__ import annotations

import numpy as np
import pytest

from umf_ros.places.index import DescriptorIndex


def filled(rng: np.random.Generator, count: int, dimension: int = 32) -> DescriptorIndex:
    index = DescriptorIndex(dimension, capacity=4)
    for row in rng.standard_normal((count, dimension)).astype(np.float32):
        index.add(row / np.linalg.norm(row))
    return index


@pytest.mark.parametrize("count", [1, 4, 5, 300])
@pytest.mark.parametrize("top_k", [1, 7, 1000])
def test_search_is_bit_identical_to_brute_force(rng: np.random.Generator, count: int, top_k: int) -> None:
    index = filled(rng, count)
    query = rng.standard_normal(32).astype(np.float32)
    everything = index.descriptors @ query
    expected = [(int(row), float(everything[row])) for row in np.argsort(-everything, kind="stable")[:top_k]]
    assert index.search(query, top_k, np.ones(count, bool)) == expected


def test_equal_descriptors_come_in_order_of_row() -> None:
    index = DescriptorIndex(2)
    for _ in range(50):
        index.add(np.array([1, 0], np.float32))
    found = index.search(np.array([1, 0], np.float32), 10, np.ones(50, bool))
    assert [row for row, _ in found] == list(range(10))


def test_inadmissible_rows_are_never_returned(rng: np.random.Generator) -> None:
    index = filled(rng, 40)
    admissible = np.arange(40) % 3 == 0
    found = index.search(index.descriptors[1], 40, admissible)
    assert sorted(row for row, _ in found) == np.flatnonzero(admissible).tolist()
    assert index.search(index.descriptors[1], 5, np.zeros(40, bool)) == []


def test_growth_keeps_every_descriptor(rng: np.random.Generator) -> None:
    rows = rng.standard_normal((1000, 8)).astype(np.float32)
    index = DescriptorIndex(8, capacity=2)
    assert [index.add(row) for row in rows] == list(range(1000))
    np.testing.assert_array_equal(index.descriptors, rows)


def test_wrong_dimension_is_refused() -> None:
    with pytest.raises(ValueError, match="expected \\(4,\\)"):
        DescriptorIndex(4).add(np.zeros(5, np.float32))
