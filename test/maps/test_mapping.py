"""The steps of a map, on recordings of noise: what each leaves, and what is left when a process dies between them."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from recordings import CALIBRATION, CLOUD, ODOMETRY, START_NS, drive, traverse, write_mcap
from submaps_drives import drive as drive_lidar
from submaps_drives import rough_ground

from umf_ros.bags.reader import open_bag
from umf_ros.core.config import Settings
from umf_ros.core.errors import BagError, UmfError
from umf_ros.core.geometry import invert, relative
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.maps.map_folder import MapFolder
from umf_ros.maps.mapping import (
    Opening,
    add_places,
    add_session,
    find_recordings,
    match_session,
    open_places,
    replay_session,
    unmatched,
)
from umf_ros.places.store import stored_sessions
from umf_ros.runs.run_file import RunFile
from umf_ros.sensors.decode import OdometrySample

DAY_NS = 86_400 * 10**9


@pytest.fixture
def opening(tmp_path: Path) -> Opening:
    (tmp_path / "calibration.yaml").write_text(CALIBRATION)
    config = tmp_path / "config.yaml"
    config.write_text(
        f"calibration: {tmp_path / 'calibration.yaml'}\nkeyframe: {{min_translation_m: 0.2, min_period_s: 0.0, "
        "untracked_period_s: 0.5}\nverification: {features: umf}\n"
    )
    return Opening(config, embedder="thumbnail")


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "a.mcap", traverse(3.0))


def odometry_in(folder: Path) -> list[OdometrySample]:
    with closing(RunFile(folder, read_only=True)) as file:
        return list(file.odometry())


def new_map(path: Path, opening: Opening, bag: Path) -> MapFolder:
    return MapFolder.open_or_create(path, opening.settings(open_bag(bag)))


def test_recordings_are_found_in_folders_and_once(tmp_path: Path) -> None:
    folder = tmp_path / "bags"
    (folder / "c").mkdir(parents=True)
    for name in ("b.mcap", "a.db3", "c/metadata.yaml", "notes.txt"):
        (folder / name).touch()
    found = find_recordings([folder, folder / "b.mcap"])
    assert [path.name for path in found] == ["a.db3", "b.mcap", "c"]
    with pytest.raises(BagError, match="there is no recording"):
        find_recordings([tmp_path / "x.mcap"])


def test_one_recording_becomes_a_run_with_places_and_all_odometry(tmp_path: Path, opening: Opening, bag: Path) -> None:
    heard: list[float] = []
    replay_session(bag, opening, tmp_path / "run", lambda done, _: heard.append(done))
    assert heard == sorted(heard) and 0.9 < heard[-1] <= 1
    odometry = odometry_in(tmp_path / "run")
    assert len(odometry) == 60 and odometry[0].stamp_ns == START_NS
    places = open_places(tmp_path / "run" / "places.sqlite")
    assert len(places) > 5
    assert (tmp_path / "run" / "closures.csv").is_file()
    replay_session(bag, opening, tmp_path / "run")  # made anew, not appended to
    assert len(open_places(tmp_path / "run" / "places.sqlite")) == len(places)


def test_a_second_session_is_stored_behind_the_first_on_the_maps_clock(
    tmp_path: Path, opening: Opening, bag: Path
) -> None:
    target = new_map(tmp_path / "map", opening, bag)
    for name in ("one", "two"):
        replay_session(bag, opening, target.folder_of(name))
        add_session(target, name, bag)
    first, second = MapFolder.open(tmp_path / "map").sessions
    assert second.shift_ns == DAY_NS and second.first_place == first.places and second.first_number == 1
    places = open_places(target.places)
    assert places[second.first_place].stamp_ns == places[0].stamp_ns + DAY_NS
    assert places[second.first_place].session == 1
    assert not (target.folder_of("two") / "places.sqlite").exists()
    assert [session.name for session in unmatched(target)] == ["one", "two"]
    for session in unmatched(target):
        matches = list(match_session(target, session))
        assert len(matches) == session.places
        assert all(v.candidate.index < session.first_place for verdicts in matches for v in verdicts)
    assert unmatched(target) == []


def test_places_of_a_killed_process_are_removed(tmp_path: Path, opening: Opening, bag: Path) -> None:
    target = new_map(tmp_path / "map", opening, bag)
    replay_session(bag, opening, target.folder_of("one"))
    add_session(target, "one", bag)
    (tmp_path / "map" / "map.json").write_text('{"schema": 1, "sessions": []}\n')  # killed before it was written down
    again = MapFolder.open(tmp_path / "map")
    replay_session(bag, opening, again.folder_of("one"))
    add_session(again, "one", bag)
    assert [(one.number, one.keyframes) for one in stored_sessions(again.places)] == [(0, again.sessions[0].places)]


def test_an_interrupted_match_counts_as_unmatched(tmp_path: Path, opening: Opening, bag: Path) -> None:
    target = new_map(tmp_path / "map", opening, bag)
    replay_session(bag, opening, target.folder_of("one"))
    session = add_session(target, "one", bag)
    next(match_session(target, session))
    assert unmatched(target) == [session]


def test_another_network_is_refused(tmp_path: Path, opening: Opening, bag: Path) -> None:
    target = new_map(tmp_path / "map", opening, bag)
    replay_session(bag, opening, target.folder_of("one"))
    add_session(target, "one", bag)
    other = Opening(opening.config, embedder="gradients")
    replay_session(bag, other, target.folder_of("two"))
    with pytest.raises(UmfError, match="was made with embedder thumbnail"):
        add_session(target, "two", bag)


def test_odometry_comes_from_a_file_of_its_name(tmp_path: Path, opening: Opening) -> None:
    bag = write_mcap(tmp_path / "b.mcap", [entry for entry in traverse(3.0) if entry[0] != ODOMETRY])
    seconds = np.arange(0, 3, 0.1)
    path = Trajectory(START_NS + np.round(seconds * 1e9).astype(np.int64), np.stack([drive(s) for s in seconds]))
    (tmp_path / "odometry").mkdir()
    write_tum(tmp_path / "odometry" / "b.odometry.tum", path)
    with_file = Opening(opening.config, embedder="thumbnail", odometry=tmp_path / "odometry")
    replay_session(bag, with_file, tmp_path / "run")
    odometry = odometry_in(tmp_path / "run")
    assert len(odometry) == len(path)


@pytest.mark.parametrize(("lacks", "why"), [((ODOMETRY,), "vgicp"), ((ODOMETRY, CLOUD), "neither odometry nor scans")])
def test_a_recording_without_odometry_is_refused_before_it_is_replayed(
    tmp_path: Path, opening: Opening, lacks: tuple[str, ...], why: str
) -> None:
    bag = write_mcap(tmp_path / "b.mcap", [entry for entry in traverse(3.0) if entry[0] not in lacks])
    with pytest.raises(BagError, match=why):
        replay_session(bag, opening, tmp_path / "blind")
    assert odometry_in(tmp_path / "blind") == []


def test_a_narrow_lidar_joins_two_sessions_driven_in_opposite_directions(tmp_path: Path) -> None:
    outing = drive_lidar(rough_ground(5), out_m=27.0)
    half = len(outing.keyframes) // 2
    target = MapFolder.open_or_create(tmp_path / "map", Settings())
    for name, first, last in (("out", 0, half), ("back", half, 2 * half)):
        keyframes = outing.keyframes[first:last]
        folder = target.folder_of(name)
        folder.mkdir(parents=True)
        with closing(RunFile(folder)) as file:
            for one in keyframes:
                assert one.odom_T_body is not None
                file.append_odometry(OdometrySample(one.stamp_ns, one.odom_T_body))
        add_places(target, name, keyframes, ("none", 2), {"start_ns": keyframes[0].stamp_ns})
    out, back = target.sessions
    true = {one.stamp_ns: pose for one, pose in zip(outing.keyframes, outing.truth, strict=True)}
    closures = [one.closure for found in match_session(target, back) for one in found if one.closure is not None]
    assert len(closures) > half // 4
    for closure in closures:
        query, match = true[closure.query_stamp_ns - back.shift_ns], true[closure.match_stamp_ns - out.shift_ns]
        assert np.linalg.norm((relative(match, query) @ invert(closure.match_T_query))[:3, 3]) < 0.5
