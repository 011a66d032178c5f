"""The tables of a run: what is written is what is read, whatever happens in between."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.errors import OutputError, UmfError
from umf_ros.core.frames import Candidate, LoopClosure
from umf_ros.core.geometry import make_pose
from umf_ros.pose_graph.closures import VERDICT_COLUMNS as VERDICTS
from umf_ros.pose_graph.closures import ClosureReason, State
from umf_ros.runs.run_file import (
    CLOSURES,
    COLUMNS,
    candidate_row,
    closure_row,
    inlier_rows,
    parse_candidate,
    read_closures,
    read_inliers,
    read_table,
    read_verdicts,
    write_table,
)
from umf_ros.verification import Hypothesis, RejectReason
from umf_ros.verification.hypothesis import SCAN

QUERY_NS, MATCH_NS = 1_667_000_100_123_456_789, 1_667_000_000_000_000_001


def closure(seed: int = 0, probability: float = 0.97) -> LoopClosure:
    rng = np.random.default_rng(seed)
    pose = make_pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 9, 3))
    root = rng.standard_normal((6, 6))
    return LoopClosure(QUERY_NS + seed, MATCH_NS + seed, pose, root @ root.T + np.eye(6), probability)


def written(path: Path, rows: list[list[object]], columns: list[str] = CLOSURES) -> Path:
    write_table(path, columns, rows)
    return path


def test_a_row_of_closures_by_hand(tmp_path: Path) -> None:
    quarter = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1.5, -0.25, 0])
    found = LoopClosure(QUERY_NS, MATCH_NS, quarter, np.diag([4, 1, 0.25, 0.01, 0.04, 0.09]), 0.97)
    with written(tmp_path / "closures.csv", [closure_row(found, 0.8125)]).open() as file:
        (row,) = csv.DictReader(file)
    assert (row["query_stamp_ns"], row["match_stamp_ns"]) == (str(QUERY_NS), str(MATCH_NS))
    assert [row[name] for name in ("x_m", "y_m", "z_m")] == ["1.5", "-0.25", "0"]
    assert [float(row[name]) for name in ("qx", "qy", "qz", "qw")] == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])
    sigmas = [float(row[f"sigma_{name}"]) for name in ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")]
    assert sigmas == pytest.approx([2, 1, 0.5, 0.1, 0.2, 0.3])
    assert (row["probability"], row["similarity"]) == ("0.97", "0.8125")


def test_closures_come_back_as_they_were(tmp_path: Path) -> None:
    put = [closure(seed, 0.9 + 0.01 * seed) for seed in range(8)]
    got = read_closures(written(tmp_path / "closures.csv", [closure_row(one, 0.5) for one in put]))
    assert [(one.query_stamp_ns, one.match_stamp_ns) for one in got] == [
        (one.query_stamp_ns, one.match_stamp_ns) for one in put
    ]
    for ours, theirs in zip(got, put, strict=True):
        np.testing.assert_allclose(ours.match_T_query, theirs.match_T_query, atol=1e-7)
        np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-7)
        assert ours.probability == pytest.approx(theirs.probability)


def test_a_table_of_an_older_version_has_one_sigma_per_axis(tmp_path: Path) -> None:
    put = closure()
    (got,) = read_closures(written(tmp_path / "closures.csv", [closure_row(put, 0.5)[:-1]], CLOSURES[:-1]))
    np.testing.assert_allclose(got.covariance, np.diag(np.diag(put.covariance)), rtol=1e-7)


def test_a_table_without_rows_holds_no_closure(tmp_path: Path) -> None:
    assert read_closures(written(tmp_path / "closures.csv", [])) == []


def test_figures_of_a_reason_may_hold_anything(tmp_path: Path) -> None:
    detail = 'turned too far, "31 deg"\n; gave up'
    measurements = {"similarity": 1 / 3, "inliers_image": float("inf")}
    put = Hypothesis(
        QUERY_NS, Candidate(3, MATCH_NS, 0.123456789), measurements, RejectReason.TURNED, detail, probability=2 / 3
    )
    path = written(tmp_path / "candidates.csv", [candidate_row(put)], COLUMNS["candidates"])
    (row,) = read_table(path, dict)
    assert (row["reason"], row["detail"]) == (RejectReason.TURNED.value, detail) and row["similarity"] == "0.123457"
    known = {"similarity": 0.333333, "inliers_image": float("inf"), "probability": 0.666667}
    assert json.loads(row["numbers"]) == known


@pytest.mark.parametrize("reason", [None, *RejectReason])
def test_a_candidate_reads_back_as_it_was_written(tmp_path: Path, reason: RejectReason | None) -> None:
    measurements = {"similarity": 0.5, "noise_m": 0.25, "unexplained": float("nan"), "rival_far": 0.125}
    put = Hypothesis(QUERY_NS, Candidate(3, MATCH_NS, 0.5), measurements, reason, "0.5 m", probability=0.75)
    path = written(tmp_path / "candidates.csv", [candidate_row(put)], COLUMNS["candidates"])
    (got,) = read_table(path, parse_candidate)
    assert (got.endpoints, got.reason, got.probability) == (put.endpoints, reason, 0.75)
    assert got.numbers == pytest.approx(put.numbers, nan_ok=True) and got.kind == SCAN
    assert reason is None or got.outcome == put.outcome


def test_a_reason_of_another_version_is_kept_as_text(tmp_path: Path) -> None:
    row = [QUERY_NS, MATCH_NS, 0.5, "a riddle", "{}"]
    columns = ["query_stamp_ns", "match_stamp_ns", "similarity", "reason", "numbers"]
    (got,) = read_table(written(tmp_path / "candidates.csv", [row], columns), parse_candidate)
    assert (got.reason, got.detail) == (RejectReason.UNKNOWN, "a riddle")


def test_inliers_are_pixels_to_a_tenth(tmp_path: Path) -> None:
    pixels = np.array([[1.26, 2, 3, 687.98], [0, 0, 0, 0]], np.float32)
    put = Hypothesis(
        QUERY_NS, Candidate(0, MATCH_NS, 0.5), {"similarity": 0.5}, closure=closure(), inlier_pixels=pixels
    )
    (found,) = read_inliers(written(tmp_path / "inliers.csv", inlier_rows(put), COLUMNS["inliers"])).items()
    assert found[0] == (QUERY_NS, MATCH_NS) and found[1].tolist() == [[1.3, 2, 3, 688.0], [0, 0, 0, 0]]


def test_a_folder_that_is_gone_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"cannot write .*a\.csv: No such file or directory$"):
        write_table(tmp_path / "gone" / "a.csv", ["a"], [])


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("query_stamp_ns,match_stamp_ns\n1,2\n", 2),
        (",".join(CLOSURES) + "\n" + ",".join(["1"] * 17) + "\n" + "1,2,3\n", 3),
        (",".join(CLOSURES) + "\n" + ",".join(["one"] * 17) + "\n", 2),
        (",".join(CLOSURES) + "\n" + ",".join(["1"] * 2 + ["0"] * 15) + "\n", 2),  # no unit quaternion
    ],
)
def test_the_line_that_is_damaged_is_named(tmp_path: Path, content: str, line: int) -> None:
    path = tmp_path / "closures.csv"
    path.write_text(content)
    if line == 3:
        path.write_text(content.replace(",".join(["1"] * 17), ",".join(["1"] * 2 + ["0"] * 6 + ["1"] * 9)))
    with pytest.raises(UmfError, match=rf"closures\.csv, line {line}: not a row of this table") as caught:
        read_closures(path)
    assert "\n" not in str(caught.value)


def test_a_table_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(UmfError, match=r"cannot read .*closures\.csv: No such file"):
        read_closures(tmp_path / "closures.csv")


def test_verdicts_are_read_by_the_endpoints_of_the_closures(tmp_path: Path) -> None:
    row = [MATCH_NS, QUERY_NS, State.PENDING, ClosureReason.UNSURE, 1.5, 0.2]
    path = written(tmp_path / "graph_verdicts.csv", [row], VERDICTS)
    (found,) = read_verdicts(path, [closure()]).values()
    assert (found.state, found.reason, found.residual) == (State.PENDING, ClosureReason.UNSURE, 1.5)
    assert read_verdicts(path, []) == {} and read_verdicts(tmp_path / "none.csv", [closure()]) == {}
