from __future__ import annotations

from pathlib import Path

import numpy as np

from umf_ros.lab.evaluation.places_bench import (
    ALIKE,
    DIMENSION,
    PER_DRIVE,
    REVISIT,
    fill,
    made_up_drives,
    measure_store,
    repeated,
)


def test_made_up_drives_are_as_many_as_asked_for_and_neighbours_are_alike(rng: np.random.Generator) -> None:
    parts = list(made_up_drives(1300, rng, drives_at_once=2))
    assert [len(part) for part in parts] == [500, 500, 300]
    rows = np.concatenate(parts)
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-5)
    one_drive = rows[:PER_DRIVE]
    next_ones = np.median((one_drive[1:] * one_drive[:-1]).sum(axis=1))
    assert abs(next_ones - ALIKE) < 0.04
    assert np.median(one_drive @ rows[600:].T) < 0.5


def test_a_repeated_drive_is_as_alike_as_a_revisit(rng: np.random.Generator) -> None:
    (drive,) = made_up_drives(PER_DRIVE, rng)
    (rows,) = repeated(drive, 600, rng)
    assert len(rows) == 600
    assert abs(np.median((rows[:PER_DRIVE] * drive).sum(axis=1)) - REVISIT) < 0.02


def test_a_store_is_measured(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "places.sqlite"
    fill(path, made_up_drives(600, rng))
    found = measure_store(path, 0)
    assert found.exact and found.recall == 1.0
    assert found.query_ms > 0 and found.open_s > 0
    assert found.disk > 2 * 4 * DIMENSION  # the descriptor, alone and in the keyframe
