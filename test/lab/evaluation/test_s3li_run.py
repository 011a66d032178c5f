from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from etna import GPS_MINUS_UTC_NS, entries, write_pos
from recordings import START_NS, write_mcap
from scipy.spatial.transform import Rotation
from spread_tasks import die, refuse, square
from support.s3li_disorders import verdict
from typer.testing import CliRunner

from umf_ros.cli import umf
from umf_ros.core.config import Loop
from umf_ros.core.errors import UmfError
from umf_ros.core.geometry import heading
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.lab.datasets.s3li import headed
from umf_ros.lab.datasets.s3li_folder import S3liFolder, S3liSequence
from umf_ros.lab.datasets.simulated import poses_of
from umf_ros.lab.evaluation.s3li_run import (
    S3liRun,
    in_own_process,
    latex,
    pooled,
    precision_of_pairs,
    protocol_table,
    recall_of_places,
    replay_sequence,
    sequence_table,
    wilson,
)
from umf_ros.lab.simulation.twin_files import overlapping_pairs, view_overlap
from umf_ros.runs.truth import clock_offset

SECOND = 10**9
LIKE = (0, 1, 2, 3, 4, 0, 3, 2, 3, 4)
"""Which of the first five each of ten frames looks like."""
DESCRIPTORS = np.eye(5)[list(LIKE)]


def at(x_m: list[float], yaw_deg: list[float]) -> np.ndarray:
    turns = np.tile(np.eye(3), (len(x_m), 1, 1))
    angles = np.radians(yaw_deg)
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0], turns[:, 0, 1] = np.sin(angles), -np.sin(angles)
    return poses_of(turns, np.column_stack([x_m, np.zeros((len(x_m), 2))]))


def test_recall_of_the_thesis_on_ten_frames() -> None:
    """Frames 5, 6 and 7 are back at 0, 1 and 2; 8 is turned by 40 deg, 9 is at a new place: 2 of 3 are found."""
    poses = at([0, 30, 60, 90, 120, 5, 35, 65, 95, 150], [0, 0, 0, 0, 0, 10, 0, -20, 40, 0])
    stamps = np.arange(10) * 10 * SECOND
    assert recall_of_places(stamps, poses, 30.0 * np.arange(10), DESCRIPTORS, Loop()) == (2, 3)
    # within 12 m, not at it; within 30 deg, not at it
    poses[5, 0, 3] = 12.5
    assert recall_of_places(stamps, poses, 30.0 * np.arange(10), DESCRIPTORS, Loop()) == (1, 2)


def test_recall_knows_the_gaps_of_a_loop_closure() -> None:
    poses = at([0.0] * 10, [0.0] * 10)
    assert recall_of_places(np.arange(10) * SECOND, poses, np.arange(10.0), DESCRIPTORS, Loop()) == (0, 0)


def test_precision_of_mprf_on_ten_images() -> None:
    """0 and 5 find each other, 7 finds 2, 6 finds 3 in place of 1; the match of 8 is 60 s away and does not count."""
    keys = [f"crater/img{number}.png" for number in range(10)]
    pairs = [(5, 0, 0.8), (0, 5, 0.8), (6, 1, 0.7), (7, 2, 0.6), (8, 7, 0.9)]
    named = [(f"/somewhere/crater/images/img{i}.png", f"/else/crater/images/img{j}.png", o) for i, j, o in pairs]
    right, answerable = precision_of_pairs(keys, 60.0 * np.arange(10), DESCRIPTORS, named)
    assert np.flatnonzero(answerable).tolist() == [0, 5, 6, 7]
    assert np.flatnonzero(right).tolist() == [0, 5, 7]
    record = {"precision1_hits": 3, "precision1_queries": 4, "samples": 10}
    rows = {row[0]: row for row in protocol_table({"s3li_crater": record | {"dataset": "s3li-etna"}})[1]}
    assert rows["Etna: MPRF P@1"][1:] == ["75.0", "30.1 to 95.4", "3 of 4", "75.7"]
    assert rows["Etna: MPRF P@1, all queries"][1] == "30.0"


