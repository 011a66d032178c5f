"""The processes of the live graph: started, watched, interrupted, and ended whatever happens to one of them."""

from __future__ import annotations

import io
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_line import umf
from processes import wait_until
from recordings import traverse, write_mcap
from rich.console import Console

from umf_ros.core.errors import UmfError
from umf_ros.lab.live.live_graph import LiveGraph, NodeProcess

SCANS = 14
RESULTS = ["summary.json", "closures.csv", "keyframes.csv", "config.yaml", "graph.g2o", "trajectory_odometry.tum"]


@pytest.fixture(autouse=True)
def no_process_is_left() -> Iterator[None]:
    """When a test is over."""
    before = set(nodes())
    yield
    assert set(nodes()) <= before


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds of scans, odometry, and images that are too small for the calibration."""
    return write_mcap(tmp_path_factory.mktemp("bag") / "small.mcap", traverse(3.0))


def nodes() -> dict[int, str]:
    """Nodes that this process has started, by process number."""
    found = {}
    for path in Path("/proc/self/task").glob("*/children"):
        for number in path.read_text().split():
            words = Path(f"/proc/{number}/cmdline").read_bytes().decode().split("\0")
            names = [word.rpartition(".")[2] for word in words if word.startswith("umf_ros.")]
            found |= {int(number): name for name in names}
    return found


def number_of(name: str) -> int:
    (number,) = [number for number, found in nodes().items() if found == name]
    return number


def once(condition: Callable[[], bool], action: Callable[[], object]) -> threading.Thread:
    """Do something as soon as a condition holds, beside the test."""

    def wait() -> None:
        if wait_until(condition, 120):
            action()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def test_a_program_that_ends_before_it_is_ready_is_told_with_its_log(tmp_path: Path) -> None:
    lines: list[str] = []
    process = NodeProcess("umf_ros.nodes.diagnostics", [], tmp_path, lines.append)
    with pytest.raises(UmfError, match=rf"diagnostics ended with status 0; see {tmp_path}/diagnostics\.log"):
        process.wait_ready()
    assert process.stop() and process.exit_code == 0
    assert len(lines) == 1 and lines[0].startswith("an image arrived after")
    assert (tmp_path / "diagnostics.log").read_text() == lines[0] + "\n"


def test_a_node_runs_in_a_session_of_its_own_until_it_is_stopped(tmp_path: Path) -> None:
    """The Ctrl-C of a terminal goes to every process of its session: the nodes must not see it."""
    lines: list[str] = []
    named = ["--ros-args", "-p", "dataset:=simulated"]
    process = NodeProcess("umf_ros.nodes.pose_graph_node", named, tmp_path, lines.append)
    process.wait_ready()
    number = number_of("pose_graph_node")
    assert os.getsid(number) == number != os.getsid(0) and process.exit_code is None
    assert process.stop() and process.exit_code == 0
    assert "ready\n" in (tmp_path / "pose_graph_node.log").read_text() and "ready" not in lines
    assert process.stop()  # stopping what has ended is nothing


def test_when_one_node_cannot_start_the_other_is_ended_too(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").mkdir()
    out = io.StringIO()
    told = pytest.raises(UmfError, match=r"loop_closure_node ended with status 1; see .*loop_closure_node\.log")
    with told, LiveGraph(tmp_path, Console(file=out, width=200)):
        pytest.fail("a graph without its front-end")
    reason = f"umf: cannot write {tmp_path}/config.yaml"
    assert reason in out.getvalue() and reason in (tmp_path / "logs" / "loop_closure_node.log").read_text()


def test_when_one_node_dies_the_others_finish_and_it_is_told(bag: Path, tmp_path: Path) -> None:
    player_log = tmp_path / "logs" / "bag_player_node.log"
    told = pytest.raises(UmfError, match=rf"pose_graph_node died with status -9; see {tmp_path}/logs")
    with told, LiveGraph(tmp_path, Console(file=io.StringIO())) as graph:
        once(player_log.exists, lambda: os.kill(number_of("pose_graph_node"), signal.SIGKILL))
        graph.play(bag, 3.0, rate=0.1)
    assert json.loads((tmp_path / "summary.json").read_text())["drops"]["worker"] == 0


def test_a_demo_that_can_find_nothing_has_the_status_of_such_a_replay(bag: Path, tmp_path: Path) -> None:
    ended = umf("demo", "--bag", bag, "--rate", "2", "--out", tmp_path)
    assert ended.status == 3, ended.text
    assert "the gap rules exclude every pair" in ended.text


def test_ctrl_c_ends_the_demo_with_a_complete_report(bag: Path, tmp_path: Path) -> None:
    latest = tmp_path / "latest"

    def frames_done() -> int:
        summary = latest / "summary.json"
        return json.loads(summary.read_text())["frames"] if summary.is_file() else 0

    once(lambda: frames_done() > 0, lambda: os.kill(os.getpid(), signal.SIGINT))
    ended = umf("demo", "--bag", bag, "--rate", "0.1", "--out", tmp_path)
    assert ended.status == 130, ended.text
    assert "Interrupted: the report covers what was done so far." in ended.text
    # what the nodes say is shown as it comes, and kept
    told = "image of 64 x 48 pixels, the calibration is for 688 x 512"
    assert told in ended.text and told in (latest / "logs" / "loop_closure_node.log").read_text()
    assert [name for name in [*RESULTS, "report.html"] if not (latest / name).is_file()] == []
    summary = json.loads((latest / "summary.json").read_text())
    assert 0 < summary["frames"] < SCANS and summary["keyframes"] > 0
    assert summary["ground_truth"]["closures_false"] == 0
    assert not {"closures_true", "revisits"} - set(summary["ground_truth"])
