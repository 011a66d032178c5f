"""g2o in and out."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from graph_worlds import LAP, SETTINGS, accepted, closing, content_of, driven_file, lap_pairs, rms, two_laps

from umf_ros.core.errors import GraphError, OutputError
from umf_ros.core.geometry import adjoint, expmap, heading, invert, make_pose, propagate, relative
from umf_ros.core.trajectory import write_g2o
from umf_ros.lab.datasets.g2o import Edge, G2oGraph, read_g2o, write_plane
from umf_ros.lab.datasets.graph_recording import as_recording, drive
from umf_ros.lab.datasets.graph_units import in_units
from umf_ros.lab.simulation.pose_graphs import rover_loops, with_wrong_closures
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
        (f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 0{' 0' * 21}", "quaternion of zeros"),
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


def _turned(edge: Edge) -> Edge:
    return Edge(edge.second, edge.first, invert(edge.pose), propagate(adjoint(edge.pose), edge.covariance))


def test_a_backward_edge_is_turned_round() -> None:
    content = content_of(WORLD)
    recording = as_recording(G2oGraph(content.poses, [_turned(edge) for edge in content.edges]))
    np.testing.assert_allclose(recording.odometry, WORLD.odometry, atol=1e-9)
    expected = as_recording(content)
    for row in (0, 5):
        np.testing.assert_allclose(recording.closures[row].pose, expected.closures[row].pose, atol=1e-9)
        np.testing.assert_allclose(recording.closures[row].covariance, expected.closures[row].covariance, atol=1e-9)


def test_a_second_measurement_between_neighbours_is_a_closure_and_the_same_one_is_not() -> None:
    content = content_of(two_laps())
    first = content.edges[7]
    again = first._replace(pose=first.pose @ make_pose(np.eye(3), [0.05, 0, 0]))
    assert as_recording(G2oGraph(content.poses, [*content.edges, first, _turned(first)])).closures == []
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


LAPS = closing(two_laps(), lap_pairs(*range(0, 90, 4)), noise=1.0)
FALSE = closing(LAPS, [(20, 150), (33, 171), (52, 110)], (6.0, 0, 0))


def _errors(content: G2oGraph) -> tuple[float, set[tuple[int, int]]]:
    graph = driven_file(in_units(as_recording(content))[0])
    return rms(graph.trajectory()[1], LAPS.truth), accepted(graph)


def test_odometry_written_again_or_composed_over_several_poses_changes_nothing() -> None:
    content = content_of(LAPS)
    plain, right = _errors(content)
    steps = [edge for edge in content.edges if edge.second == edge.first + 1]
    longer = [
        Edge(one.first, two.second, one.pose @ two.pose, one.covariance + two.covariance)
        for one, two in pairwise(sorted(steps, key=lambda edge: edge.first))
    ]
    for more in (steps, [_turned(edge) for edge in steps], longer):
        found, closures = _errors(G2oGraph(content.poses, [*content.edges, *more]))
        assert found == pytest.approx(plain, rel=0.01) and closures == right


def test_measured_edges_over_two_poses_are_odometry_and_improve_it() -> None:
    rng = np.random.default_rng(4)
    content = content_of(LAPS)
    longer = []
    for k in range(len(LAPS.truth) - 2):
        covariance = LAPS.step_covariances[k + 1]
        noise = expmap(rng.multivariate_normal(np.zeros(6), covariance)[None])[0]
        longer.append(Edge(k, k + 2, relative(LAPS.truth[k], LAPS.truth[k + 2]) @ noise, covariance))
    recording = as_recording(G2oGraph(content.poses, [*content.edges, *longer]))
    assert len(recording.closures) == len(LAPS.closures)
    assert rms(recording.odometry, LAPS.truth) < 0.6 * rms(LAPS.odometry, LAPS.truth)
    # a wrong one is left to the back-end
    longer[5] = longer[5]._replace(pose=longer[5].pose @ make_pose(np.eye(3), [3.0, 0, 0]))
    recording = as_recording(G2oGraph(content.poses, [*content.edges, *longer]))
    assert len(recording.closures) == len(LAPS.closures) + 1


@pytest.mark.parametrize("decades", [-3, -2, 2, 3])
def test_information_in_other_units_is_said_and_no_wrong_closure_is_accepted(decades: int) -> None:
    plain, right = _errors(content_of(LAPS))
    content = content_of(FALSE)
    edges = [edge._replace(covariance=edge.covariance * 10.0 ** (2 * decades)) for edge in content.edges]
    _, said = in_units(as_recording(G2oGraph(content.poses, edges)))
    assert f"taken x {10.0**-decades:.2g}"[:9] in said
    found, closures = _errors(G2oGraph(content.poses, edges))
    assert found == pytest.approx(plain, rel=0.05) and closures == right


def test_rotations_in_degrees_are_found() -> None:
    content = content_of(FALSE)
    scale = np.diag([np.degrees(1)] * 3 + [1] * 3)
    edges = [edge._replace(covariance=scale @ edge.covariance @ scale) for edge in content.edges]
    _, said = in_units(as_recording(G2oGraph(content.poses, edges)))
    assert "rotations" in said
    assert _errors(G2oGraph(content.poses, edges))[1] == _errors(content_of(LAPS))[1]


def test_positions_in_millimetres_are_found_beside_wrong_closures() -> None:
    content, scale = content_of(FALSE), np.diag([1] * 3 + [1e3] * 3)
    edges = [edge._replace(covariance=scale @ edge.covariance @ scale) for edge in content.edges]
    _, said = in_units(as_recording(G2oGraph(content.poses, edges)))
    assert "x 0.001 (positions of odometry, positions of closures)" in said
    found, closures = _errors(G2oGraph(content.poses, edges))
    plain, right = _errors(content_of(LAPS))
    assert found == pytest.approx(plain, rel=0.05) and closures == right


def test_right_units_stay_as_they_are() -> None:
    for world in (LAPS, FALSE, with_wrong_closures(rover_loops(300, 12), 0.6, "groups", 1)):
        assert in_units(as_recording(content_of(world)))[1] == ""


def test_robots_that_take_turns_in_numbering_are_chains(tmp_path: Path) -> None:
    edges = [(k, k + 2) for k in range(18)] + [(0, 1), (6, 7), (12, 13)]
    path = tmp_path / "two.g2o"
    path.write_text("".join(f"EDGE_SE2 {a} {b} 1 0 0 1 0 0 1 0 1\n" for a, b in edges))
    recording = as_recording(read_g2o(path))
    assert recording.chains == [0, 10] and recording.ids[10] == 1
    assert [(edge.first, edge.second) for edge in recording.closures] == [(0, 10), (3, 13), (6, 16)]


SPACE = " ".join(str(x) for x in np.diag([1.0, 2, 3, 4, 5, 6])[np.triu_indices(6)])
MOVED = "1 2 3 0.1 0 0 0.994987437"


@pytest.mark.parametrize(
    ("lines", "note"),
    [
        (f"EDGE_SE3:QUAT 0 1 {MOVED} {SPACE}", ""),
        (f"EDGE_SE3:QUAT,0,1,{MOVED.replace(' ', ',')},{SPACE.replace(' ', ',')}", ""),
        (f"EDGE_SE3:QUAT\t0\t1\t{MOVED} {SPACE}\r", ""),
        (f"EDGE_SE3:QUAT 0 1 1 2 3 0.2 0 0 1.989974874 {SPACE}", ""),
        (f"EDGE_SE3:QUAT 0 1 1 2 3 0.994987437 0.1 0 0 {SPACE}", "w first"),
        ("EDGE_SE3:QUAT 0 1 " + MOVED + " " + " ".join(str(x) for x in np.diag([1, 2, 3, 4, 5, 6]).ravel()), ""),
        (f"EDGE_SE3_SWITCHABLE 0 1 9 {MOVED} {SPACE}", ""),
        (f"VERTEX_PLANE 5 0 0 1 0\nEDGE_SE3_PRIOR 0 0\nEDGE_SE3:QUAT 0 1 {MOVED} {SPACE}", "1 x VERTEX_PLANE"),
        (f"VERTEX_SE3:QUAT 0 1 2 3 0 0 0 0\nEDGE_SE3:QUAT 0 1 {MOVED} {SPACE}", "1 vertices have no rotation"),
    ],
)
def test_other_spellings_are_the_same_edge(tmp_path: Path, lines: str, note: str) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(lines + "\n", encoding="utf-8-sig")
    content = read_g2o(path)
    (edge,) = content.edges
    np.testing.assert_allclose(edge.pose[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(edge.pose[2, 1], 2 * 0.1 * 0.994987437, atol=1e-6)
    np.testing.assert_allclose(np.linalg.inv(edge.covariance), np.diag([4, 5, 6, 1, 2, 3]), atol=1e-9)
    assert not content.problems and note in " ".join(content.notes) and bool(note) == bool(content.notes)


@pytest.mark.parametrize("numbers", ["", " ".join(["nan"] * 21), "0 " * 20 + "0"])
def test_edges_without_information_weigh_as_the_others(tmp_path: Path, numbers: str) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(f"EDGE_SE3:QUAT 0 1 {MOVED} {SPACE}\nEDGE_SE3:QUAT 1 2 {MOVED} {numbers}\n")
    content = read_g2o(path)
    np.testing.assert_allclose(content.edges[1].covariance, content.edges[0].covariance)
    assert "1 of 2 edges have no usable information" in content.notes[0]


def test_an_unmeasured_direction_is_far_more_uncertain_than_the_others(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text("EDGE_SE2 0 1 1 0 0 100 0 0 100 0 0\n")
    sigmas = np.sqrt(np.diag(read_g2o(path).edges[0].covariance))
    assert sigmas[2] > 100 * sigmas[3] == pytest.approx(10)


def test_a_file_with_edges_in_space_is_in_space(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(f"VERTEX_SE2 0 0 0 0\n{GOOD}EDGE_SE3:QUAT 1 2 {MOVED} {SPACE}\n")
    content = read_g2o(path)
    assert not content.planar and len(content.edges) == 2