def test_ground_that_two_views_share() -> None:
    """10 m behind, of the 391 m2 between 3 and 20 m that a right angle sees, 91 m2 are seen too."""
    origin = np.zeros(2)
    assert view_overlap(origin, 0.7, origin, 0.7, 90.0) == pytest.approx(1.0, abs=1e-4)
    behind = -10 * np.array([np.cos(0.7), np.sin(0.7)])
    assert view_overlap(origin, 0.7, behind, 0.7, 90.0) == pytest.approx(91 / 391, abs=1e-3)
    assert view_overlap(origin, 0.0, origin, np.radians(46), 90.0) == 0.0
    found = overlapping_pairs(np.array([0.0, 10.0, 40.0]), np.zeros((3, 2)), np.zeros(3), 60.0)
    assert [pair[:2] for pair in found] == [(0, 2), (1, 2), (2, 0), (2, 1)]


@pytest.mark.parametrize(
    ("hits", "count", "low", "high"), [(0, 0, 0, 1), (0, 10, 0, 0.2775), (10, 10, 0.7225, 1), (5, 10, 0.2366, 0.7634)]
)
def test_intervals_of_wilson(hits: int, count: int, low: float, high: float) -> None:
    assert wilson(hits, count) == pytest.approx((low, high), abs=1e-4)


