import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from maps_made import MadeSession, made_map, on_circle, tie
from sources import rows_of

from umf_ros.absolute.measurement import AbsoluteMeasurement, Aid
from umf_ros.core.config import Settings
from umf_ros.core.geometry import from_enu, make_pose, to_enu, transform
from umf_ros.map_poses import read_poses
from umf_ros.maps.joint_graph import JointMap, solve
from umf_ros.maps.outputs import draw_map, sentence, summarise, write_results
from umf_ros.pose_graph.closures import State
from umf_ros.runs.run_file import RunFile
from umf_ros.runs.truth import absolute_trajectory_error

DAY_NS = 86_400 * 10**9
PLACES = (22, 34, 46)


def two() -> tuple[MadeSession, MadeSession]:
    first, second = MadeSession("first", 0, 60), MadeSession("second", 10, 80)
    second.between = [tie((0, DAY_NS), first, second, metre) for metre in PLACES]
    return first, second


def error_m(joint: JointMap, made: list[MadeSession]) -> float:
    found = np.concatenate([one.poses[:, :3, 3] for one in joint.sessions])
    return absolute_trajectory_error(found, np.concatenate([one.truth[:, :3, 3] for one in made]))


def test_sessions_that_start_anywhere_share_one_frame(tmp_path: Path) -> None:
    made = two()
    joint = solve(made_map(tmp_path / "map", list(made)))
    assert [one.joined for one in joint.sessions] == [True, True]
    assert [v.state for v in joint.between] == [State.ACCEPTED] * 3 and not joint.within
    assert error_m(joint, list(made)) < 0.5
    # the frame is the first session's odometry: it starts at the origin
    assert np.allclose(joint.sessions[0].poses[0], np.eye(4), atol=1e-6)


def test_without_closures_only_one_of_them_is_in_the_map(tmp_path: Path) -> None:
    first, second = two()
    second.between = []
    joint = solve(made_map(tmp_path / "map", [first, second]))
    # the longer one is the map
    assert [one.joined for one in joint.sessions] == [False, True]
    assert len(joint.sessions[0].stamps) == 0


@pytest.mark.parametrize("wrong", [(20,), (20, 23, 26, 29)])
def test_wrong_closures_between_sessions_are_rejected(tmp_path: Path, wrong: tuple[int, ...]) -> None:
    """One, or many of one place that repeats: the place is 25 m further on in truth."""
    first, second = two()
    second.between += [tie((0, DAY_NS), first, second, metre + 25, metre) for metre in wrong]
    joint = solve(made_map(tmp_path / "map", [first, second]))
    states = [verdict.state for verdict in sorted(joint.between, key=lambda v: v.closure.query_stamp_ns)]
    assert sum(state is State.ACCEPTED for state in states) == 3
    assert error_m(joint, [first, second]) < 0.5


def test_wrong_closures_alone_join_nothing(tmp_path: Path) -> None:
    first, second = two()
    second.between = [tie((0, DAY_NS), first, second, metre + 25, metre) for metre in (20, 22, 24)]
    joint = solve(made_map(tmp_path / "map", [first, second]))
    assert not joint.accepted_between() and sum(one.joined for one in joint.sessions) == 1


def test_closures_within_are_moved_to_the_maps_clock(tmp_path: Path) -> None:
    from umf_ros.core.io import write_table
    from umf_ros.runs.run_file import CLOSURES, closure_row

    made = [MadeSession("first", 0, 60), MadeSession("round", 0, 160)]
    folder = made_map(tmp_path / "map", made)
    own = [tie((0, 0), made[1], replace(made[1], first_m=-100), metre) for metre in (5, 20, 35, 50)]
    rows = [
        closure_row(replace(c, query_stamp_ns=made[1].stamp(m + 100)), 0.9)
        for c, m in zip(own, (5, 20, 35, 50), strict=True)
    ]
    write_table(folder.folder_of("round") / "closures.csv", CLOSURES, rows)
    joint = solve(folder)
    assert len(joint.within) == 4 and {v.state for v in joint.within} == {State.ACCEPTED}


