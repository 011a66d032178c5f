"""The live graph as processes: loop_closure_node, pose_graph_node and a bag player over DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from rich.console import Console

from umf_ros.commands.console import LineProgress
from umf_ros.core.config import load_settings
from umf_ros.core.errors import UmfError
from umf_ros.durable_graph import DurableGraph
from umf_ros.graph_process import JOURNAL

START_TIMEOUT_S = 180.0
STOP_TIMEOUT_S = 60.0
READY, WAITING = "ready", "waiting for topics"
"""First line of a node; one that waits has to hear the player before it is ready."""
PLAYER = "umf_ros.lab.live.bag_player_node"
NODES = ("umf_ros.nodes.loop_closure_node", "umf_ros.nodes.pose_graph_node")
# a recording of the simulator must arrive whole, however busy the machine is; its sensors are where its file says
OFFLINE = ("use_sim_time:=true", "worker.finish_s:=60.0")
WHOLE = ("dataset:=simulated", "qos.reliability:=reliable", "qos.depth:=200", "frames.extrinsics:=calibration")


class NodeProcess:
    """A node in a process of its own; its output goes to a file in the folder `logs` and line by line to `on_line`.

    It does not see the terminal's Ctrl-C: its parent decides the order in which nodes end.
    """

    def __init__(self, module: str, arguments: list[str], logs: Path, on_line: Callable[[str], None]) -> None:
        self.name = module.rpartition(".")[2]
        self.ready = threading.Event()
        self._log = (logs / f"{self.name}.log").open("w", encoding="utf-8")
        self._on_line = on_line
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=_environment(),
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def exit_code(self) -> int | None:
        """Exit status, or None while it runs."""
        return self._process.poll()

    @property
    def cpu_s(self) -> float:
        """CPU time that the running process has taken, s; Linux."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def wait_ready(self) -> None:
        """Wait until the node says it is ready, or waits for topics.

        Raises:
            UmfError: it ended, or took too long.
        """
        deadline = time.monotonic() + START_TIMEOUT_S
        while not self.ready.wait(0.1):
            if self.exit_code is not None:
                self._reader.join()
                raise UmfError(f"{self.name} ended with status {self.exit_code}; see {self._log.name}")
            if time.monotonic() > deadline:
                raise UmfError(f"{self.name} was not ready after {START_TIMEOUT_S:.0f} s; see {self._log.name}")

    def stop(self) -> bool:
        """Ask the node to finish and wait; False when it had to be killed."""
        finished = True
        if self.exit_code is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                finished = False
        self._process.wait()
        self._reader.join()
        self._log.close()
        return finished

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._log.write(line)
            self._log.flush()
            if line.strip() == READY or line.startswith(WAITING):
                self.ready.set()
            else:
                self._on_line(line.rstrip())


class LiveGraph:
    """Context manager: both nodes run inside, and write their results when it ends.

    Args:
        folder: run folder for results and logs.
        console: where closures are shown as they come.
        config: parameter file of both nodes; None: a recording of the simulator, received whole.

    Attributes:
        seconds_to_stop: of each node, once they have ended.
        interrupted: whether Ctrl-C ended it.
    """

    def __init__(self, folder: Path, console: Console, config: Path | None = None) -> None:
        self._folder = folder
        self._config = config
        self._console = console
        self._nodes: list[NodeProcess] = []
        self.seconds_to_stop: dict[str, float] = {}
        self.interrupted = False

    @property
    def is_running(self) -> bool:
        """Whether the nodes have not been stopped."""
        return bool(self._nodes)

    def __enter__(self) -> LiveGraph:
        (self._folder / "logs").mkdir(exist_ok=True)
        try:
            with self._console.status("Starting loop_closure_node and pose_graph_node"):
                for module in NODES:
                    self._nodes.append(self._start(module, self._parameters()))
                for node in self._nodes:
                    node.wait_ready()
        except BaseException:
            self._stop_all()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        with self._console.status("Finishing"):
            self._stop_all()
            settle_left(self._folder)
        self.interrupted = kind is KeyboardInterrupt
        if self.interrupted:
            self._console.print("[yellow]Interrupted: the report covers what was done so far.")
        return self.interrupted

    def play(self, bag: Path, duration_s: float, rate: float) -> None:
        """Play the bag to its end, showing progress and what the nodes say.

        Raises:
            UmfError: the player failed or a node died.
        """
        arguments = [str(bag.resolve()), "--rate", str(rate), "--wait-for-subscribers", "--quiet"]
        player = self._start(PLAYER, arguments)
        try:
            self._watch(player, duration_s / rate)
        finally:
            player.stop()
        if player.exit_code:
            raise UmfError(f"the bag player ended with status {player.exit_code}; see {self._folder / 'logs'}")

    def _parameters(self) -> list[str]:
        own = [f"results_dir:={self._folder.resolve()}", *OFFLINE, *([] if self._config else WHOLE)]
        words = [word for text in own for word in ("-p", text)]
        return ["--ros-args", *(["--params-file", str(self._config.resolve())] if self._config else []), *words]

    def _watch(self, player: NodeProcess, seconds: float) -> None:
        with LineProgress(self._console, "Playing to the live nodes") as progress:
            start = time.monotonic()
            while player.exit_code is None:
                time.sleep(0.1)
                progress.advance_to(min((time.monotonic() - start) / seconds, 1.0))
                for node in self._nodes:
                    if node.exit_code is not None:
                        raise UmfError(f"{node.name} died with status {node.exit_code}; see {self._folder / 'logs'}")

    def _start(self, module: str, arguments: list[str]) -> NodeProcess:
        return NodeProcess(module, arguments, self._folder / "logs", self._show)

    def _show(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def _stop_all(self) -> None:
        # the front-end first: its last closures still reach the back-end
        for node in self._nodes:
            asked_s = time.monotonic()
            finished = node.stop()
            self.seconds_to_stop[node.name] = time.monotonic() - asked_s
            if not finished:
                self._console.print(f"[red]{node.name} did not finish and was killed; its results may be incomplete.")
        self._nodes = []


def settle_left(folder: Path) -> None:
    """Settle the graph of a run whose back-end had no time for it at its end."""
    path = folder / JOURNAL
    if not path.exists():
        return
    durable = DurableGraph(load_settings(folder / "config.yaml").pose_graph, path, lambda _: None)
    if durable.unsettled:
        durable.write_results(folder)
    durable.close()


def _environment() -> dict[str, str]:
    """A DDS domain of our own on this machine alone, and plain log lines."""
    return {
        **os.environ,
        "ROS_DOMAIN_ID": os.environ.get("ROS_DOMAIN_ID", str(1 + os.getpid() % 100)),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RCUTILS_CONSOLE_OUTPUT_FORMAT": "{message}",
        "RCUTILS_LOGGING_USE_STDOUT": "1",
        "RCUTILS_LOGGING_BUFFERED_STREAM": "0",
        "RCUTILS_COLORIZED_OUTPUT": "0",
        "PYTHONUNBUFFERED": "1",
    }
