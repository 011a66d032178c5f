"""`umf graph` as a person meets it: what it prints, writes and refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from graph_worlds import closing, lap_pairs, two_laps
from typer.testing import CliRunner, Result

from umf_ros.core.errors import GraphError, OutputError, UmfError
from umf_ros.core.geometry import relative
from umf_ros.core.trajectory import write_g2o
from umf_ros.lab.commands.graph import MOST_ROWS, app
from umf_ros.lab.datasets.g2o import Edge, read_g2o
from umf_ros.lab.simulation.pose_graphs import GraphWorld, rover_loops, with_wrong_closures

RIGHT = closing(two_laps(), lap_pairs(*range(0, 90, 6)), noise=1.0)


def write_world(path: Path, world: GraphWorld, stated: float = 1.0) -> Path:
    edges = [
        Edge(k - 1, k, relative(world.odometry[k - 1], world.odometry[k]), stated**2 * world.step_covariances[k])
        for k in range(1, len(world.truth))
    ]
    edges += [Edge(c.first, c.second, c.pose, c.covariance) for c in world.closures]
    write_g2o(path, world.odometry, edges)
    return path


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "120"})


def test_a_sound_graph_is_some_numbers_before_and_after_and_no_table(tmp_path: Path) -> None:
    result = run("optimize", write_world(tmp_path / "a.g2o", RIGHT))
    assert result.exit_code == 0
    counts, *gaps = result.output.strip().splitlines()
    assert counts == "200 poses, 15 closures: 15 accepted"
    assert [line.split(":")[0] for line in gaps] == ["before", "after"]
    before, after = (float(line.split(" m in the median")[0].split()[-1]) for line in gaps)
    assert 0 < after < 0.5 * before


def test_a_rejected_closure_is_named_by_the_ids_of_the_file(tmp_path: Path) -> None:
    world = closing(RIGHT, [(20, 150)], (6.0, 0, 0))
    result = run("optimize", write_world(tmp_path / "a.g2o", world))
    (row,) = [line for line in result.output.splitlines() if "contradicts" in line]
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells[:4] == ["20", "150", "rejected", "contradicts the map"]
    assert float(cells[4]) > 5 and 5 < float(cells[5]) < 7


def test_a_long_list_of_rejections_is_cut_and_says_where_to_find_all(tmp_path: Path) -> None:
    # every wrong closure says something else
    world = RIGHT
    for k in range(MOST_ROWS + 5):
        world = closing(world, [(2 * k, 2 * k + 31 + k)], (4.0 + k, -20.0 + 3 * k, 0))
    table = tmp_path / "verdicts.csv"
    result = run("optimize", write_world(tmp_path / "a.g2o", world), "--verdicts", table)
    assert "... and 5 more (--verdicts FILE writes all)" in result.output
    assert result.output.count("contradicts the map") == MOST_ROWS
    rejected = [line for line in table.read_text().splitlines() if ",rejected," in line]
    assert len(rejected) == MOST_ROWS + 5


def test_misstated_noise_is_said(tmp_path: Path) -> None:
    world = closing(two_laps(), lap_pairs(*range(0, 90, 2)), noise=1.0)
    result = run("optimize", write_world(tmp_path / "a.g2o", world, stated=1 / 4))
    (line,) = [line for line in result.output.splitlines() if "stated standard deviations are wrong" in line]
    assert 2.5 < float(line.split("odometry x")[1].split(",")[0]) < 6.0


@pytest.mark.parametrize(("guards", "scale_is_said"), [("all", True), ("none", False)])
def test_guards_are_chosen_by_name(tmp_path: Path, guards: str, scale_is_said: bool) -> None:
    world = closing(two_laps(), lap_pairs(*range(0, 90, 2)), noise=1.0)
    result = run("optimize", write_world(tmp_path / "a.g2o", world, stated=1 / 4), "--reject", guards)
    assert result.exit_code == 0
    assert ("deviations are wrong" in result.output) is scale_is_said


def test_the_written_graph_is_closer_to_the_truth(tmp_path: Path) -> None:
    path = write_world(tmp_path / "a.g2o", RIGHT)
    result = run("optimize", path, "-o", tmp_path / "b.g2o")
    assert f"optimised graph: {tmp_path / 'b.g2o'}" in result.output.replace("\n", "")
    ends = [list(read_g2o(file).poses.values())[-1][:3, 3] for file in (path, tmp_path / "b.g2o")]
    before, after = (np.linalg.norm(end - RIGHT.truth[-1][:3, 3]) for end in ends)
    assert after < 0.5 * before
    assert list(read_g2o(tmp_path / "b.g2o").poses) == list(read_g2o(path).poses)
    assert not (tmp_path / "b.csv").exists()  # stamps mean nothing to a graph file


def test_skipped_lines_are_named_but_not_by_the_hundred(tmp_path: Path) -> None:
    path = write_world(tmp_path / "a.g2o", RIGHT)
    path.write_text(path.read_text() + "EDGE_SE3:QUAT 1 2 broken\n" * (MOST_ROWS + 7))
    result = run("optimize", path)
    assert result.output.count("skipped line") == MOST_ROWS
    assert "... and 7 more lines" in result.output and "15 accepted" in result.output


def test_several_chains_are_counted(tmp_path: Path) -> None:
    path = write_world(tmp_path / "a.g2o", RIGHT)
    lines = [line for line in path.read_text().splitlines() if not line.startswith("EDGE_SE3:QUAT 99 100 ")]
    path.write_text("\n".join(lines))
    assert "200 poses in 2 chains, 15 closures: 15 accepted" in run("optimize", path).output


@pytest.mark.parametrize("option", ["-o", "--verdicts"])
def test_output_that_cannot_be_written_is_an_error(tmp_path: Path, option: str) -> None:
    result = run("optimize", write_world(tmp_path / "a.g2o", RIGHT), option, tmp_path / "no" / "file")
    assert isinstance(result.exception, OutputError) and "cannot write" in str(result.exception)


def test_groups_of_wrong_closures_are_told_from_right_ones(tmp_path: Path) -> None:
    world = with_wrong_closures(rover_loops(300, 12), 0.3, "groups", 1)
    output, table = tmp_path / "out.g2o", tmp_path / "verdicts.csv"
    result = run("optimize", write_world(tmp_path / "in.g2o", world), "-o", output, "--verdicts", table)
    assert result.exit_code == 0, result.output
    right = sum(closure.right for closure in world.closures)
    assert f"{right} accepted" in result.output and "contradicts the map" in result.output
    assert len(read_g2o(output).edges) == len(world.truth) - 1 + right
    assert len(table.read_text().splitlines()) == 1 + len(world.closures)


def test_without_guards_all_are_accepted(tmp_path: Path) -> None:
    world = with_wrong_closures(rover_loops(200, 12), 0.3, "groups", 1)
    result = run("optimize", write_world(tmp_path / "in.g2o", world), "--reject", "none")
    assert f"{len(world.closures)} accepted" in result.output and "rejected" not in result.output


@pytest.mark.parametrize("command", ["optimize", "plot"])
def test_a_file_that_is_not_there_is_an_error(tmp_path: Path, command: str) -> None:
    result = run(command, tmp_path / "none.g2o")
    assert isinstance(result.exception, GraphError) and "No such file" in str(result.exception)


@pytest.mark.parametrize("guards", ["gate", "some", "ALL"])
def test_an_unknown_guard_lists_the_known_ones(tmp_path: Path, guards: str) -> None:
    result = run("optimize", write_world(tmp_path / "a.g2o", RIGHT), "--reject", guards)
    assert isinstance(result.exception, UmfError)
    assert "expected all or none" in str(result.exception)


def test_the_picture_goes_where_it_should(tmp_path: Path) -> None:
    result = run("plot", write_world(tmp_path / "a.g2o", RIGHT), "-o", tmp_path / "b.png")
    assert result.exit_code == 0 and "b.png" in result.output
    assert (tmp_path / "b.png").read_bytes().startswith(b"\x89PNG")
    assert run("plot", tmp_path / "a.g2o", "-o", tmp_path / "c").exit_code == 0 and (tmp_path / "c").is_file()
    assert isinstance(run("plot", tmp_path / "a.g2o", "-o", tmp_path / "no" / "b.png").exception, OutputError)
