from __future__ import annotations

from pathlib import Path

import pytest

from umf_ros.core.config import Settings, dump_settings, load_settings
from umf_ros.core.errors import UmfError
from umf_ros.core.io import create_run_folder
from umf_ros.runs.writer import PLACES, begin_folder, finish_folder, unfinished_folder, with_places

BAG = Path("some.mcap")


def begun(out: Path, settings: Settings) -> Path:
    folder = begin_folder(create_run_folder(out), BAG)
    (folder / "config.yaml").write_text(dump_settings(settings))
    return folder


def test_the_run_that_was_interrupted_is_found(tmp_path: Path) -> None:
    done, cut = begun(tmp_path, Settings()), begun(tmp_path, Settings())
    finish_folder(done)
    assert unfinished_folder(tmp_path, BAG, Settings()) == cut
    finish_folder(cut)
    assert unfinished_folder(tmp_path, BAG, Settings()) is None


def test_another_recording_or_other_settings_are_not_resumed(tmp_path: Path) -> None:
    cut = begun(tmp_path, Settings())
    assert unfinished_folder(tmp_path, Path("other.mcap"), Settings()) is None
    with pytest.raises(UmfError, match=f"{cut.name} was started with other settings"):
        unfinished_folder(tmp_path, BAG, load_settings(loop__top_k=3))


def test_a_run_interrupted_before_its_first_row_is_resumed(tmp_path: Path) -> None:
    cut = begin_folder(create_run_folder(tmp_path), BAG)
    assert unfinished_folder(tmp_path, BAG, Settings()) == cut


def test_places_lie_in_the_folder_until_it_is_finished(tmp_path: Path) -> None:
    folder = begun(tmp_path, Settings())
    places = Path(with_places(Settings(), folder).database.path)
    assert places == folder / PLACES
    places.touch()
    finish_folder(folder)
    assert not places.exists()
    named = load_settings(database__path=str(tmp_path / "mine.sqlite"))
    assert with_places(named, folder) == named


def test_a_damaged_run_is_not_resumed(tmp_path: Path) -> None:
    cut = begun(tmp_path, Settings())
    (cut / "run.sqlite").write_text('{"bag": ')
    assert unfinished_folder(tmp_path, BAG, Settings()) is None