def test_results_are_listed_by_session(tmp_path: Path) -> None:
    made = two()
    folder = made_map(tmp_path / "map", list(made))
    joint = solve(folder)
    summary = write_results(folder, joint)
    assert json.loads((folder.path / "summary.json").read_text()) == summary
    assert summary["joined"] == 2 and summary["closures_between"]["accepted"] == 3
    counts = {f"closures_{where}": {"found": 9, "accepted": 6, "pending": 3} for where in ("within", "between")}
    assert sentence({"sessions": [{}], **counts}) == "one session; its closures: 9 found, 6 accepted, 3 pending"
    assert [one["graph_sessions"] for one in summary["sessions"]] == [[0], [1]]
    sessions = [row["session"] for row in rows_of(folder.path / "graph.csv")]
    assert set(sessions) == {"0", "1"}
    vertices = (folder.path / "graph.g2o").read_text().count("VERTEX")
    assert vertices == len(sessions)
    poses = read_poses(folder.path)
    assert len(poses) == 61 + 71 and poses.stamps_ns[-1] == made[1].stamp(80) + DAY_NS
    draw_map(tmp_path / "without.png", replace(joint, between=[]))
    standing = [replace(one, poses=np.tile(make_pose(np.eye(3), [0.3, 0, 0]), (2, 1, 1))) for one in joint.sessions]
    draw_map(tmp_path / "standing.png", replace(joint, sessions=standing, within=[], between=[]))
    assert (folder.path / "trajectories.png").read_bytes() != (tmp_path / "without.png").read_bytes()  # draws closures
    page = (folder.path / "report.html").read_text()
    assert "2 of 2 sessions in one frame" in page and page.count("data:image/png") == 1  # no scans, no ground
    assert "<td>second</td>" in page
    lines = (folder.path / "trajectories" / "second.tum").read_text().splitlines()
    # in the recording's own clock
    assert len(lines) == 71 and lines[0].startswith(f"{made[1].stamp(10) // 10**9}.")


def test_the_largest_part_is_the_map_wherever_the_first_session_is(tmp_path: Path) -> None:
    alone, first, second = MadeSession("alone", 0, 15), *two()
    second.between = [tie((DAY_NS, 2 * DAY_NS), first, second, metre) for metre in PLACES]
    joint = solve(made_map(tmp_path / "map", [alone, first, second]))
    assert [one.joined for one in joint.sessions] == [False, True, True]
    assert summarise(joint)["sessions"][0]["length_m"] == 15  # driven, though not in the map
    there = transform(np.linalg.inv(on_circle(np.array([0]))[0]), first.truth[:, :3, 3])
    assert np.abs(joint.sessions[1].poses[:, :3, 3] - there).max() < 2


def test_fixes_of_a_recording_put_the_map_on_earth(tmp_path: Path) -> None:
    made, origin = two(), np.array([37.75, 14.99, 1800.0])
    folder = made_map(tmp_path / "map", list(made), Settings(pose_graph={"origin": "37.75 14.99 1800"}))
    turn = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [30.0, 20.0, 2.0])
    for one in made:
        fixes = from_enu(transform(turn, one.truth[:, :3, 3]), origin)
        with closing(RunFile(folder.folder_of(one.name))) as file:
            for row, fix in enumerate(fixes):
                stamp = one.stamp(one.first_m + row)
                file.append_absolute(AbsoluteMeasurement(Aid.GNSS, stamp, fix, 0.01 * np.eye(3), np.zeros(3)))
    joint = solve(folder)
    assert joint.world is not None
    write_results(folder, joint)
    lines = {
        one["properties"]["name"]: np.array(one["geometry"]["coordinates"])
        for one in json.loads((folder.path / "trajectories.geojson").read_text())["features"]
    }
    for one in made:
        found = to_enu(lines[one.name][:, [1, 0, 2]], origin)
        assert np.linalg.norm(found - transform(turn, one.truth[:, :3, 3]), axis=1).max() < 1.0
