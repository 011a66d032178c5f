"""The live front-end over real DDS: bad input, parameters, services, an orderly end."""

from __future__ import annotations

import json
import re
import signal
import sys
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from live_peers import Peer
from processes import Process, wait_until
from rcl_interfaces.msg import Log
from recordings import POINT
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_srvs.srv import SetBool

from umf_ros.core.config import Database, Settings
from umf_ros.core.resources import find
from umf_ros.detector import make_detector_embedder
from umf_ros.nodes.conversions import SCAN_FIELDS, to_time
from umf_ros.nodes.diagnostics import FAILURES
from umf_ros.places.database import PlaceDatabase

MODULE = "umf_ros.nodes.loop_closure_node"
# a thumbnail needs no weights; no odometry or camera_info, so that nothing waits for them
PARAMETERS = (
    "topics.left_image:=/stereo/left/image_rect",
    "topics.cloud:=/bf_lidar/points_raw",
    "embedding.method:=thumbnail",
    "topics.odometry:=''",
    "topics.left_info:=''",
    "topics.right_info:=''",
    "topics.right_image:=''",
    "keyframe.untracked_period_s:=0.1",
    "keyframe.min_period_s:=0.1",
    "qos.reliability:=reliable",
)
START_NS = 1_700_000_000 * 10**9


class Rig(Peer):
    """Publishes one camera and one LiDAR, listens to diagnostics."""

    def __init__(self) -> None:
        super().__init__("loop_closure_node", "detector")
        self.images = self.create_publisher(Image, "/stereo/left/image_rect", 100)
        self.clouds = self.create_publisher(PointCloud2, "/bf_lidar/points_raw", 100)
        self.scans: list[PointCloud2] = []
        self.create_subscription(PointCloud2, "/loop_closure_node/keyframe_scans", self.scans.append, 50)
        self.rng = np.random.default_rng(0)

    def image(self, stamp_ns: int, **changes: object) -> Image:
        pixels = self.rng.integers(0, 255, 688 * 512, np.uint8)
        message = Image(height=512, width=688, step=688, encoding="mono8", data=array("B", pixels.tobytes()))
        message.header.stamp = to_time(stamp_ns)
        for name, value in changes.items():
            setattr(message, name, value)
        return message

    def cloud(self, stamp_ns: int) -> PointCloud2:
        points = np.zeros(500, POINT)
        points["x"], points["y"] = self.rng.uniform(-5, 5, 500), self.rng.uniform(3, 20, 500)
        points["intensity"] = 100
        fields = [
            PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32 if i < 3 else PointField.UINT32, count=1)
            for i, name in enumerate(POINT.names)
        ]
        message = PointCloud2(height=1, width=500, fields=fields, point_step=28, row_step=500 * 28)
        message.data = array("B", points.tobytes())
        message.header.stamp = to_time(stamp_ns)
        return message

    def publish_pair(self, stamp_ns: int) -> None:
        self.images.publish(self.image(stamp_ns))
        self.clouds.publish(self.cloud(stamp_ns))

    def count(self, name: str) -> int:
        return int(self.values.get(name, "0"))


@pytest.fixture
def rig(ros_context: None) -> Iterator[Rig]:
    node = Rig()
    yield node
    node.destroy_node()


@pytest.fixture
def node(rig: Rig, tmp_path: Path) -> Iterator[Process]:
    own = f"results_dir:={tmp_path / 'run'}", f"database.path:={tmp_path / 'map.sqlite'}"
    process = Process(MODULE, tmp_path / "node.log", *PARAMETERS, *own)
    process.wait_for("ready")
    assert rig.until(lambda: rig.images.get_subscription_count() > 0 and rig.clouds.get_subscription_count() > 0)
    yield process
    process.kill()