def drive(seconds: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses ten times a second along a winding way, faster and slower."""
    t = np.arange(seconds * 10) / 10
    way = t + 2 * np.sin(t / 7)
    xy = np.column_stack([way, 8 * np.sin(way / 9) + 3 * np.sin(way / 4)])
    along = np.gradient(xy, axis=0)
    yaw = np.arctan2(along[:, 1], along[:, 0])
    poses = at(xy[:, 0].tolist(), np.degrees(yaw).tolist())
    poses[:, 1, 3] = xy[:, 1]
    return (t * SECOND).astype(np.int64) + 10**18, poses


def positions(stamps: np.ndarray, poses: np.ndarray, turn_deg: float = 0.0) -> Trajectory:
    angle = np.radians(turn_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    places = np.tile(np.eye(4), (len(poses), 1, 1))
    places[:, :3, 3] = poses[:, :3, 3] @ turn.T
    return Trajectory(stamps, places, has_orientation=False)


@pytest.mark.parametrize("late_s", [0, 18, -12])
def test_a_clock_of_the_satellites_is_told_by_the_way(late_s: int) -> None:
    stamps, poses = drive(160)
    truth = positions(stamps + late_s * SECOND, poses, turn_deg=70)
    assert clock_offset(Trajectory(stamps, poses), truth) == pytest.approx(late_s, abs=0.51)


def test_positions_that_are_in_utc_are_noticed(tmp_path: Path) -> None:
    stamps, poses = drive(160)
    recording = write_mcap(tmp_path / "s3li_loops.mcap", entries(1.0, size=(688, 512)))
    write_tum(tmp_path / "odometry.tum", Trajectory(stamps - stamps[0] + START_NS, poses))
    for ahead_ns, noticed in ((GPS_MINUS_UTC_NS, False), (0, True)):
        truth = write_pos(tmp_path / "global.pos", 159, way=lambda s: poses[round(10 * s)], ahead_ns=ahead_ns)
        one = S3liSequence("s3li_loops", recording, odometry=tmp_path / "odometry.tum", truth=[truth])
        found = replay_sequence(one, tmp_path / "run")
        assert any("18.0 s earlier" in line for line in found["warnings"]) == noticed, found["warnings"]
        assert (verdict("gps_time", found, {}) == "noticed") == noticed


def test_headings_come_from_the_odometry_or_else_from_the_course() -> None:
    stamps, poses = drive(100)
    truth = positions(stamps, poses, turn_deg=30)
    asked = stamps[50:-50:10]
    expected = np.degrees(heading(poses[50:-50:10])) + 30
    found, known = headed(truth, asked, Trajectory(stamps, poses))
    assert known.all() and np.degrees(heading(found)) == pytest.approx(expected, abs=0.1)
    found, known = headed(truth, asked, None)
    assert np.degrees(heading(found)) == pytest.approx(expected, abs=12)
    assert not headed(truth, asked + 1000 * SECOND, None)[1].any()


def test_headings_do_not_drift_with_the_odometry() -> None:
    stamps, poses = drive(900)
    truth = positions(stamps, poses)
    way = np.r_[0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))]
    drift = Rotation.from_euler("z", np.interp(way, [0, way[-1]], [0, 140])[:, None], degrees=True).as_matrix()
    steps = np.einsum("nij,nj->ni", drift[1:], np.diff(poses[:, :3, 3], axis=0))
    drifted = poses.copy()
    drifted[:, :3, :3] = drift @ poses[:, :3, :3]
    drifted[1:, :3, 3] = poses[0, :3, 3] + np.cumsum(steps, axis=0)
    found, _ = headed(truth, stamps, Trajectory(stamps, drifted))
    off = (np.degrees(heading(found) - heading(poses)) + 180) % 360 - 180
    assert np.abs(off).max() < 5 and np.median(np.abs(off)) < 1


def test_odometry_that_fits_nowhere_leaves_the_course() -> None:
    stamps, poses = drive(100)
    truth = positions(stamps, poses)
    upright = np.eye(4)
    upright[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    of_another_day = Trajectory(stamps + 10**14, poses)
    for odometry in (Trajectory(stamps, upright @ poses), of_another_day):
        assert np.array_equal(headed(truth, stamps, odometry)[0], headed(truth, stamps, None)[0])


RECORDS = {
    "s3li_loops": {
        **{"dataset": "s3li-etna", "status": "done", "recall1": 0.5, "recall1_hits": 5, "recall1_queries": 10},
        **{"closures_true": 8, "closures_judged": 8, "closures_false": 0, "closures_overlapping": 6},
        **{"revisits": 10, "revisits_closed": 9, "ate_odometry_m": 2.0, "ate_optimized_m": 1.0, "minutes": 0.5},
    },
    "moon_lake": {"dataset": "s3li-vulcano", "status": "failed: cut short", "warnings": []},
}


def test_figures_of_all_are_pooled_and_what_failed_counts_for_nothing() -> None:
    total = pooled(list(RECORDS.values()))
    assert total["recall1"] == 0.5 and total["closures_true"] == 8 and total["ate_optimized_m"] == 1.0
    assert total["precision1"] is None and total["pose_error_m"] is None
    rows = {row[0]: row[1:] for row in protocol_table(RECORDS)[1]}
    assert rows["Etna's test split: UMF R@1"][0] == "50.0" and rows["Etna: UMF R@1"][3] == "73.5 (reranked 75.3)"
    assert rows["Vulcano: revisits closed"] == ["-", "-", "0 of 0", "-"]
    assert rows["all: ate odometry, m"][:2] == ["2.00", "2.00 to 2.00"]
    assert [row[-1] for row in sequence_table(RECORDS)[1]] == ["done", "failed"]


def test_a_table_for_latex() -> None:
    text = latex((["a_b", "%"], [["x & y", "1"]]))
    assert text.splitlines()[0] == r"\begin{tabular}{lr}"
    assert r"a\_b & \% \\" in text and r"x \& y & 1 \\" in text


def test_damaged_pairs_cost_their_protocol_alone(tmp_path: Path) -> None:
    (tmp_path / "etna_pairs.pkl").write_bytes(b"cut")
    loops = S3liSequence("s3li_loops", pickle=tmp_path / "s3li_loops.pkl")
    run = S3liRun(S3liFolder(tmp_path, [loops], {"s3li-etna": tmp_path / "etna_pairs.pkl"}, []), tmp_path)
    run.replay(loops, lambda done: None)
    assert run.retrieve("s3li-etna", lambda name, done: None) == []
    assert len(run.faults) == 1 and "etna_pairs.pkl" in run.faults[0]
    assert run.records["s3li_loops"]["status"] == "not replayed"
    assert "left out" in run.retrieve("s3li-vulcano", lambda name, done: None)[0] and len(run.faults) == 1


@pytest.mark.slow
def test_a_cut_bag_fails_in_one_line_and_the_table_is_printed(tmp_path: Path) -> None:
    (tmp_path / "Bagfiles").mkdir()
    (tmp_path / "Bagfiles/s3li_loops.bag").write_bytes(b"#ROSBAG V2.0\ncut")
    figures = tmp_path / "figures.json"
    result = CliRunner().invoke(umf(), ["s3li", str(tmp_path), "--out", str(tmp_path / "out"), "--json", str(figures)])
    assert result.exit_code == 1 and "s3li_loops: no trajectory below Eval" in result.output
    record = json.loads(figures.read_text())["sequences"]["s3li_loops"]
    assert record["status"].startswith("failed: ") and "s3li_loops.bag" in record["status"]
    assert r"\toprule" in (tmp_path / "out/s3li.tex").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("work", "task", "text"),
    [(refuse, (Path(), 3), "task 3 cannot be done"), (square, 3, "internal error"), (die, None, "its process died")],
)
def test_a_sequence_fails_alone(work: Callable[..., None], task: object, text: str) -> None:
    with pytest.raises(UmfError, match=text) as error:
        in_own_process(work, task, report=lambda done: None)
    assert "\n" not in str(error.value)
