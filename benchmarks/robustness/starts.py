"""Starts of a replay and of both nodes on a busy machine: how many hang, fail or end as they should.

python benchmarks/robustness/starts.py [--starts N] [--busy N] [--seed N] [--json FILE]

Each start has a minute. `--busy` processes compute beside the starts. A replay is ended by Ctrl-C once it has found its
first keyframes; a node once it says that it is ready.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from umf_ros.lab.program import UMF, JsonFile, umf, write_figures

LIMIT_S = 60.0
NODES = ("loop_closure_node", "pose_graph_node")
SPIN = "while True: sum(range(10000))"


def main(
    starts: Annotated[int, typer.Option(help="of the replay and of each node")] = 100,
    busy: Annotated[int, typer.Option(help="processes that compute beside them")] = 3,
    seed: Annotated[int, typer.Option(help="of the recording")] = 20007,
    json_file: JsonFile = None,
) -> None:
    """Count hangs and failures of many starts."""
    figures: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder, loaded(busy):
        bag = Path(folder) / "drive.mcap"
        umf("simulate", bag, "--seed", str(seed), "--duration", "4")
        commands = {"replay": [*UMF, "replay", str(bag), "--out", folder]}
        named = ["--ros-args", "-p", "dataset:=simulated"]  # else they wait for topics
        commands |= {name: [sys.executable, "-m", f"umf_ros.nodes.{name}", *named] for name in NODES}
        for name, command in commands.items():
            ends = Counter(start(command, name != "replay") for _ in range(starts))
            figures |= {f"{name}_{end}": ends[end] for end in ("fine", "hangs", "failures")}
            typer.echo(f"{name:20} {dict(ends)}")
    write_figures(json_file, figures)


def start(command: list[str], interrupt: bool) -> str:
    """How one start ends: "fine", "hangs" or "failures"."""
    with tempfile.TemporaryFile("w+", encoding="utf-8") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        deadline = time.monotonic() + LIMIT_S
        try:
            while interrupt and process.poll() is None and time.monotonic() < deadline:
                log.seek(0)
                if "ready" in log.read():
                    process.send_signal(signal.SIGINT)
                    break
                time.sleep(0.1)
            process.wait(max(1.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return "hangs"
    return "fine" if process.returncode in (0, 3) else "failures"  # 3: the recording is too short for a closure


@contextmanager
def loaded(count: int) -> Iterator[None]:
    """Processes that compute meanwhile."""
    others = [subprocess.Popen([sys.executable, "-c", SPIN]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()


if __name__ == "__main__":
    typer.run(main)