def test_it_takes_frames_survives_bad_ones_and_ends_in_order(rig: Rig, node: Process, tmp_path: Path) -> None:
    step = 213_000_000
    for i in range(5):
        rig.publish_pair(START_NS + i * step)
        rig.until(lambda i=i: rig.count("left_received") > i)
    bad = START_NS + 5 * step
    rig.images.publish(rig.image(bad, encoding="nv12"))
    rig.images.publish(rig.image(bad, height=0, width=0, step=0, data=array("B")))
    rig.images.publish(rig.image(bad, step=5))
    nameless = rig.cloud(bad)
    nameless.fields = nameless.fields[1:]
    rig.clouds.publish(nameless)
    assert rig.until(lambda: "nv12" in node.output and rig.values and "x" in node.output)
    for i in range(6, 9):
        rig.publish_pair(START_NS + i * step)
        rig.until(lambda i=i: rig.count("cloud_received") > i)
    assert rig.until(lambda: rig.count("places") >= 6), node.output
    assert rig.until(lambda: len(rig.scans) >= 6)
    assert {tuple(field.name for field in scan.fields) for scan in rig.scans} == {tuple(SCAN_FIELDS)}
    assert all(0 < scan.width <= 500 and len(scan.data) == 24 * scan.width for scan in rig.scans)
    assert node.exit_code is None
    assert node.interrupt() == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["pairs"] == 8 and summary["keyframes"] == 8
    assert summary["drops"]["image"] == 3 and summary["drops"]["cloud"] == 1
    assert "Traceback" not in node.output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_waits_at_the_end_is_told_and_can_be_played_again(rig: Rig, tmp_path: Path, number: int) -> None:
    own = f"results_dir:={tmp_path / 'run'}", f"database.path:={tmp_path / 'map.sqlite'}", "worker.queue_size:=100"
    own += "qos.reliability:=reliable", "qos.depth:=100"  # a busy machine loses nothing
    slow = [sys.executable, str(Path(__file__).parent / "slow_node.py"), "detect"]
    node = Process(MODULE, tmp_path / "slow.log", *PARAMETERS, *own, command=slow)
    stamps = [START_NS + i * 213_000_000 for i in range(30)]

    def play(node: Process) -> None:
        node.wait_for("ready")
        assert rig.until(lambda: rig.images.get_subscription_count() and rig.clouds.get_subscription_count())
        rig.until(lambda: False, timeout_s=2.0)  # the node has discovered the rig, too
        rig.values.clear()
        rig.rng = np.random.default_rng(0)  # the same recording
        for stamp_ns in stamps:
            rig.publish_pair(stamp_ns)
            rig.until(lambda: False, timeout_s=0.05)
        assert rig.until(lambda: rig.count("cloud_received") == len(stamps))

    def keyframes() -> list[int]:
        lines = (tmp_path / "run" / "keyframes.csv").read_text().splitlines()[1:]
        return [int(line.partition(",")[0]) for line in lines]

    play(node)
    node.send(number)
    assert node.interrupt() == 0
    done = keyframes()
    (line,) = [one for one in node.output.splitlines() if "were not processed" in one]
    left, since = re.match(r"(\d+) .* after stamp ([\d.]+) s; played again .* continue the run", line).groups()
    assert len(stamps) - len(done) - 1 <= int(left) <= len(stamps) - len(done) and len(done) < 20
    assert done[0] <= round(float(since) * 1e9) + 10**6 <= done[-1] + 10**6
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["keyframes"] == len(done)
    quick = Process(MODULE, tmp_path / "quick.log", *PARAMETERS, *own)
    play(quick)
    assert rig.until(lambda: rig.count("places") >= len(stamps) - 1), quick.output
    assert quick.interrupt() == 0 and "were not processed" not in quick.output
    assert sorted(keyframes()) == stamps  # each once


def test_results_that_vanish_cost_the_tally_and_nothing_else(rig: Rig, node: Process, tmp_path: Path) -> None:
    rig.publish_pair(START_NS)
    assert rig.until(lambda: rig.count("cloud_received") == 1)
    (tmp_path / "run").rename(tmp_path / "gone")  # in one step: the node may be writing there just now
    assert rig.until(lambda: "cannot write" in rig.values.get("last_error", ""))
    for i in range(1, 5):
        rig.publish_pair(START_NS + i * 213_000_000)
        rig.until(lambda i=i: rig.count("cloud_received") > i)
    assert rig.until(lambda: rig.count("places") >= 4), node.output
    assert node.interrupt() == 1
    assert "Traceback" not in node.output
    assert node.output.strip().splitlines()[-1].startswith(f"umf: cannot write {tmp_path / 'run' / 'summary.json'}")


def test_a_full_disk_shows_at_once_and_ends_nothing(rig: Rig, node: Process) -> None:
    rig.publish_pair(START_NS)
    assert rig.until(lambda: rig.count("cloud_received") == 1)
    with node.no_file_longer_than(100):
        for i in range(1, 4):
            rig.publish_pair(START_NS + i * 213_000_000)
            rig.until(lambda i=i: rig.count("cloud_received") > i)
        assert rig.until(lambda: "cannot write" in rig.values.get("last_error", "")), node.output
        assert rig.level == DiagnosticStatus.ERROR and rig.values["failure_category"] == "cannot_write"
        assert rig.values["remedy"] == FAILURES["cannot_write"]
    stored = rig.count("places")
    for i in range(4, 9):
        rig.publish_pair(START_NS + i * 213_000_000)
        rig.until(lambda i=i: rig.count("cloud_received") > i)
    assert rig.until(lambda: rig.count("places") > stored), node.output
    assert node.exit_code is None and "Traceback" not in node.output


