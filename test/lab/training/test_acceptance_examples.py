"""Examples in a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from measurements import BAD, GOOD

from umf_ros.lab.fit.acceptance import Example, load_examples, save_examples
from umf_ros.verification.hypothesis import IMAGE

EXAMPLES = [
    Example(GOOD, True, "spin64-street-car"),
    Example(BAD, False, "drive 10000"),
    Example(replace(GOOD, kind=IMAGE, support=float("nan")), False),
]


def test_examples_read_back(tmp_path: Path) -> None:
    save_examples(EXAMPLES, tmp_path / "examples.npz")
    read = load_examples(tmp_path / "examples.npz")
    assert [(one.right, one.domain, one.measurement.kind) for one in read] == [
        (one.right, one.domain, one.measurement.kind) for one in EXAMPLES
    ]
    for one, other in zip(read, EXAMPLES, strict=True):
        assert one.measurement.numbers == pytest.approx(other.measurement.numbers, rel=1e-6, nan_ok=True)


def test_numbers_of_another_version_are_passed_over(tmp_path: Path) -> None:
    save_examples(EXAMPLES, tmp_path / "examples.npz")
    with np.load(tmp_path / "examples.npz") as content:
        old = dict(content)
    old["names"] = np.array([{"common": "luck"}.get(str(name), str(name)) for name in old["names"]])
    np.savez(tmp_path / "old.npz", **old)
    read = load_examples(tmp_path / "old.npz")[0].measurement
    assert np.isnan(read.common) and read.residual_m == pytest.approx(GOOD.residual_m)
