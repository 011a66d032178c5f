"""Exports of the pose graph: results and graph files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from graph_worlds import LAP, SETTINGS, closing, content_of, driven_file, feed_odometry, lap_pairs, rms, two_laps
from sources import rows_of

from umf_ros.bags.trajectories import read_tum
from umf_ros.core.errors import OutputError
from umf_ros.core.geometry import make_pose
from umf_ros.lab.datasets.g2o import Edge, read_g2o, write_plane
from umf_ros.lab.datasets.graph_recording import (
    PERIOD_NS,
    as_recording,
    drive,
    write_optimised,
    write_verdicts_by_vertex,
)
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import VERDICT_COLUMNS

WORLD = closing(closing(two_laps(), lap_pairs(*range(0, 90, 6)), noise=1.0), lap_pairs(47), (5.0, 5.0, 0))


@pytest.fixture(scope="module")
def finished() -> PoseGraph:
    return driven_file(as_recording(content_of(WORLD)))


def test_results_hold_both_trajectories_for_evaluation(finished: PoseGraph, tmp_path: Path) -> None:
    finished.write_results(tmp_path / "new" / "folder")
    optimized = read_tum(tmp_path / "new" / "folder" / "trajectory_optimized.tum")
    odometry = read_tum(tmp_path / "new" / "folder" / "trajectory_odometry.tum")
    np.testing.assert_allclose(optimized.poses, finished.trajectory()[1], atol=1e-8)
    np.testing.assert_allclose(odometry.poses, WORLD.odometry, atol=1e-8)
    np.testing.assert_array_equal(optimized.stamps_ns, np.arange(2 * LAP) * PERIOD_NS)


def test_the_verdict_table_says_why(finished: PoseGraph, tmp_path: Path) -> None:
    finished.write_results(tmp_path)
    rows = rows_of(tmp_path / "graph_verdicts.csv")
    assert tuple(rows[0]) == VERDICT_COLUMNS
    assert len(rows) == len(WORLD.closures)
    (bad,) = [row for row in rows if row["verdict"] == "rejected"]
    assert (bad["match_stamp_ns"], bad["query_stamp_ns"]) == (str(47 * PERIOD_NS), str(147 * PERIOD_NS))
    assert bad["reason"] == "contradicts the map"
    assert float(bad["mahalanobis"]) > 5 and float(bad["misfit_m"]) == pytest.approx(50**0.5, rel=0.2)


def test_rejected_closures_are_not_in_the_written_graph(finished: PoseGraph, tmp_path: Path) -> None:
    finished.write_g2o(tmp_path / "a.g2o")
    pairs = {(edge.first, edge.second) for edge in read_g2o(tmp_path / "a.g2o").edges}
    assert (0, LAP) in pairs and (47, 47 + LAP) not in pairs


def test_covariances_are_written_as_they_were_used(tmp_path: Path) -> None:
    """Closures are ten times worse than they say: the file must not repeat what they say."""
    world = closing(two_laps(), lap_pairs(*range(0, 90, 2)), noise=10.0)
    graph = PoseGraph(SETTINGS)
    feed_odometry(graph, world, range(len(world.truth)))
    graph.add_closures([world.message(row) for row in range(len(world.closures))])
    graph.settle()
    assert graph.scale.closures > 3
    graph.write_g2o(tmp_path / "a.g2o")
    again = PoseGraph(SETTINGS.model_copy(update={"reject_outliers": False}))
    for _ in drive(again, as_recording(read_g2o(tmp_path / "a.g2o"))):
        pass
    assert rms(again.trajectory()[1], graph.trajectory()[1]) < 2e-3


def test_the_written_graph_is_at_its_own_optimum(finished: PoseGraph, tmp_path: Path) -> None:
    finished.write_g2o(tmp_path / "a.g2o")
    again = driven_file(as_recording(read_g2o(tmp_path / "a.g2o")))
    assert rms(again.trajectory()[1], finished.trajectory()[1]) < 1e-3


def test_vertices_keep_the_ids_of_their_file(tmp_path: Path) -> None:
    lines = [f"VERTEX_SE2 {k} {k / 10 - 10} 0 0" for k in range(100, 160, 10)]
    lines += [f"EDGE_SE2 {k} {k + 10} 1 0 0 100 0 0 100 0 1000" for k in range(100, 150, 10)]
    lines += ["EDGE_SE2 150 100 -5 0 0 100 0 0 100 0 1000"]
    (tmp_path / "in.g2o").write_text("\n".join(lines))
    recording = as_recording(read_g2o(tmp_path / "in.g2o"))
    graph = driven_file(recording)
    write_optimised(tmp_path / "out.g2o", graph, recording, planar=True)
    written = read_g2o(tmp_path / "out.g2o")
    assert list(written.poses) == list(range(100, 160, 10))
    assert [(edge.first, edge.second) for edge in written.edges] == [
        (100, 110),
        (110, 120),
        (120, 130),
        (130, 140),
        (140, 150),
        (100, 150),
    ]
    assert not (tmp_path / "out.csv").exists()
    write_verdicts_by_vertex(tmp_path / "verdicts.csv", graph, recording)
    assert [(row["match"], row["query"]) for row in rows_of(tmp_path / "verdicts.csv")] == [("100", "150")]


def test_a_clock_that_went_back_is_written_in_order(tmp_path: Path) -> None:
    graph = PoseGraph(SETTINGS)
    world = closing(two_laps(), lap_pairs(0, 15, 30, 45), noise=1.0)
    for k in range(LAP):
        graph.add_odometry((k + LAP) * PERIOD_NS, world.odometry[k])
    graph.begin_session()
    for k in range(LAP):
        graph.add_odometry(k * PERIOD_NS, world.odometry[LAP + k])
    for row, closure in enumerate(world.closures):
        match, query = (closure.first + LAP) * PERIOD_NS, (closure.second - LAP) * PERIOD_NS
        graph.add_closure(replace(world.message(row), match_stamp_ns=match, query_stamp_ns=query))
    graph.settle()
    assert (np.diff(graph.trajectory()[0]) < 0).any()
    graph.write_tum(tmp_path / "a.tum")
    written = read_tum(tmp_path / "a.tum")
    assert (np.diff(written.stamps_ns) > 0).all() and len(written) == 2 * LAP


@pytest.mark.parametrize("target", ["results", "tum", "g2o"])
def test_a_place_that_cannot_be_written_is_one_clear_error(finished: PoseGraph, tmp_path: Path, target: str) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        if target == "results":
            finished.write_results(blocker / "folder")
        elif target == "tum":
            finished.write_tum(blocker / "a.tum")
        else:
            finished.write_g2o(blocker / "a.g2o")


def test_a_plane_file_stays_a_plane_file(tmp_path: Path) -> None:
    flat = [Edge(k, k + 1, make_pose(np.eye(3), [1.0, 0.1, 0]), np.eye(6)) for k in range(5)]
    write_plane(tmp_path / "in.g2o", np.tile(np.eye(4), (6, 1, 1)), flat)
    content = read_g2o(tmp_path / "in.g2o")
    recording = as_recording(content)
    write_optimised(tmp_path / "out.g2o", driven_file(recording), recording, content.planar)
    lines = (tmp_path / "out.g2o").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["VERTEX_SE2"] * 6 + ["EDGE_SE2"] * 5
    assert lines[5] == "VERTEX_SE2 5 5 0.5 0"
