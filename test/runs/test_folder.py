from __future__ import annotations

import os
from pathlib import Path

import pytest

from umf_ros.core.errors import OutputError
from umf_ros.core.io import check_writable, create_run_folder, write_atomically


def test_latest_follows_the_newest_run(tmp_path: Path) -> None:
    folders = [create_run_folder(tmp_path / "results") for _ in range(3)]
    assert len(set(folders)) == 3
    assert (tmp_path / "results" / "latest").resolve() == folders[-1].resolve()
    assert not (tmp_path / "results" / "latest").readlink().is_absolute()


def test_an_unwritable_place_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for attempt in (create_run_folder, check_writable):
        with pytest.raises(OutputError, match=r"cannot write to .*file/results"):
            attempt(tmp_path / "file" / "results")


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    write_atomically(path, "old")
    (tmp_path / f".summary.json.{os.getpid()}.part").mkdir()
    with pytest.raises(OutputError, match=r"cannot write .*summary\.json"):
        write_atomically(path, "new")
    assert path.read_text() == "old"


def test_runs_of_the_same_second_get_folders_of_their_own(tmp_path: Path) -> None:
    names = [create_run_folder(tmp_path).name for _ in range(12)]
    assert len(set(names)) == 12 and sorted(path.name for path in tmp_path.iterdir()) == sorted([*names, "latest"])


def test_a_latest_that_leads_nowhere_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "latest").symlink_to("a run that was deleted")
    folder = create_run_folder(tmp_path)
    assert (tmp_path / "latest").resolve() == folder.resolve()


def test_a_folder_named_latest_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "latest").mkdir()
    (tmp_path / "latest" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=f"cannot write to {tmp_path}"):
        create_run_folder(tmp_path)
    assert (tmp_path / "latest" / "notes.txt").read_text() == "mine"


def test_a_place_for_results_is_made_when_it_is_asked_for(tmp_path: Path) -> None:
    check_writable(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir() and list((tmp_path / "a" / "b").iterdir()) == []
