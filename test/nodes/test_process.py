"""Starting and stopping a node: signals, errors, last words."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from processes import ENVIRONMENT, wait_until

from umf_ros.core.config import Settings
from umf_ros.graph_process import start_graph

NODE = Path(__file__).parent / "dutiful_node.py"


def start(action: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(NODE), action, *arguments]
    return subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize(
    ("action", "state"), [("interrupt", "publishing"), ("terminate", "publishing"), ("shutdown", "cut off")]
)
def test_a_signal_or_a_lost_context_ends_the_spinning_and_the_node_finishes_its_work(action: str, state: str) -> None:
    ended = start(action)
    assert ended.stdout.splitlines()[-2:] == [f"closed while {state}", "context shut down"], ended.stderr
    assert ended.returncode == 0


def test_a_node_without_work_to_finish_ends_too() -> None:
    ended = start("plain")
    assert (ended.returncode, ended.stdout) == (0, "context shut down\n"), ended.stderr


@pytest.mark.parametrize(
    ("action", "line"),
    [("refuse", "unknown parameter loop.topk"), ("overflow", "cannot write results: No space left on device")],
)
def test_an_error_of_a_user_or_a_full_disk_is_one_line_and_status_1(action: str, line: str) -> None:
    ended = start(action)
    assert (ended.returncode, ended.stdout.splitlines()[-1]) == (1, "context shut down")
    assert ended.stderr == f"umf: {line}\n"


def test_a_callback_that_fails_is_told_and_the_node_goes_on() -> None:
    ended = start("fail")
    assert ended.stdout.count("ZeroDivisionError: a fault in the program; the node continues") == 3, ended.stdout
    assert ended.stdout.splitlines()[-2:] == ["closed while publishing", "context shut down"]
    assert ended.returncode == 0 and "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--log-level", "loud"], "Couldn't parse log level: '--log-level loud'. Error: Argument does not use a valid"),
        (["--params-file", "/no.yaml"], "Couldn't parse params file: '--params-file /no.yaml'. Error: Error opening"),
        (["--nonsense"], "['--nonsense']"),
    ],
)
def test_arguments_that_ros_cannot_read_are_one_line_and_status_1(arguments: list[str], told: str) -> None:
    ended = start("plain", "--ros-args", *arguments)
    (line,) = ended.stderr.splitlines()
    assert ended.returncode == 1 and line.startswith("umf: ROS cannot read its arguments: ") and told in line
    assert ".c:" not in line


def test_arguments_reach_the_node() -> None:
    ended = start("interrupt", "--ros-args", "-p", "depth:=7")
    assert ended.stdout.splitlines()[0] == "depth 7", ended.stderr


def test_the_log_of_the_graphs_process_is_that_of_the_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    code = "import logging, threading, time, warnings\ndef late():\n"
    code += "    while 'logging' not in warnings.showwarning.__module__:\n        time.sleep(0.1)\n"
    code += "    warnings.warn('overflow\\nin cast')\n    logging.warning('%s', 'stays')\n"
    (tmp_path / "sitecustomize.py").write_text(code + "threading.Thread(target=late, daemon=True).start()\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    graph = start_graph(Settings(), None, print)
    assert wait_until(lambda: bool(graph.state()) and len(caplog.records) >= 2, 20.0)
    graph.close()
    assert "overflow" in caplog.messages[0] and caplog.messages[1] == "stays"
    assert {one.levelname for one in caplog.records} == {"WARNING"}
