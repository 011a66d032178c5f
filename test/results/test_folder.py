from __future__ import annotations

from pathlib import Path

import pytest

from umf_ros.errors import OutputError
from umf_ros.results.folder import check_writable, create_run_folder, write_atomically


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
    (tmp_path / "summary.json.part").mkdir()
    with pytest.raises(OutputError, match=r"cannot write .*summary\.json"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
