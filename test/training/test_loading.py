"""Batches made ahead by other processes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from umf_ros.errors import ConfigError
from umf_ros.training.loading import made_ahead


@pytest.mark.parametrize("workers", [0, 1, 3, 9])
def test_everything_comes_once_and_in_order(workers: int) -> None:
    assert list(made_ahead(lambda step: step * step, range(3, 8), workers)) == [9, 16, 25, 36, 49]


def test_others_make_it_and_not_more_than_is_wanted(tmp_path: Path) -> None:
    def make(step: int) -> int:
        (tmp_path / str(step)).touch()
        return os.getpid()

    makers = set(made_ahead(make, range(6), 2))
    assert len(makers) == 2 and os.getpid() not in makers
    assert sorted(path.name for path in tmp_path.iterdir()) == [str(step) for step in range(6)]
    assert set(made_ahead(make, range(2), 0)) == {os.getpid()}


@pytest.mark.parametrize("workers", [0, 2])
def test_an_error_of_the_user_stays_one_line(workers: int) -> None:
    def make(step: int) -> int:
        if step == 2:
            raise ConfigError("data: nothing to see")
        return step

    seen = []
    with pytest.raises(ConfigError) as raised:
        for item in made_ahead(make, range(5), workers):
            seen.append(item)
    assert (seen, str(raised.value)) == ([0, 1], "data: nothing to see")
