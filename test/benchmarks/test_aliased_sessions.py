"""Joint graphs of sessions reject groups of wrong closures."""

import pytest

from benchmarks.accuracy import aliased_sessions


@pytest.mark.parametrize(("kind", "share"), [("groups", 0.5), ("near", 0.5)])
def test_groups_of_wrong_closures_between_sessions_are_not_believed(kind: str, share: float) -> None:
    found = aliased_sessions.judge(10_003, kind, share)
    assert found["wrong"] > 30 and found["wrong_between"] == 0
    assert found["right_between"] > 0.9 * found["right"] and found["joined"] == 5
    assert found["ate_joint_m"] < 0.6
