"""A map that grows where a rover localises: what it saw becomes a session of the map.

The session is complete in a folder of its own, and its places are in the store, before `map.json` names it in one step.
Until then the map is what it was, whatever is killed; after that the same drive is not added again. Poses of the new
places come with the solution, which is repeated where it was cut off.
"""

from __future__ import annotations

import json
import os
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from shutil import rmtree
from typing import Any

from umf_ros.core.errors import UmfError, writing
from umf_ros.core.frames import Keyframe
from umf_ros.core.io import lock_file, write_table
from umf_ros.maps.joint_graph import solve
from umf_ros.maps.map_folder import BETWEEN, MapFolder, MapSession
from umf_ros.maps.mapping import add_places, open_places
from umf_ros.maps.outputs import write_results
from umf_ros.places.store import stored_identity
from umf_ros.runs.run_file import CLOSURES, COLUMNS, RunFile, StoredOdometry, closure_row
from umf_ros.runs.writer import PLACES

FEWEST = 2
"""Places of a session: one alone has no odometry to anything."""


def grow(map_folder: Path, run: Path) -> tuple[MapSession | None, dict[str, Any]]:
    """Add what a rover saw in a run that localised, since the run was added last, and solve the map.

    Args:
        map_folder: the map.
        run: run folder with the places that the rover saw; it may go on.

    Returns:
        The new session, None where there is nothing new, and the summary of the map.

    Raises:
        UmfError: either is missing or damaged, or another process adds to the map.
        OutputError: the map cannot be written.
    """
    if not (run / PLACES).is_file():
        raise UmfError(f"{run} holds no places: localization.update keeps them while a rover localises")
    lock = lock_file(map_folder / "map.json")
    try:
        target = MapFolder.open(map_folder)
        new = _new_places(target, run)
        session = _add(target, run, new) if len(new) >= FEWEST else None
        if session is None and _is_solved(target):
            return None, json.loads((target.path / "summary.json").read_text(encoding="utf-8"))
        return session, write_results(target, solve(target))
    finally:
        os.close(lock)


def _new_places(target: MapFolder, run: Path) -> list[Keyframe]:
    """Places of a run, with odometry, that are in no session of the map."""
    known = [one for one in target.sessions if one.recording["path"] == str(run.resolve())]
    with closing(open_places(run / PLACES)) as own:
        found = [own[row] for row in range(len(own))]
    return [
        one
        for one in found
        if one.odom_T_body is not None and not any(s.first_ns <= one.stamp_ns <= s.last_ns for s in known)
    ]


def _add(target: MapFolder, run: Path, new: list[Keyframe]) -> MapSession:
    """Write the run folder of a session from its places, and add these to the map."""
    name, stamps = target.free_name(run), [one.stamp_ns for one in new]
    folder = target.folder_of(name)
    with writing(folder):
        rmtree(folder, ignore_errors=True)  # of a process that was killed
        folder.mkdir(parents=True)
    with closing(RunFile(folder)) as file:
        for number, one in enumerate(new):
            assert one.odom_T_body is not None
            file.append_odometry(number, StoredOdometry(one.stamp_ns, one.odom_T_body))
    keyframes = [[one.stamp_ns, one.session, f"{one.path_length_m:.4f}"] for one in new]
    write_table(folder / "keyframes.csv", COLUMNS["keyframes"], keyframes)
    write_table(folder / "closures.csv", CLOSURES, [])
    shift_ns, places = target.shift_for(min(stamps)), set(stamps)
    with closing(RunFile(run, read_only=True)) as file:
        between = [one for one in file.closures() if one.query_stamp_ns in places]
    moved = [replace(one, query_stamp_ns=one.query_stamp_ns + shift_ns) for one in between]
    write_table(folder / BETWEEN, CLOSURES, [closure_row(one, float("nan")) for one in moved])
    about = {"path": str(run.resolve()), "start_ns": min(stamps), "end_ns": max(stamps), "messages": {}}
    return add_places(target, name, new, stored_identity(run / PLACES), about)


def _is_solved(target: MapFolder) -> bool:
    """Whether the results of a map are about all of its sessions."""
    try:
        summary = json.loads((target.path / "summary.json").read_text(encoding="utf-8"))
        return [one["name"] for one in summary["sessions"]] == [one.name for one in target.sessions]
    except (OSError, ValueError, KeyError, TypeError):
        return False
