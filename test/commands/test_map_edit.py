"""`umf map edit`: closures of a map decided by hand, undone by name."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
from command_line import only_line, umf
from maps_made import MadeSession, made_map, tie
from sources import rows_of

from umf_ros.core.errors import UmfError
from umf_ros.map_poses import POSES, read_poses
from umf_ros.maps.joint_graph import solve
from umf_ros.maps.map_folder import MapFolder
from umf_ros.maps.outputs import write_results

DAY_NS = 86_400 * 10**9


@pytest.fixture
def folder(tmp_path: Path) -> MapFolder:
    """Two sessions, right closures at three places and a wrong one."""
    first, second = MadeSession("first", 0, 60), MadeSession("second", 10, 80)
    second.between = [tie((0, DAY_NS), first, second, metre) for metre in (22, 34, 46)]
    second.between.append(tie((0, DAY_NS), first, second, 55, at_m=20))
    made = made_map(tmp_path / "map", [first, second])
    write_results(made, solve(made))
    return made


def decided(folder: MapFolder) -> dict[tuple[str, str], tuple[str, str]]:
    rows = rows_of(folder.path / "graph_verdicts.csv")
    return {(row["match_stamp_ns"], row["query_stamp_ns"]): (row["verdict"], row["reason"]) for row in rows}


def test_edits_are_kept_through_every_solution_and_undone_by_name(folder: MapFolder) -> None:
    before = decided(folder)
    right = [pair for pair, (verdict, _) in before.items() if verdict == "accepted"]
    wrong = next(pair for pair, (verdict, _) in before.items() if verdict != "accepted")
    assert len(right) == 3
    ended = umf("map", "edit", folder.path, "--reject", *right[0], "--accept", *wrong)
    assert ended.status == 0, ended.text
    assert f"{right[0][0]} {right[0][1]}: rejected by hand" in ended.out
    assert f"{wrong[0]} {wrong[1]}: accepted by hand" in ended.out
    after = decided(folder)
    assert after[right[0]] == ("rejected", "revoked by hand") and after[wrong] == ("accepted", "accepted by hand")
    write_results(folder, solve(MapFolder.open(folder.path)))  # as the next recording does
    assert decided(folder) == after
    assert umf("map", "edit", folder.path, "--undo", *wrong).status == 0
    assert umf("map", "edit", folder.path, "--undo", *right[0]).status == 0
    assert decided(folder) == before


def test_what_is_no_closure_of_the_map_is_one_line_and_changes_nothing(folder: MapFolder) -> None:
    before = decided(folder)
    assert only_line(umf("map", "edit", folder.path, "--reject", 1, 2)) == "no closure between keyframes 1 and 2"
    told = only_line(umf("map", "edit", folder.path, "--undo", 1, 2))
    assert told == "--undo 1 2: nothing was decided about that closure by hand"
    assert not (folder.path / "edits.json").exists() and decided(folder) == before
    (folder.path / "edits.json").write_text(json.dumps([{"match": 1}]))
    assert "edits.json is damaged: " in only_line(umf("map", "edit", folder.path))
    assert "is not a map" in only_line(umf("map", "edit", folder.path / "nowhere"))


def test_a_map_without_poses_names_the_command_that_solves_it(folder: MapFolder) -> None:
    (folder.path / POSES).unlink()
    with pytest.raises(UmfError) as told:
        read_poses(folder.path)
    program, *words = shlex.split(str(told.value).partition("solve the map with ")[2])
    assert program == "umf" and umf(*words).status == 0
    assert len(read_poses(folder.path))
