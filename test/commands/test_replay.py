"""`umf replay` as a user runs it: in a process of its own, on a simulated recording."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from umf_ros.bags.trajectories import read_tum
from umf_ros.results.tables import read_closures

FILES = (
    "summary.json closures.csv candidates.csv trajectory_odometry.tum trajectory_optimized.tum graph.g2o "
    "config.yaml trajectory.png report.html"
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
    assert truth["revisits"] >= truth["closures_true"]


def test_the_folder_is_complete(run: Path) -> None:
    assert [name for name in FILES if not (run / name).is_file()] == []
    assert len(list((run / "matches").glob("*.png"))) == len(read_closures(run / "closures.csv"))
    report = (run / "report.html").read_text()
    assert "data:image/png;base64," in report and 'src="http' not in report
    stamps = read_tum(run / "trajectory_optimized.tum").stamps_ns
    assert (np.diff(stamps) > 0).all() and (stamps == read_tum(run / "trajectory_odometry.tum").stamps_ns).all()


def test_a_run_can_be_repeated_from_its_own_settings(run: Path, mini_bag: Path, tmp_path: Path) -> None:
    done = umf("replay", mini_bag, "--config", run / "config.yaml", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "latest" / "closures.csv").read_text() == (run / "closures.csv").read_text()
    assert (tmp_path / "latest" / "config.yaml").read_text() == (run / "config.yaml").read_text()


def test_without_odometry_closures_are_found_and_the_graph_is_skipped(
    mini_bag: Path, mini_config: Path, tmp_path: Path
) -> None:
    config = tmp_path / "no_odometry.yaml"
    config.write_text(
        mini_config.read_text().replace("loop:", "topics.odometry: '', keyframe.untracked_period_s: 0.4, loop:")
    )
    done = umf("replay", mini_bag, "--config", config, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "the pose graph is skipped" in done.stdout
    summary = json.loads((tmp_path / "out" / "latest" / "summary.json").read_text())
    # at 2.5 m/s a scan that nobody can straighten is half a metre long: found, not precise
    assert summary["ground_truth"]["closures_true"] >= 3
    assert summary["ground_truth"]["ate_odometry_m"] is None
    assert not (tmp_path / "out" / "latest" / "graph.g2o").exists()


def test_odometry_and_truth_come_from_files(run: Path, mini_bag: Path, mini_config: Path, tmp_path: Path) -> None:
    odometry, truth = mini_bag.with_suffix(".odometry.tum"), mini_bag.with_suffix(".pos")
    done = umf(
        "replay", mini_bag, "--config", mini_config, "--odometry", odometry, "--ground-truth", truth, "--out", tmp_path
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "latest" / "summary.json").read_text())
    expected = json.loads((run / "summary.json").read_text())
    assert summary["keyframes"] == pytest.approx(expected["keyframes"], abs=1)
    assert summary["ground_truth"]["closures_false"] == 0
    assert summary["ground_truth"]["closures_true"] >= 3


def test_ctrl_c_keeps_what_was_done(mini_bag: Path, mini_config: Path, tmp_path: Path) -> None:
    arguments = ["replay", str(mini_bag), "--config", str(mini_config), "--out", str(tmp_path)]
    process = subprocess.Popen(
        [sys.executable, "-m", "umf_ros.cli", *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    keyframes = tmp_path / "latest" / "keyframes.csv"
    deadline = time.monotonic() + 120
    while not (keyframes.exists() and len(keyframes.read_text().splitlines()) > 5):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0 and "Interrupted" in output and "Traceback" not in output
    assert [name for name in FILES if not (tmp_path / "latest" / name).is_file()] == []
    summary = json.loads((tmp_path / "latest" / "summary.json").read_text())
    assert summary["keyframes"] == len(keyframes.read_text().splitlines()) - 1


def test_a_truncated_recording_is_used_as_far_as_it_goes(mini_bag: Path, mini_config: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(mini_bag.read_bytes()[: mini_bag.stat().st_size // 2])
    done = umf("replay", cut, "--config", mini_config, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "breaks off" in done.stdout + done.stderr or "truncated" in done.stdout + done.stderr
    summary = json.loads((tmp_path / "out" / "latest" / "summary.json").read_text())
    assert summary["keyframes"] > 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.mcap"], "there is no recording nowhere.mcap"),
        (["{notes}"], "notes"),
        (["{bag}", "--config", "nowhere.yaml"], "cannot read nowhere.yaml"),
        (["{bag}", "--config", "{wrong}"], "unknown parameter loop.topk"),
        (["{bag}", "--dataset", "kitti"], "dataset"),
        (["{bag}", "--embedder", "magic"], "magic"),
        (["{bag}", "--weights", "nowhere.safetensors"], "nowhere.safetensors"),
        (["{bag}", "--weights", "{notes}"], "notes"),
        (["{bag}", "--odometry", "{notes}"], "line 1"),
        (["{bag}", "--out", "{notes}/results"], "cannot write to"),
    ],
)
def test_what_a_user_can_get_wrong_is_one_clear_line(
    mini_bag: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    notes, wrong = tmp_path / "notes.txt", tmp_path / "wrong.yaml"
    notes.write_text("these are notes\n")
    wrong.write_text("loop: {topk: 3}\n")
    filled = [argument.format(bag=mini_bag, notes=notes, wrong=wrong) for argument in arguments]
    done = umf("replay", *filled, *([] if "--out" in filled else ["--out", tmp_path / "out"]))
    assert done.returncode == 1
    lines = done.stderr.strip().splitlines()
    assert lines and lines[-1].startswith("umf: ") and message in lines[-1]
    assert "Traceback" not in done.stderr and len(lines) == 1
