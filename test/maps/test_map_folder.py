import json
from pathlib import Path

import pytest
from maps_made import MadeSession, made_map

from umf_ros.core.config import Settings, load_settings
from umf_ros.core.errors import OutputError, UmfError
from umf_ros.maps.map_folder import APART_NS, MapFolder

DAY_NS = 86_400 * 10**9


def test_clocks_that_coincide_are_moved_apart_by_whole_days(tmp_path: Path) -> None:
    folder = made_map(tmp_path / "map", [MadeSession(name, 0, 30) for name in "abc"])
    assert [session.shift_ns for session in folder.sessions] == [0, DAY_NS, 2 * DAY_NS]
    assert folder.session_at(folder.sessions[1].first_ns + DAY_NS) is folder.sessions[1]
    assert folder.session_at(folder.sessions[0].last_ns + APART_NS) is None


def test_a_recording_made_later_keeps_its_clock(tmp_path: Path) -> None:
    folder = made_map(tmp_path / "map", [MadeSession("a", 0, 30)])
    assert folder.shift_for(folder.sessions[0].last_ns + APART_NS) == 0
    assert folder.shift_for(folder.sessions[0].last_ns + APART_NS - 1) == DAY_NS
    assert folder.shift_for(folder.sessions[0].first_ns - 10 * DAY_NS) == 11 * DAY_NS  # an older one, added later


def test_a_map_is_read_back_and_recognises_its_recordings(tmp_path: Path) -> None:
    made = made_map(tmp_path / "map", [MadeSession("a", 0, 30), MadeSession("b", 0, 20)])
    folder = MapFolder.open(tmp_path / "map")
    assert folder.sessions == made.sessions
    moved = folder.sessions[1].recording | {"path": "elsewhere.mcap"}
    assert folder.find(moved) == folder.sessions[1]
    assert folder.find(moved | {"messages": {"a": 7}}) is None
    assert folder.free_name(Path("c.mcap")) == "c" and folder.free_name(Path("x/a.mcap")) == "a_2"


def test_settings_of_the_first_recording_stay(tmp_path: Path) -> None:
    MapFolder.open_or_create(tmp_path, load_settings(None, loop__top_k=5))
    made_map(tmp_path, [MadeSession("a", 0, 30)], load_settings(None, loop__top_k=7))  # the first call failed
    again = MapFolder.open_or_create(tmp_path, Settings())
    assert again.settings.loop.top_k == 7


def test_a_folder_of_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("mine")
    with pytest.raises(OutputError, match="holds other files and no map"):
        MapFolder.open_or_create(tmp_path, Settings())
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_other_folders_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UmfError, match="is not a map"):
        MapFolder.open(tmp_path)
    (tmp_path / "map.json").write_text("{")
    with pytest.raises(UmfError, match="damaged"):
        MapFolder.open(tmp_path)
    (tmp_path / "map.json").write_text('{"schema": 99, "sessions": []}')
    with pytest.raises(UmfError, match="another version"):
        MapFolder.open(tmp_path)


WRONG_NAMES = ("../../../x", "/tmp/x", "a/b", "..", ".", "", "a\\b", "line\nbreak", "\x1b[2J", "x" * 300, "\u202eevil")


@pytest.mark.parametrize("name", WRONG_NAMES)
def test_a_session_whose_name_leads_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    made_map(tmp_path / "map", [MadeSession("a", 0, 30)])
    path = tmp_path / "map" / "map.json"
    content = json.loads(path.read_text())
    content["sessions"][0]["name"] = name
    path.write_text(json.dumps(content))
    with pytest.raises(UmfError, match="is not the name of a file in") as caught:
        MapFolder.open(tmp_path / "map")
    assert str(caught.value).isprintable()


def test_a_link_out_of_the_map_is_refused(tmp_path: Path) -> None:
    folder = MapFolder.open_or_create(tmp_path / "map", load_settings(None))
    (tmp_path / "map" / "sessions").mkdir()
    (tmp_path / "map" / "sessions" / "a").symlink_to(tmp_path, target_is_directory=True)
    with pytest.raises(UmfError, match="is not the name of a file in"):
        folder.folder_of("a")


@pytest.mark.parametrize("file", ["...mcap", "..mcap", "a\nb.mcap", "\x1b[31m.mcap", f"{'x' * 250}.mcap"])
def test_a_session_is_named_after_its_file_as_far_as_that_is_a_name(tmp_path: Path, file: str) -> None:
    folder = MapFolder.open_or_create(tmp_path / "map", load_settings(None))
    assert folder.folder_of(folder.free_name(Path(file))).parent == tmp_path / "map" / "sessions"
