from __future__ import annotations

import os
from pathlib import Path

import pytest
from spread_tasks import die, refuse, square, square_after_a_death

from umf_ros.core import tasks as spread_module
from umf_ros.core.errors import UmfError
from umf_ros.core.tasks import spread

WAYS = [(1, None), (2, None), (2, "local")]
EXPECTED = {number: number**2 for number in range(6)}


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """The workers of Ray find the tasks where this process does."""
    here = str(Path(spread_module.__file__).parents[1]), str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, here)))


def results(folder: Path) -> dict[int, int]:
    return {int(path.name): int(path.read_text()) for path in folder.iterdir() if path.name.isdigit()}


@pytest.mark.parametrize(("workers", "ray"), WAYS)
def test_every_task_is_done_however_it_is_spread(tmp_path: Path, workers: int, ray: str | None) -> None:
    told: list[int] = []
    spread(square, [(tmp_path, number) for number in EXPECTED], workers, ray, told.append)
    assert results(tmp_path) == EXPECTED and told == sorted(told) and told[-1] == 6


@pytest.mark.parametrize(("workers", "ray"), WAYS[1:])
def test_a_worker_that_is_killed_is_replaced(tmp_path: Path, workers: int, ray: str | None) -> None:
    spread(square_after_a_death, [(tmp_path, number) for number in EXPECTED], workers, ray)
    assert results(tmp_path) == EXPECTED and (tmp_path / "died").exists()


@pytest.mark.parametrize(("workers", "ray"), WAYS)
def test_what_a_task_says_is_the_one_line(tmp_path: Path, workers: int, ray: str | None) -> None:
    with pytest.raises(UmfError, match=r"^task 1 cannot be done$"):
        spread(refuse, [(tmp_path, 1)], workers, ray)


def test_a_task_that_kills_every_worker_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spread_module, "ATTEMPTS", 2)
    with pytest.raises(UmfError, match="1 tasks crashed their worker"):
        spread(die, [(tmp_path, 1)], 2)


def test_a_cluster_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UmfError, match=r"no Ray cluster at 127\.0\.0\.1:1") as caught:
        spread(square, [(tmp_path, 1)], 1, "127.0.0.1:1")
    assert "\n" not in str(caught.value)
