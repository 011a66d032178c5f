"""g2o in and out."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from graph_worlds import (
    LAP,
    SETTINGS,
    accepted,
    closing,
    content_of,
    driven_file,
    lap_pairs,
    rms,
    two_laps,
)

from umf_ros.core.errors import GraphError, OutputError
from umf_ros.core.geometry import adjoint, expmap, heading, invert, propagate
from umf_ros.core.trajectory import write_g2o
from umf_ros.lab.datasets.g2o import Edge, G2oGraph, as_recording, drive, read_g2o, write_plane
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import State


def edges(count: int, planar: bool) -> list[Edge]:
    rng = np.random.default_rng(0)
    keep = np.array([0, 0, 1, 1, 1, 0]) if planar else np.ones(6)
    result = []
    for k in range(count):
        root = rng.normal(size=(6, 6))
        covariance = 0.01 * (root @ root.T + np.eye(6))
        pose = expmap((keep * rng.normal(0, 0.8, 6))[None])[0]
        result.append(Edge(k, k + 1, pose, covariance))
    return result


def test_what_was_written_is_read(tmp_path: Path) -> None:
    poses = np.stack([np.eye(4), *(edge.pose for edge in edges(5, False))])
    write_g2o(tmp_path / "a.g2o", poses, edges(5, False))
    content = read_g2o(tmp_path / "a.g2o")
    assert not content.planar and not content.problems
    for found, expected in zip(content.edges, edges(5, False), strict=True):
        assert (found.first, found.second) == (expected.first, expected.second)
        np.testing.assert_allclose(found.pose, expected.pose, atol=1e-10)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-7)
    np.testing.assert_allclose(np.stack(list(content.poses.values())), poses, atol=1e-10)


def test_gtsam_reads_the_same_poses_and_noise(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    write_g2o(path, np.tile(np.eye(4), (4, 1, 1)), edges(3, False))
    graph, _ = gtsam.readG2o(str(path), True)
    for k, edge in enumerate(edges(3, False)):
        factor = graph.at(k)
        np.testing.assert_allclose(factor.measured().matrix(), edge.pose, atol=1e-10)
        np.testing.assert_allclose(factor.noiseModel().covariance(), edge.covariance, rtol=1e-6)


def test_two_dimensions_there_and_back(tmp_path: Path) -> None:
    path = tmp_path / "plane.g2o"
    write_plane(path, np.tile(np.eye(4), (4, 1, 1)), edges(3, True))
    content = read_g2o(path)
    assert content.planar
    plane = np.ix_([3, 4, 2], [3, 4, 2])
    for found, expected in zip(content.edges, edges(3, True), strict=True):
        assert heading(found.pose) == pytest.approx(heading(expected.pose))
        np.testing.assert_allclose(found.pose[:2, 3], expected.pose[:2, 3], atol=1e-10)
        np.testing.assert_allclose(found.covariance[plane], expected.covariance[plane], rtol=1e-6)
        assert np.linalg.eigvalsh(found.covariance).min() > 0


def test_the_old_spelling_is_understood(tmp_path: Path) -> None:
    path = tmp_path / "toro.graph"
    path.write_text("VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0.5\nEDGE2 0 1 1 2 0.5 4 1 5 9 2 3\n")
    content = read_g2o(path)
    information = np.linalg.inv(content.edges[0].covariance)
    np.testing.assert_allclose(information[np.ix_([3, 4, 2], [3, 4, 2])], [[4, 1, 2], [1, 5, 3], [2, 3, 9]], atol=1e-9)


GOOD = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("EDGE_SE2 0 1 1 0", "has 4 values instead of 11"),
        ("EDGE_SE2 0 one 1 0 0 1 0 0 1 0 1", "invalid literal"),
        ("EDGE_SE2 0 1 nan 0 0 1 0 0 1 0 1", "not finite"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 -1", "not positive definite"),
        ("EDGE_SE2 1 1 1 0 0 1 0 0 1 0 1", "to itself"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 2", "not a unit quaternion"),
        ("VERTEX_SE2 -1 0 0 0", "negative vertex id"),
        ("HELLO world", "unknown tag HELLO"),
    ],
)
def test_a_malformed_line_is_named_and_the_rest_is_read(tmp_path: Path, line: str, problem: str) -> None:
    path = tmp_path / "bad.g2o"
    path.write_text(f"# a comment\n{GOOD}{line}\nFIX 0\n{GOOD}")
    content = read_g2o(path)
    assert len(content.edges) == 2
    (found,) = content.problems
    assert found.startswith("line 3: ") and problem in found


def test_ids_beyond_all_numbers_are_named(tmp_path: Path) -> None:
    edge = GOOD.split()
    (tmp_path / "far.g2o").write_text(" ".join([edge[0], str(10**30), str(10**30 + 1), *edge[3:]]) + "\n")
    with pytest.raises(GraphError, match="beyond all numbers"):
        read_g2o(tmp_path / "far.g2o")


def test_files_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="No such file"):
        read_g2o(tmp_path / "missing.g2o")
    (tmp_path / "picture.g2o").write_bytes(bytes(range(256)))
    with pytest.raises(GraphError, match="not a text file"):
        read_g2o(tmp_path / "picture.g2o")
    (tmp_path / "empty.g2o").write_text("VERTEX_SE2 0 0 0 0\n")
    with pytest.raises(GraphError, match="no usable edge"):
        read_g2o(tmp_path / "empty.g2o")
    with pytest.raises(OutputError):
        write_g2o(tmp_path / "no" / "folder.g2o", np.empty((0, 4, 4)), [])


def test_chains_and_backward_edges_are_sorted_out(tmp_path: Path) -> None:
    path = tmp_path / "two.g2o"
    edge = "0 0 0 1 0 0 1 0 1\n"
    path.write_text(f"EDGE_SE2 11 10 {edge}EDGE_SE2 11 12 {edge}EDGE_SE2 40 41 {edge}EDGE_SE2 41 10 {edge}")
    recording = as_recording(read_g2o(path))
    assert recording.ids.tolist() == [10, 11, 12, 40, 41] and recording.chains == [0, 3]
    assert [(closure.first, closure.second) for closure in recording.closures] == [(0, 4)]


WORLD = closing(closing(two_laps(), lap_pairs(*range(0, 90, 6)), noise=1.0), lap_pairs(47), (5.0, 5.0, 0))


def test_a_file_becomes_odometry_and_closures() -> None:
    recording = as_recording(content_of(WORLD))
    np.testing.assert_allclose(recording.odometry, WORLD.odometry, atol=1e-9)
    assert recording.chains == [0] and recording.step_covariance(0) is None
    found = [(edge.first, edge.second) for edge in recording.closures]
    assert found == sorted(((c.first, c.second) for c in WORLD.closures), key=lambda pair: pair[::-1])


def test_ids_may_be_any_growing_numbers() -> None:
    recording = as_recording(content_of(WORLD, first_id=5000, stride=3))
    assert recording.ids[:2].tolist() == [5000, 5003]
    assert accepted(driven_file(recording)) == {(c.first, c.second) for c in WORLD.closures if c.right}


def test_a_backward_edge_is_turned_round() -> None:
    content = content_of(WORLD)
    turned = [Edge(e.second, e.first, invert(e.pose), propagate(adjoint(e.pose), e.covariance)) for e in content.edges]
    recording = as_recording(G2oGraph(content.poses, turned))
    np.testing.assert_allclose(recording.odometry, WORLD.odometry, atol=1e-9)
    expected = as_recording(content)
    for row in (0, 5):
        np.testing.assert_allclose(recording.closures[row].pose, expected.closures[row].pose, atol=1e-9)
        np.testing.assert_allclose(recording.closures[row].covariance, expected.closures[row].covariance, atol=1e-9)


def test_a_second_edge_between_neighbours_is_a_closure() -> None:
    content = content_of(two_laps())
    again = Edge(7, 8, content.edges[7].pose, content.edges[7].covariance)
    recording = as_recording(G2oGraph(content.poses, [*content.edges, again]))
    assert [(edge.first, edge.second) for edge in recording.closures] == [(7, 8)]


def test_where_odometry_is_missing_a_new_chain_begins_at_its_vertex() -> None:
    content = content_of(closing(two_laps(), lap_pairs(0, 15, 30, 45)))
    kept = [edge for edge in content.edges if (edge.first, edge.second) != (LAP - 1, LAP)]
    recording = as_recording(G2oGraph(content.poses, kept))
    assert recording.chains == [0, LAP]
    np.testing.assert_allclose(recording.odometry[LAP], content.poses[LAP])
    assert len(driven_file(recording).trajectory()[0]) == 2 * LAP


def test_driving_tells_its_progress_and_settles() -> None:
    recording = as_recording(content_of(WORLD))
    graph = PoseGraph(recording.settings(SETTINGS))
    assert list(drive(graph, recording)) == list(range(1, len(WORLD.closures) + 1))
    assert accepted(graph) == {(c.first, c.second) for c in WORLD.closures if c.right}
    assert graph.verdict_counts() == {State.ACCEPTED: len(WORLD.closures) - 1, State.REJECTED: 1}
    assert rms(graph.trajectory()[1], WORLD.truth) < 0.5


def test_a_file_without_closures_is_its_odometry() -> None:
    graph = driven_file(as_recording(content_of(two_laps())))
    np.testing.assert_allclose(graph.trajectory()[1], two_laps().odometry, atol=1e-9)
    assert graph.closures() == []


def test_settling_again_and_again_changes_nothing() -> None:
    graph = driven_file(as_recording(content_of(WORLD)))
    once = graph.trajectory()[1]
    for _ in range(4):
        graph.settle()
    poses = graph.trajectory()[1]
    turns = poses[:, :3, :3]
    np.testing.assert_allclose(np.swapaxes(turns, 1, 2) @ turns, np.tile(np.eye(3), (len(turns), 1, 1)), atol=1e-8)
    np.testing.assert_allclose(poses, once, atol=1e-6)


def test_a_flat_graph_with_unit_information_comes_to_its_optimum(tmp_path: Path) -> None:
    """Many a public graph states one metre and one radian for everything, though it is twenty times better."""
    rng, turn, lines = np.random.default_rng(3), 2 * np.pi / 50, []
    for k in range(150):
        x, y, yaw = rng.normal([1.0, 0.0, turn], [0.05, 0.05, 0.02])
        lines.append(f"EDGE_SE2 {k} {k + 1} {x} {y} {yaw} 1 0 0 1 0 1")
    for k in range(50, 151, 3):
        x, y, yaw = rng.normal(0.0, [0.05, 0.05, 0.02])
        lines.append(f"EDGE_SE2 {k - 50} {k} {x} {y} {yaw} 1 0 0 1 0 1")
    path = tmp_path / "unit.g2o"
    path.write_text("\n".join(lines) + "\n")
    recording = as_recording(read_g2o(path))
    graph, unguarded = (
        driven_file(recording),
        PoseGraph(recording.settings(SETTINGS.model_copy(update={"reject_outliers": False}))),
    )
    for _ in drive(unguarded, recording):
        pass
    assert graph.scale.odometry == graph.scale.closures < 0.2
    assert graph.verdict_counts()["accepted"] == 34
    assert rms(graph.trajectory()[1], unguarded.trajectory()[1]) < 1e-3
