"""Disorders of S3LI's files, taken out of the twin: noticed by name or harmless."""

from __future__ import annotations

import pytest
from support.s3li_disorders import AS_IT_IS, verdict

PLAIN = {"warnings": [], "closures_true": 9, "closures_false": 0, "pose_error_m": 0.04, "ate_optimized_m": 0.1}


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        (AS_IT_IS, {}, "harmless"),
        ("gaps", {"ate_optimized_m": 0.5}, "silent"),
        ("dummies", {"closures_false": 1}, "silent"),
        ("drift", {"closures_true": 0}, "silent"),
        ("gps_time", {"closures_false": 5, "warnings": ["... later: is it in GPS time?"]}, "noticed"),
        ("imu_rate", {"warnings": ["... later: is it in GPS time?"], "closures_false": 1}, "silent"),
    ],
)
def test_what_changes_figures_without_its_word_is_silent(name: str, changes: dict, expected: str) -> None:
    assert verdict(name, PLAIN | changes, PLAIN) == expected
