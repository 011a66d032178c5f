from __future__ import annotations

from pathlib import Path

import pytest

from umf_ros.core.config import Settings, dump_settings, load_settings
from umf_ros.core.errors import UmfError
from umf_ros.runs.writer import PLACES, ReplayFolder

BAG = Path("some.mcap")


def begun(out: Path, settings: Settings) -> ReplayFolder:
    folder = ReplayFolder.create(out, BAG, settings)
    (folder.path / "config.yaml").write_text(dump_settings(settings))
    return folder


def test_the_run_that_was_interrupted_is_resumed(tmp_path: Path) -> None:
    done, cut = begun(tmp_path, Settings()), begun(tmp_path, Settings())
    done.finish()
    found = ReplayFolder.resume(tmp_path, BAG, Settings())
    assert found.path == cut.path and found.resumed
    found.finish()
    fresh = ReplayFolder.resume(tmp_path, BAG, Settings())
    assert fresh.path not in (done.path, cut.path) and not fresh.resumed


def test_another_recording_or_other_settings_are_not_resumed(tmp_path: Path) -> None:
    cut = begun(tmp_path, Settings())
    assert not ReplayFolder.resume(tmp_path, Path("other.mcap"), Settings()).resumed
    with pytest.raises(UmfError, match=f"{cut.path.name} was begun with other settings"):
        ReplayFolder.resume(tmp_path, BAG, load_settings(loop__top_k=3))


def test_a_run_interrupted_before_its_first_row_is_resumed(tmp_path: Path) -> None:
    cut = ReplayFolder.create(tmp_path, BAG, Settings())
    assert ReplayFolder.resume(tmp_path, BAG, Settings()).path == cut.path


def test_places_lie_in_the_folder_until_it_is_finished(tmp_path: Path) -> None:
    folder = begun(tmp_path, Settings())
    places = Path(folder.working_settings.database.path)
    assert places == folder.path / PLACES
    places.touch()
    folder.finish()
    assert not places.exists()
    named = begun(tmp_path, load_settings(database__path=str(tmp_path / "mine.sqlite")))
    assert named.working_settings.database.path == str(tmp_path / "mine.sqlite")


def test_a_damaged_run_is_not_resumed(tmp_path: Path) -> None:
    cut = begun(tmp_path, Settings())
    (cut.path / "run.sqlite").write_text('{"bag": ')
    assert not ReplayFolder.resume(tmp_path, BAG, Settings()).resumed