def test_a_clock_that_jumps_back_starts_a_new_session(rig: Rig, node: Process) -> None:
    logged: list[Log] = []
    rig.create_subscription(Log, "/rosout", logged.append, 100)
    for lap in range(2):
        for i in range(4):
            rig.publish_pair(START_NS + i * 213_000_000)
            rig.until(lambda i=i, lap=lap: rig.count("cloud_received") > 4 * lap + i)
    # the last scan of each lap waits for later stamps; the jump completes the first lap
    assert rig.until(lambda: rig.count("cloud_received") == 8)
    assert rig.until(lambda: 0 < rig.count("places") <= 4), node.output
    for i in range(8):
        rig.publish_pair(START_NS - 100 * 10**9 + i * 213_000_000)
        rig.until(lambda i=i: rig.count("cloud_received") > 8 + i, 5.0)
    # from the detector, which knows no ROS
    assert rig.until(lambda: any("a new session begins; the" in one.msg for one in logged)), node.output
    (line,) = [one for one in logged if "a new session begins; the" in one.msg]
    assert (line.name, line.level) == ("loop_closure_node", Log.WARN) and line.stamp.sec
    assert node.exit_code is None


def test_services_pause_save_and_end_a_session(rig: Rig, node: Process, tmp_path: Path) -> None:
    for i in range(4):
        rig.publish_pair(START_NS + i * 213_000_000)
    assert rig.until(lambda: rig.count("places") >= 3)
    saved = rig.call("save")
    assert saved.success and saved.message.endswith(f"places saved to {tmp_path / 'map.saved.sqlite'}")
    embedder = make_detector_embedder(Settings.model_validate({"embedding": {"method": "thumbnail"}}))
    settings = Database(path=str(tmp_path / "map.saved.sqlite"))
    copy = PlaceDatabase(settings, embedder.name, embedder.dimension)
    assert len(copy) == int(saved.message.split()[0]) >= 3
    copy.close()
    assert rig.call("pause", SetBool, SetBool.Request(data=True)).message == "paused"
    assert rig.until(lambda: rig.message == "paused")
    before = rig.count("cloud_received")
    rig.publish_pair(START_NS + 10 * 213_000_000)
    assert not rig.until(lambda: rig.count("cloud_received") > before, timeout_s=2.5)
    places = rig.count("places")
    answer = rig.call("reset")
    assert answer.success and "all places are kept" in answer.message
    rig.values.clear()
    assert rig.until(lambda: rig.count("places") == places)


@pytest.mark.parametrize("method", ["dbow2", "netvlad", "solid"])
def test_one_parameter_changes_how_places_are_embedded(rig: Rig, tmp_path: Path, method: str) -> None:
    """A vocabulary, a network and a descriptor of points; a replay is driven by all methods in test/embedding."""
    own = f"results_dir:={tmp_path / 'run'}", f"database.path:={tmp_path / 'map.sqlite'}"
    node = Process(MODULE, tmp_path / "node.log", *PARAMETERS, f"embedding.method:={method}", *own)
    try:
        node.wait_for("ready")
        assert rig.until(lambda: rig.images.get_subscription_count() > 0 and rig.clouds.get_subscription_count() > 0)
        for i in range(4):
            rig.publish_pair(START_NS + i * 213_000_000)
        assert rig.until(lambda: rig.count("places") >= 3), node.output
        assert node.interrupt() == 0
    finally:
        node.kill()
    embedder = make_detector_embedder(Settings.model_validate({"embedding": {"method": method}}))
    kept = PlaceDatabase(Database(path=str(tmp_path / "map.sqlite")), embedder.name, embedder.dimension)
    assert len(kept) >= 3 and embedder.name.startswith(method)
    kept.close()


def test_guesses_of_the_calibration_are_told_when_it_starts(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(find("config/calibration/simulated.yaml").read_text() + "# TO BE MEASURED: the baseline\n")
    process = Process(MODULE, tmp_path / "node.log", *PARAMETERS, f"calibration:={path}")
    process.wait_for("ready")
    process.kill()
    assert process.output.count("the calibration holds guesses, measure them: the baseline") == 1


def test_a_silent_topic_is_explained(rig: Rig, node: Process) -> None:
    assert rig.until(
        lambda: (
            "silent for" in rig.messages.get("loop_closure_node: input left_image", "")
            or "nothing received from 1 publisher" in rig.messages.get("loop_closure_node: input left_image", "")
        )
    )
    assert rig.until(lambda: rig.values["failure_category"] == "no_data")
    rig.destroy_publisher(rig.clouds)
    expected = "nothing received: no publisher on /bf_lidar/points_raw"
    assert rig.until(lambda: rig.messages.get("loop_closure_node: input cloud") == expected)


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        ("loop.topk:=3", "umf: unknown parameter loop.topk"),
        ("embedding.method:=magic", "umf: .*magic"),
        ("calibration:=/nowhere.yaml", "umf: cannot read /nowhere.yaml"),
        ("results_dir:=/proc/results", "umf: cannot write to /proc/results"),
    ],
)
def test_wrong_parameters_end_the_node_with_one_line(tmp_path: Path, parameter: str, message: str) -> None:
    import re

    process = Process(MODULE, tmp_path / "node.log", *PARAMETERS, parameter)
    assert wait_until(lambda: process.exit_code is not None, 60)
    process.kill()
    assert process.exit_code == 1
    assert re.search(message, process.output) and "Traceback" not in process.output
