"""The real graph over DDS: player, front-end, back-end, map and a foreign SLAM system, against the replay."""

from __future__ import annotations

import csv
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from processes import Process, wait_until

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_tum
from umf_ros.core.config import load_settings
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.replay import Replay

EXAMPLE = Path(__file__).parents[2] / "examples" / "slam_subscriber.py"


# what is compared is what was found, not what a busy machine lost
LOSING_NOTHING = "qos.reliability:=reliable", "qos.depth:=500", "worker.queue_size:=500", "worker.finish_s:=60.0"
QOS = [word for text in LOSING_NOTHING for word in ("-p", text)]


@dataclass
class LiveRun:
    folder: Path
    subscriber: str


@pytest.fixture(scope="module")
def dense_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Settings for the mini bag with every scan, of which the ground is made."""
    path = tmp_path_factory.mktemp("config") / "dense.yaml"
    path.write_text("/**: {ros__parameters: {loop: {min_time_gap_s: 8.0, min_travel_m: 15.0}}}\n")
    return path


@pytest.fixture(scope="module")
def live(mini_bag: Path, dense_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveRun]:
    """Play the mini bag once, at half speed: what is compared is what was found, not how fast."""
    folder = tmp_path_factory.mktemp("live")
    common = ["--ros-args", "--params-file", str(dense_config), "-p", f"results_dir:={folder}", *QOS]
    # the front-end finds its topics; the player does not wait for a back-end that is still searching
    odometry = ["-p", "topics.odometry:=/odom"]
    named = {"loop_closure_node": [], "pose_graph_node": odometry, "map_node": odometry}
    nodes = [
        Process("", folder / f"{name}.log", command=[sys.executable, "-m", f"umf_ros.nodes.{name}", *common, *more])
        for name, more in named.items()
    ]
    subscriber = Process("", folder / "subscriber.log", command=[sys.executable, str(EXAMPLE)])
    player_command = [sys.executable, "-m", "umf_ros.lab.live.bag_player_node", str(mini_bag), "--rate", "0.5"]
    try:
        nodes[0].wait_for("waiting for topics")  # no parameter names one
        nodes[1].wait_for("ready")
        nodes[2].wait_for("ready")
        player = Process("", folder / "player.log", command=[*player_command, "--wait-for-subscribers", "--quiet"])
        wait_until(lambda: player.exit_code is not None, 240)
        assert player.exit_code == 0, player.output
        player.kill()
        assert nodes[2].interrupt() == 0, nodes[2].output
        assert nodes[0].interrupt() == 0, nodes[0].output
        assert nodes[1].interrupt() == 0, nodes[1].output
        subscriber.interrupt()
        yield LiveRun(folder, subscriber.output)
    finally:
        for process in (*nodes, subscriber):
            process.kill()


@pytest.fixture(scope="module")
def offline(mini_bag: Path, dense_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("offline")
    settings = load_settings(dense_config)
    replay = Replay(folder, settings, LoopDetector(settings, make_detector_embedder(settings)))
    for _ in replay.run(FrameReader(open_bag(mini_bag), settings).stream()):
        pass
    replay.finish({})
    return folder


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_live_and_offline_find_exactly_the_same(live: LiveRun, offline: Path) -> None:
    summary = json.loads((live.folder / "summary.json").read_text())
    assert summary["drops"]["worker"] == 0
    assert rows(live.folder / "keyframes.csv") == rows(offline / "keyframes.csv")
    assert rows(live.folder / "closures.csv") == rows(offline / "closures.csv")
    assert len(rows(live.folder / "closures.csv")) >= 3


def test_live_and_offline_optimise_the_same_graph(live: LiveRun, offline: Path) -> None:
    assert rows(live.folder / "graph_verdicts.csv") == rows(offline / "graph_verdicts.csv")
    poses = [read_tum(folder / "trajectory_optimized.tum") for folder in (live.folder, offline)]
    np.testing.assert_array_equal(poses[0].stamps_ns, poses[1].stamps_ns)
    np.testing.assert_allclose(poses[0].poses, poses[1].poses, atol=1e-5)


def test_the_ground_of_the_drive_is_in_the_map(live: LiveRun) -> None:
    about = yaml.safe_load((live.folder / "map.yaml").read_text())
    image = cv2.imread(str(live.folder / about["image"]), cv2.IMREAD_UNCHANGED)[::-1]  # rows with y
    driven = read_tum(live.folder / "trajectory_optimized.tum").poses[:, :2, 3]
    column, row = np.floor((driven - about["origin"][:2]) / about["resolution"]).astype(int).T
    inside = (row >= 0) & (column >= 0) & (row < image.shape[0]) & (column < image.shape[1])
    shades = image[row[inside], column[inside]]
    assert inside.mean() > 0.9 and (shades == 254).mean() > 0.5 and (shades == 0).mean() < 0.05


def test_every_scan_with_an_image_becomes_a_pair(live: LiveRun, offline: Path) -> None:
    live_summary, offline_summary = (json.loads((f / "summary.json").read_text()) for f in (live.folder, offline))
    assert live_summary["pairs"] == offline_summary["pairs"] > 60


def test_the_back_end_optimises_what_the_front_end_found(live: LiveRun) -> None:
    text = (live.folder / "graph.g2o").read_text()
    vertices, edges = (len(re.findall(f"^{kind} ", text, re.M)) for kind in ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"))
    verdicts = [row["verdict"] for row in rows(live.folder / "graph_verdicts.csv")]
    assert len(verdicts) == len(rows(live.folder / "closures.csv"))
    assert edges - (vertices - 1) == verdicts.count("accepted") >= 3


def test_a_slam_system_gets_every_closure_as_a_factor(live: LiveRun) -> None:
    closures = rows(live.folder / "closures.csv")
    found = re.findall(r"closure (\d+): (\d+) -> (\d+)", live.subscriber)
    assert [tuple(ends) for _, *ends in found] == [(c["match_stamp_ns"], c["query_stamp_ns"]) for c in closures]
