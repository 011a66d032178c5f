"""A map that grows by a drive that localised in it: what is added, once, and what a kill at any moment leaves."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import make_keyframe
from maps_made import COVARIANCE, MadeSession, made_map, on_circle, relative

from umf_ros.core.config import Database, Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import LoopClosure
from umf_ros.map_poses import read_poses
from umf_ros.maps.joint_graph import solve
from umf_ros.maps.map_folder import MapFolder
from umf_ros.maps.mapping import grow, open_places
from umf_ros.maps.outputs import write_results
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import stored_identity, stored_sessions
from umf_ros.runs.run_file import RunFile, closure_row
from umf_ros.runs.writer import PLACES

IDENTITY = "made", 16
LATER_NS = 1_800_000_000 * 10**9
FIRST_M, LAST_M = 60, 110
"""The drive: it begins in the map and leaves it at metre 90."""
KILLS = 20


def keyframe(stamp_ns: int, pose: np.ndarray, metre: float, session: int = 0):
    made = make_keyframe(stamp_ns / 1e9, metre, seed=stamp_ns % 1000)
    return replace(made, stamp_ns=stamp_ns, odom_T_body=pose, session=session)


@pytest.fixture
def map_folder(tmp_path: Path) -> MapFolder:
    made = MadeSession("one", 0, 90)
    folder = made_map(tmp_path / "map", [made], Settings())
    with closing(PlaceDatabase(Database(path=str(folder.places)), *IDENTITY)) as places:
        for metre in range(91):
            places.add(keyframe(made.stamp(metre), on_circle(np.array([metre]))[0], metre))
    write_results(folder, solve(folder))
    return folder


def drive(run: Path, last_m: int = LAST_M, first_m: int = FIRST_M) -> None:
    """Leave the run of a rover that localises on the circle: places in its own odometry, closures with the map."""
    run.mkdir(exist_ok=True)
    start = on_circle(np.array([FIRST_M]))[0]
    with closing(PlaceDatabase(Database(path=str(run / PLACES)), *IDENTITY)) as seen, closing(RunFile(run)) as file:
        for metre in range(first_m, last_m + 1):
            pose, stamp = on_circle(np.array([metre]))[0], LATER_NS + metre * 10**9
            seen.add(keyframe(stamp, relative(start, pose), metre))
            if metre <= 90 and metre % 5 == 0:
                match = MadeSession("one", 0, 90).stamp(metre)
                closure = LoopClosure(stamp, match, np.eye(4), COVARIANCE, 0.99)
                with file.writing():
                    file.append("closures", [closure_row(closure, 0.9)])


def stamps_in(folder: MapFolder) -> list[int]:
    with closing(open_places(folder.places)) as places:
        return [places[row].stamp_ns for row in range(len(places))]


def test_a_drive_becomes_a_session_with_poses_in_the_map(map_folder: MapFolder, tmp_path: Path) -> None:
    drive(tmp_path / "run")
    session, summary = grow(map_folder.path, tmp_path / "run")
    assert session is not None and (session.name, session.places) == ("run", LAST_M - FIRST_M + 1)
    assert summary["joined"] == 2 and summary["closures_between"]["accepted"] == 7
    found, known = read_poses(map_folder.path).at(np.array([LATER_NS + m * 10**9 for m in range(FIRST_M, LAST_M + 1)]))
    assert known.all()
    # at the places of the session before, and further on where the map had not been
    old, _ = read_poses(map_folder.path).at(np.array([MadeSession("one", 0, 90).stamp(m) for m in range(FIRST_M, 91)]))
    assert np.linalg.norm(found[: len(old), :3, 3] - old[:, :3, 3], axis=1).max() < 0.1
    truth = on_circle(np.arange(FIRST_M, LAST_M + 1))
    assert np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 1.5


def test_what_is_added_is_not_added_again_and_a_drive_that_goes_on_is(map_folder: MapFolder, tmp_path: Path) -> None:
    run = tmp_path / "run"
    drive(run, 80)
    first, _ = grow(map_folder.path, run)  # at ~/save
    again, summary = grow(map_folder.path, run)
    assert first is not None and again is None and len(summary["sessions"]) == 2
    drive(run, LAST_M, 81)
    rest, summary = grow(map_folder.path, run)  # at the end
    assert rest is not None and rest.places == LAST_M - 80 and len(summary["sessions"]) == 3
    stamps = stamps_in(map_folder)
    assert len(stamps) == len(set(stamps)) == 91 + LAST_M - FIRST_M + 1


def test_what_is_no_such_run_is_told_and_changes_nothing(map_folder: MapFolder, tmp_path: Path) -> None:
    with pytest.raises(UmfError, match=r"localization\.update keeps them"):
        grow(map_folder.path, tmp_path / "nowhere")
    drive(tmp_path / "run")
    with pytest.raises(UmfError, match="is not a map"):
        grow(tmp_path / "run", tmp_path / "run")
    assert len(MapFolder.open(map_folder.path).sessions) == 1


def test_a_kill_at_any_moment_leaves_the_old_map_or_the_new_one(map_folder: MapFolder, tmp_path: Path) -> None:
    run, spare, fork = tmp_path / "run", tmp_path / "spare", multiprocessing.get_context("fork")
    drive(run)
    shutil.copytree(map_folder.path, spare)
    began = time.monotonic()
    whole = fork.Process(target=grow, args=(spare, run))
    whole.start()
    whole.join()
    lasts_s, after = time.monotonic() - began, read_poses(spare)
    assert whole.exitcode == 0
    before = read_poses(map_folder.path)
    rng, seen = np.random.default_rng(0), set()
    for moment in rng.uniform(0, lasts_s, KILLS):
        shutil.rmtree(spare)
        shutil.copytree(map_folder.path, spare)
        process = fork.Process(target=grow, args=(spare, run))
        process.start()
        time.sleep(moment)
        os.kill(process.pid or 0, signal.SIGKILL)
        process.join()
        # a rover can localise in it at once, in the old map or in the new one
        folder, poses = MapFolder.open(spare), read_poses(spare)
        seen.add((len(folder.sessions), len(poses.stamps_ns) == len(after.stamps_ns)))
        assert len(folder.sessions) in (1, 2) and len(poses.stamps_ns) in (len(before.stamps_ns), len(after.stamps_ns))
        with closing(PlaceDatabase.of_map(spare, *stored_identity(spare / "places.sqlite"))) as places:
            assert places.listed == range(len(folder.sessions)) and places.next_session >= len(folder.sessions)
        # and the drive is added, once
        grow(spare, run)
        folder = MapFolder.open(spare)
        stamps = stamps_in(folder)
        assert len(folder.sessions) == 2 and len(stamps) == len(set(stamps)) == 91 + LAST_M - FIRST_M + 1
        assert [one.number for one in stored_sessions(spare / "places.sqlite")] == [0, 1]
        np.testing.assert_allclose(read_poses(spare).poses, after.poses, atol=1e-6)
    assert (1, False) in seen
