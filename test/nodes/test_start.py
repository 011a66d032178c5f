"""Ctrl-C while a node's libraries are being loaded."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from processes import ENVIRONMENT, Process, wait_until
from sources import ROOT

START = "from umf_ros.nodes.start import start; start"
COMMANDS = [["-c", f"{START}('umf_ros.nodes.pose_graph_node')"], [str(ROOT / "tools" / "umf")]]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_the_process_without_a_word(number: signal.Signals, tmp_path: Path) -> None:
    (tmp_path / "slow_node.py").write_text(
        "print('loading', flush=True)\nimport time\nfor _ in range(600):\n    time.sleep(0.1)\n"
    )
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {START}('slow_node')"
    process = subprocess.Popen(
        [sys.executable, "-c", code], env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "loading\n"
    process.send_signal(number)
    assert process.communicate(timeout=30) == ("", "")
    assert process.returncode == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("asked", [False, True])
def test_a_node_that_opens_its_models_and_files_ends_too(
    ros_context: None, tmp_path: Path, number: signal.Signals, asked: bool
) -> None:
    slow = [sys.executable, str(Path(__file__).parent / "slow_node.py"), "open"]
    given = ["dataset:=s3li-etna", f"autostart:={not asked}".lower(), f"results_dir:={tmp_path}"]
    process = Process("", tmp_path / "node.log", *given, command=slow)
    if asked:
        client = rclpy.create_node("client")
        change = client.create_client(ChangeState, "/pose_graph_node/change_state")
        assert change.wait_for_service(60.0)
        for _ in range(6):  # on a busy machine a request is lost while the endpoints still find each other
            change.call_async(ChangeState.Request(transition=Transition(label="configure")))
            with suppress(AssertionError):
                process.wait_for("opening", 15.0)
                break
    process.wait_for("opening")
    graph = process.child
    process.send(number)
    assert process.interrupt(timeout_s=30.0) == 0  # while the process of the graph ends, a second one changes nothing
    assert "Traceback" not in process.output
    assert wait_until(lambda: not Path(f"/proc/{graph}").exists())


def test_a_node_that_is_loaded_runs(tmp_path: Path) -> None:
    (tmp_path / "quick_node.py").write_text("def main():\n    print('runs')\n")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {START}('quick_node')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=30)
    assert done.stdout == "runs\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_without_its_venv_a_workspace_says_so_in_one_line(command: list[str]) -> None:
    """A terminal without the venv: -S leaves the packages of this Python out."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-S", *command], env=environment, capture_output=True, text=True, check=False, timeout=30
    )
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (1, "", 1)
    assert done.stderr.startswith("umf: ") and "source venv/bin/activate" in done.stderr


def test_a_package_that_is_missing_is_named_in_one_line() -> None:
    code = f"import sys; sys.modules['gtsam'] = None; {START}('umf_ros.nodes.pose_graph_node')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (1, "umf: gtsam is not installed; run umf doctor for a remedy\n")
