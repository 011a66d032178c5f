"""`umf map` as a user runs it: a simulated drive, and most of the same drive again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import yaml
from command_line import Ended, only_line, umf
from recordings import CLOUD, ODOMETRY, part_of, traverse, write_mcap
from sources import rows_of

from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth, read_tum
from umf_ros.core.config import load_preset
from umf_ros.lab.scan_files import parse_pcd, parse_ply
from umf_ros.maps.map_folder import MapFolder
from umf_ros.runs.run_file import read_closures
from umf_ros.runs.truth import trajectory_error


@pytest.fixture(scope="module")
def again(mini_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return part_of(mini_bag, tmp_path_factory.mktemp("again") / "again.mcap", 7.0)


@pytest.fixture(scope="module")
def made(
    mini_bag: Path, again: Path, mini_config: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Ended]:
    out = tmp_path_factory.mktemp("maps") / "map"
    return out, umf("map", mini_bag, again, "--config", mini_config, "--out", out)


def test_both_are_in_one_frame_and_right(made: tuple[Path, Ended], mini_bag: Path) -> None:
    out, ended = made
    assert ended.status == 0, ended.text
    summary = json.loads((out / "summary.json").read_text())
    assert summary["joined"] == 2 and summary["closures_between"]["accepted"] >= 4
    truth = read_ground_truth(open_bag(mini_bag))
    assert truth is not None
    for name in ("mini", "again"):
        assert trajectory_error(read_tum(out / "trajectories" / f"{name}.tum"), truth) < 0.4
    # in one frame: at one moment they are at one place
    first, second = (read_tum(out / "trajectories" / f"{name}.tum") for name in ("mini", "again"))
    there, known = first.at(second.stamps_ns)
    apart = np.linalg.norm(there[known, :3, 3] - second.poses[known, :3, 3], axis=1)
    assert known.sum() > 10 and np.median(apart) < 0.3
    assert "2 of 2 sessions in one frame" in ended.text


def test_closures_between_are_those_of_the_later_one_with_the_earlier(made: tuple[Path, Ended]) -> None:
    folder = MapFolder.open(made[0])
    closures = read_closures(folder.folder_of("again") / "closures_between.csv")
    assert not read_closures(folder.folder_of("mini") / "closures_between.csv")
    for closure in closures:
        assert folder.session_at(closure.query_stamp_ns) is folder.sessions[1]
        assert folder.session_at(closure.match_stamp_ns) is folder.sessions[0]


def test_sessions_of_a_wrong_mounting_are_apart(mini_bag: Path, again: Path, mini_config: Path, tmp_path: Path) -> None:
    calibration = yaml.safe_load(load_preset("simulated").calibration.read_text())
    calibration["body_T_lidar"]["quaternion"] = [0.0, 0.0, 0.0, 1.0]  # 87 deg off
    (tmp_path / "wrong.yaml").write_text(yaml.safe_dump(calibration))
    changes = "--set", f"calibration={tmp_path / 'wrong.yaml'}", "--out", tmp_path / "map"
    told = umf("map", mini_bag, again, "--config", mini_config, *changes).text
    assert "correct body_T_lidar of the calibration or /tf_static: quaternion: [" in told
    page = (tmp_path / "map" / "report.html").read_text().replace("&#39;", "'")
    assert "mini: the LiDAR's mounting is off by 8" in page
    assert "closures are withheld" in told and "1 of 2 sessions in one frame; closures between them: 0 found" in told


def test_what_is_in_the_map_costs_nothing_again(made: tuple[Path, Ended], mini_bag: Path, tmp_path: Path) -> None:
    out, _ = made
    before = {path: path.stat().st_mtime_ns for path in (out / "sessions").rglob("*.csv")}
    moved = tmp_path / "moved.mcap"
    moved.symlink_to(mini_bag)
    ended = umf("map", moved, "--out", out)
    assert ended.status == 0 and "in the map already, as mini" in ended.text
    assert {path: path.stat().st_mtime_ns for path in (out / "sessions").rglob("*.csv")} == before


def test_a_map_that_was_cut_off_while_it_compared_goes_on(made: tuple[Path, Ended], mini_bag: Path) -> None:
    folder = MapFolder.open(made[0])
    path = folder.folder_of("again") / "closures_between.csv"
    before = path.read_text()
    path.unlink()
    assert umf("map", mini_bag, "--out", made[0]).status == 0
    assert path.read_text() == before


def wrong_calls(tmp_path: Path) -> Iterator[tuple[list[object], str]]:
    (tmp_path / "empty").mkdir()
    yield [tmp_path / "missing.mcap"], "there is no recording"
    yield [tmp_path / "empty"], "empty is not a recording"
    (tmp_path / "notes.txt").write_text("these are notes\n")
    yield [tmp_path / "notes.txt"], "notes.txt is not a recording"
    small = write_mcap(tmp_path / "small.mcap", traverse(0.3))
    yield [small, tmp_path / "notes.txt"], "notes.txt is not a recording"
    yield [small, "--odometry", "foo"], "--odometry foo: there is no such file, and no engine but vgicp or none"
    yield [small, "--odometry", "none"], "a map needs odometry"
    blind = write_mcap(tmp_path / "blind.mcap", [one for one in traverse(0.3) if one[0] not in (CLOUD, ODOMETRY)])
    yield [small, blind], "blind.mcap has neither odometry nor scans"


def test_what_a_user_gets_wrong_is_one_line(tmp_path: Path) -> None:
    for recordings, told in wrong_calls(tmp_path):
        assert told in only_line(umf("map", *recordings, "--out", tmp_path / "map"))
    assert not (tmp_path / "map").exists()


def test_a_rover_finds_itself_in_the_map_which_stays_as_it_is(
    made: tuple[Path, Ended], again: Path, mini_config: Path, tmp_path: Path
) -> None:
    out, _ = made
    before = {path: path.read_bytes() for path in (out / "places.sqlite", out / "poses.npz", out / "map.json")}
    ended = umf("replay", again, "--config", mini_config, "--map", out, "--out", tmp_path)
    assert ended.status == 0, ended.text
    assert "localised after" in ended.text
    summary = json.loads((tmp_path / "latest" / "summary.json").read_text())
    about = summary["localization"]
    assert about["keyframes_until_found"] <= 20 and about["relocalised"] == 1 and about["contradicted"] <= 1
    found, known = read_tum(tmp_path / "latest" / "trajectory_in_map.tum"), read_tum(out / "trajectories" / "mini.tum")
    there, both = known.at(found.stamps_ns)
    apart = np.linalg.norm(found.poses[both, :3, 3] - there[both, :3, 3], axis=1)
    assert both.sum() > 5 and apart.max() < 0.5
    rows = rows_of(tmp_path / "latest" / "localization.csv")
    assert len(rows) == about["located"] and all(float(row["probability"]) > 0.99 for row in rows)
    assert all(0 < float(row["sigma_x_m"]) < 1 for row in rows)
    assert {path: path.read_bytes() for path in before} == before
    for command in ("judge", "report"):  # its closures are with places on another clock
        assert "its poses are in trajectory_in_map.tum" in only_line(umf(command, tmp_path / "latest"))
    told = only_line(umf("replay", again, "--map", out, "--out", tmp_path / "none", "--resume"))
    assert told == "a localising run has no use for --resume" and not (tmp_path / "none").exists()
    blind = write_mcap(tmp_path / "blind.mcap", [one for one in traverse(0.3) if one[0] not in (CLOUD, ODOMETRY)])
    told = only_line(umf("replay", blind, "--config", mini_config, "--map", out, "--out", tmp_path / "none"))
    assert "without odometry cannot be localised" in told and not (tmp_path / "none").exists()


def test_the_map_is_a_point_cloud_too(made: tuple[Path, Ended]) -> None:
    out, ended = made
    columns = parse_ply((out / "map.ply").read_bytes())
    assert len(columns["x"]) > 5000 and set(columns["session"].tolist()) == {0, 1}
    assert len(parse_pcd((out / "map.pcd").read_bytes())["x"]) == len(columns["x"])
    assert (out / "map.png").read_bytes().startswith(b"\x89PNG")
    thickness = json.loads((out / "summary.json").read_text())["thickness_m"]
    assert thickness["after"] < 0.15 and thickness["after"] <= thickness["with_moving"] + 0.001
    assert "cm thick" in ended.text


def test_the_ground_is_written_for_navigation_with_any_limits(made: tuple[Path, Ended], tmp_path: Path) -> None:
    out, _ = made
    assert not (out / "trajectories.geojson").exists()  # there is no origin
    about = yaml.safe_load((out / "map.yaml").read_text())
    grid = cv2.imread(str(out / about["image"]), cv2.IMREAD_UNCHANGED)
    assert (grid == 254).sum() > 3 * (grid == 0).sum() > 0
    (tmp_path / "tight.yaml").write_text("/**: {ros__parameters: {terrain: {max_step_m: 0.1, cell_m: 0.25}}}\n")
    ended = umf("map", "export", out, "--config", tmp_path / "tight.yaml", "--out", tmp_path / "tight")
    assert ended.status == 0 and "elevation.tif" in ended.text
    tight = cv2.imread(str(tmp_path / "tight" / "map.pgm"), cv2.IMREAD_UNCHANGED)
    assert yaml.safe_load((tmp_path / "tight" / "map.yaml").read_text())["resolution"] == 0.25
    assert (tight == 0).mean() > (grid == 0).mean()
    with rasterio.open(tmp_path / "tight" / "elevation.tif") as file:
        assert file.shape == tight.shape and file.crs is None
    assert "is not a map" in only_line(umf("map", "export", tmp_path))
    assert "max_step_m" in only_line(umf("map", "export", out, "--config", wrong_limits(tmp_path)))


def wrong_limits(folder: Path) -> Path:
    path = folder / "wrong.yaml"
    path.write_text("/**: {ros__parameters: {terrain: {max_step_m: -1.0}}}\n")
    return path


@pytest.mark.parametrize(
    ("options", "told"),
    [(["--mode", "localization"], "needs a map"), (["--map", "nowhere"], "is not a map"), (["--mode", "x"], "mode")],
)
def test_a_map_that_is_not_there_is_one_line(mini_bag: Path, tmp_path: Path, options: list[str], told: str) -> None:
    assert told in only_line(umf("replay", mini_bag, "--out", tmp_path / "out", *options))
    assert not (tmp_path / "out").exists()
