"""Descriptors of a run on disk: kept by stamp, appended to, and none the worse for a process that was killed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from umf_ros.runs.writer import NAME, DescriptorFile, read_descriptors


def write(folder: Path, rows: dict[int, np.ndarray]) -> None:
    file = DescriptorFile(folder)
    for stamp, row in rows.items():
        file.append(stamp, row)
    file.close()


def test_they_come_back_by_stamp(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = {10**18 + i: rng.normal(size=7).astype(np.float32) for i in range(5)}
    write(tmp_path, rows)
    found = read_descriptors(tmp_path, [10**18 + 3, 10**18])
    assert found is not None and found.dtype == np.float32
    np.testing.assert_allclose(found, [rows[10**18 + 3], rows[10**18]], atol=2e-3)
    assert read_descriptors(tmp_path, [10**18, 5]) is None


def test_a_record_that_was_not_finished_goes_and_the_rest_goes_on(tmp_path: Path) -> None:
    write(tmp_path, {1: np.ones(4), 2: np.full(4, 2.0)})
    path = tmp_path / NAME
    path.write_bytes(path.read_bytes()[:-3])
    write(tmp_path, {3: np.full(4, 3.0)})
    found = read_descriptors(tmp_path, [1, 3])
    assert found is not None and found[:, 0].tolist() == [1, 3] and read_descriptors(tmp_path, [2]) is None


def test_a_run_of_an_older_version_has_none(tmp_path: Path) -> None:
    assert read_descriptors(tmp_path, [1]) is None
    (tmp_path / NAME).write_bytes(b"")
    assert read_descriptors(tmp_path, [1]) is None
