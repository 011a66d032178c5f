"""Examples in a file."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from measurements import BAD, GOOD, GOOD_VIEWS

from umf_ros.lab.fit.acceptance import Example, load_examples, save_examples
from umf_ros.verification.hypothesis import IMAGE, SCAN

UNKNOWN = GOOD_VIEWS | {"two_way_m": math.inf, "similarity": math.nan}
EXAMPLES = [Example(GOOD, True, "spin64-street-car"), Example(BAD, False, "drive 10000"), Example(UNKNOWN, False)]


def test_examples_read_back(tmp_path: Path) -> None:
    save_examples(EXAMPLES, tmp_path / "examples.npz")
    read = load_examples(tmp_path / "examples.npz")
    assert [(one.right, one.domain, one.kind) for one in read] == [
        (True, "spin64-street-car", SCAN),
        (False, "drive 10000", SCAN),
        (False, "", IMAGE),
    ]
    for one, other in zip(read, EXAMPLES, strict=True):
        known = {name: value for name, value in other.measurements.items() if not math.isnan(value)}
        assert one.measurements == pytest.approx(known, rel=1e-6)


def test_a_number_of_another_version_is_kept_by_its_name_and_a_missing_one_is_absent(tmp_path: Path) -> None:
    save_examples(EXAMPLES, tmp_path / "examples.npz")
    with np.load(tmp_path / "examples.npz") as content:
        old = dict(content)
    old["names"] = np.array([{"common": "luck"}.get(str(name), str(name)) for name in old["names"]])
    np.savez(tmp_path / "old.npz", **old)
    read = load_examples(tmp_path / "old.npz")[0].measurements
    assert "common" not in read and read["residual_m"] == pytest.approx(GOOD["residual_m"])
