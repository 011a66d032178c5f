"""`umf replay` as a user runs it, on a simulated recording; in a process of its own where that matters."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from command_line import only_line
from command_line import umf as umf_here
from recordings import LEFT, ODOMETRY, RIGHT, TRUTH, traverse, write_mcap
from sources import rows_of

from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth, read_tum
from umf_ros.core.errors import UmfError, either
from umf_ros.core.geometry import invert, relative, rotation_angle
from umf_ros.core.resources import dataset_names
from umf_ros.runs.run_file import RunFile, read_closures

FILES = (
    "summary.json closures.csv candidates.csv trajectory_odometry.tum trajectory_optimized.tum graph.g2o "
    "config.yaml report.html"
).split()


def umf(*arguments: str | Path, timeout_s: float = 300) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "umf_ros.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


@pytest.fixture(scope="module")
def run(mini_bag: Path, mini_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("replay")
    done = umf("replay", mini_bag, "--config", mini_config, "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    return out / "latest"


def test_it_finds_true_closures_and_straightens_the_trajectory(run: Path) -> None:
    summary = json.loads((run / "summary.json").read_text())
    truth = summary["ground_truth"]
    assert truth["closures_false"] == 0
    assert truth["closures_true"] >= 3
    assert truth["closures_true"] == summary["closures_published"] == len(read_closures(run / "closures.csv"))
    assert truth["ate_optimized_m"] < truth["ate_odometry_m"]
    assert truth["revisits_any_heading"] >= truth["closed_any_heading"] == truth["closures_true"]


def test_closures_agree_with_the_truth_of_the_recording_one_by_one(run: Path, mini_bag: Path) -> None:
    truth = {stamp: pose for stamp, pose in zip(*truth_of(mini_bag), strict=True)}
    stamps = np.array(sorted(truth))
    for closure in read_closures(run / "closures.csv"):
        # the truth comes fifty times a second: the nearest is at most 10 ms and 2.5 cm away
        match, query = (
            truth[stamps[np.abs(stamps - s).argmin()]] for s in (closure.match_stamp_ns, closure.query_stamp_ns)
        )
        error = invert(relative(match, query)) @ closure.match_T_query
        sigma = np.sqrt(np.diag(closure.covariance)[:3])
        assert np.linalg.norm(error[:3, 3]) < 0.5 and np.degrees(rotation_angle(error)) < 5
        assert (sigma > 1e-4).all() and (sigma < 2.0).all()
        assert closure.query_stamp_ns - closure.match_stamp_ns >= 8e9  # as the settings demand
        assert closure.probability >= 0.9


def truth_of(bag: Path) -> tuple[np.ndarray, np.ndarray]:
    truth = read_ground_truth(open_bag(bag))
    assert truth is not None
    return truth.stamps_ns, truth.poses


def test_the_tables_tell_the_same_story(run: Path) -> None:
    candidates, keyframes = rows_of(run / "candidates.csv"), rows_of(run / "keyframes.csv")
    closures = rows_of(run / "closures.csv")
    accepted = [(c["query_stamp_ns"], c["match_stamp_ns"]) for c in candidates if c["reason"] == "accepted"]
    assert accepted == [(c["query_stamp_ns"], c["match_stamp_ns"]) for c in closures]
    stamps = [int(keyframe["stamp_ns"]) for keyframe in keyframes]
    assert stamps == sorted(set(stamps))
    path_length = {int(k["stamp_ns"]): float(k["travelled_m"]) for k in keyframes}
    for candidate in candidates:
        query, match = int(candidate["query_stamp_ns"]), int(candidate["match_stamp_ns"])
        assert query - match >= 8e9 and path_length[query] - path_length[match] >= 15.0
        assert candidate["reason"] and -1 <= float(candidate["similarity"]) <= 1
        assert all(isinstance(value, float) for value in json.loads(candidate["numbers"]).values())
    summary = json.loads((run / "summary.json").read_text())
    assert summary["keyframes"] == len(keyframes)
    assert summary["queries"] == len({candidate["query_stamp_ns"] for candidate in candidates})
    assert summary["closures_rejected"] == len(candidates) - len(closures)
    inliers = {(i["query_stamp_ns"], i["match_stamp_ns"]) for i in rows_of(run / "inliers.csv")}
    assert inliers <= set(accepted)


def test_the_folder_is_complete(run: Path) -> None:
    assert [name for name in FILES if not (run / name).is_file()] == []
    report = (run / "report.html").read_text()
    assert "data:image/jpeg;base64," in report and len(report) < 10_000_000
    stamps = read_tum(run / "trajectory_optimized.tum").stamps_ns
    assert (np.diff(stamps) > 0).all() and (stamps == read_tum(run / "trajectory_odometry.tum").stamps_ns).all()


def test_a_run_can_be_repeated_from_its_own_settings(run: Path, mini_bag: Path, tmp_path: Path) -> None:
    done = umf("replay", mini_bag, "--config", run / "config.yaml", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "latest" / "closures.csv").read_text() == (run / "closures.csv").read_text()
    assert (tmp_path / "latest" / "config.yaml").read_text() == (run / "config.yaml").read_text()


def test_scans_make_the_odometry_of_a_recording_without(mini_bag: Path, mini_config: Path, tmp_path: Path) -> None:
    config = tmp_path / "no_odometry.yaml"
    config.write_text(mini_config.read_text(encoding="utf-8").replace("loop:", "topics.odometry: '', loop:"))
    done = umf("replay", mini_bag, "--config", config, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "odometry: vgicp on the scans of /bf_lidar/points_raw" in done.stdout
    folder = (tmp_path / "out" / "latest").resolve()
    summary = json.loads((folder / "summary.json").read_text())
    truth = summary["ground_truth"]
    assert truth["closures_true"] >= 3 and truth["closures_false"] == 0
    assert truth["ate_odometry_m"] < 0.6 and truth["ate_optimized_m"] < 0.4
    named = {"path": str(folder / "odometry.tum"), "frame": "body", "engine": "vgicp"}
    assert summary["odometry_file"] == named and len(read_tum(folder / "odometry.tum")) > 20


def test_without_any_odometry_closures_are_found_and_the_graph_is_skipped(
    mini_bag: Path, mini_config: Path, tmp_path: Path
) -> None:
    config = tmp_path / "no_odometry.yaml"
    without = "topics.odometry: '', keyframe.untracked_period_s: 0.4, loop:"
    config.write_text(mini_config.read_text(encoding="utf-8").replace("loop:", without))
    done = umf("replay", mini_bag, "--config", config, "--odometry", "none", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "the pose graph is skipped" in done.stdout
    summary = json.loads((tmp_path / "out" / "latest" / "summary.json").read_text())
    # at 2.5 m/s a scan without motion correction is half a metre long: found, not precise
    assert summary["ground_truth"]["closures_true"] >= 3
    assert summary["ground_truth"]["ate_odometry_m"] is None
    assert not (tmp_path / "out" / "latest" / "graph.g2o").exists()


def test_odometry_and_truth_come_from_files(run: Path, mini_bag: Path, mini_config: Path, tmp_path: Path) -> None:
    files = "--odometry", mini_bag.with_suffix(".odometry.tum"), "--ground-truth", mini_bag.with_suffix(".pos")
    done = umf("replay", mini_bag, "--config", mini_config, *files, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "latest" / "summary.json").read_text())
    expected = json.loads((run / "summary.json").read_text())
    assert summary["keyframes"] == pytest.approx(expected["keyframes"], abs=1)
    assert summary["ground_truth"]["closures_false"] == 0
    assert summary["ground_truth"]["closures_true"] >= 3


def keyframes_so_far(folder: Path) -> int:
    """Number of keyframes that a process has written."""
    with suppress(UmfError), closing(RunFile(folder, read_only=True)) as file:
        return len(file.rows("keyframes"))
    return 0


def test_ctrl_c_keeps_the_results_so_far(mini_bag: Path, mini_config: Path, tmp_path: Path) -> None:
    words = sys.executable, "-m", "umf_ros.cli", "replay", mini_bag, "--config", mini_config, "--out", tmp_path
    process = subprocess.Popen([*map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    keyframes = tmp_path / "latest" / "keyframes.csv"
    deadline = time.monotonic() + 120
    while keyframes_so_far(tmp_path / "latest") < 6:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130 and "Interrupted" in output and "Traceback" not in output
    assert [name for name in FILES if not (tmp_path / "latest" / name).is_file()] == []
    summary = json.loads((tmp_path / "latest" / "summary.json").read_text())
    assert summary["keyframes"] == len(keyframes.read_text().splitlines()) - 1


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("small") / "small.mcap", traverse(1.0))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.mcap"], "there is no recording nowhere.mcap"),
        (["{notes}"], "notes.txt is not a recording"),
        (["{odometry}"], "no topic of a known data set"),
        (["{bag}", "--config", "nowhere.yaml"], "cannot read nowhere.yaml"),
        (["{bag}", "--config", "{wrong}"], "unknown parameter loop.topk"),
        (["{bag}", "--config", "{notes}"], "notes.txt: expected names and values, found a str"),
        (["{bag}", "--dataset", "kitti"], f"dataset: input should be {either(list(map(repr, dataset_names())))}"),
        (["{bag}", "--embedder", "magic"], "magic"),
        (["{blind}", "--embedder", "netvlad"], "netvlad reads images alone, and {blind} has none"),
        (["{bag}", "--weights", "nowhere.safetensors"], "nowhere.safetensors"),
        (["{bag}", "--weights", "{notes}"], "notes.txt"),
        (["{bag}", "--odometry", "{notes}"], "line 1: expected 8 numbers"),
        (["{bag}", "--odometry", "{early}"], "the odometry file covers none of the recording"),
        (["{bag}", "--odometry-frame", "camera"], "--odometry-frame is the frame of the poses in an --odometry file:"),
        (["{bag}", "--odometry", "{early}", "--odometry-frame", "wheel"], "unknown frame 'wheel' of the odometry"),
        (["{bag}", "--ground-truth", "nowhere.pos"], "cannot read nowhere.pos"),
        (["{bag}", "--ground-truth", "{notes}"], "notes.txt, line 1"),
        (["{bag}", "--config", "{foreign}"], "notes.txt cannot be used as a place database"),
        (["{bag}", "--config", "{mounted}"], "cannot read /nowhere.yaml"),
    ],
)
def test_what_a_user_can_get_wrong_is_one_clear_line_and_leaves_nothing(
    small: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    written = {
        "notes": "these are notes\n",
        "wrong": "loop: {topk: 3}\n",
        "early": "1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n",
        "foreign": f"embedding: {{method: thumbnail}}\ndatabase: {{path: {tmp_path / 'notes.txt'}}}\n",
        "mounted": "calibration: /nowhere.yaml\n",
    }
    names = {"bag": small} | {name: tmp_path / f"{name}.txt" for name in written}
    names |= {name: tmp_path / f"{name}.mcap" for name in ("odometry", "blind")}
    write_mcap(names["blind"], [entry for entry in traverse(0.3) if entry[0] not in (LEFT, RIGHT)])
    write_mcap(names["odometry"], [entry for entry in traverse(0.3) if entry[0] == ODOMETRY])
    for name, content in written.items():
        names[name].write_text(content)
    filled = [argument.format(**names) for argument in arguments]
    assert message.replace("{blind}", str(names["blind"])) in only_line(
        umf_here("replay", *filled, "--out", tmp_path / "out")
    )
    assert not (tmp_path / "out").exists()


def test_results_that_have_no_place_are_one_clear_line(small: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    line = only_line(umf_here("replay", small, "--embedder", "thumbnail", "--out", tmp_path / "file" / "results"))
    assert line.startswith(f"cannot write to {tmp_path}/file/results")


def test_a_truncated_recording_is_used_without_truth_not_judged_and_its_name_keeps_its_brackets(tmp_path: Path) -> None:
    whole = write_mcap(tmp_path / "whole.mcap", [entry for entry in traverse(3.0) if entry[0] != TRUTH]).read_bytes()
    bag = tmp_path / "cut [copy].mcap"
    bag.write_bytes(whole[: len(whole) * 2 // 3])
    ended = umf_here("replay", bag, "--embedder", "thumbnail", "--dataset", "simulated", "--out", tmp_path / "out")
    assert ended.status == 3, ended.text  # images of another size, and three keyframes
    assert f"{bag} is truncated; its first" in ended.out
    assert "there is no ground truth to judge them by" in ended.text
    summary = json.loads((tmp_path / "out" / "latest" / "summary.json").read_text())
    assert summary["ground_truth"] is None and summary["keyframes"] > 2
