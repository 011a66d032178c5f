"""Ctrl-C while a node's libraries are being loaded."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from processes import ENVIRONMENT


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_the_process_without_a_word(number: signal.Signals, tmp_path: Path) -> None:
    (tmp_path / "slow_node.py").write_text("print('loading', flush=True)\nimport time\ntime.sleep(60)\n")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\nfrom umf_ros.nodes.start import start\nstart('slow_node')"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "loading\n"
    process.send_signal(number)
    assert process.communicate(timeout=30) == ("", "")
    assert process.returncode == 0


def test_a_node_that_is_loaded_runs(tmp_path: Path) -> None:
    (tmp_path / "quick_node.py").write_text("def main():\n    print('runs')\n")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\nfrom umf_ros.nodes.start import start\nstart('quick_node')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=30)
    assert done.stdout == "runs\n"
