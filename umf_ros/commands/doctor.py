"""`umf doctor`: check the installation and name the remedy of every problem."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version

import typer

from umf_ros.core.errors import UmfError
from umf_ros.core.resources import LAB_PACKAGES

TIMEOUT_S = 60

_PACKAGES = {
    "numpy": ("numpy", "1.26"),
    "scipy": ("scipy", "1.17"),
    "cv2": ("opencv-python-headless", "4.10"),
    "safetensors": ("safetensors", "0.4"),
    "small_gicp": ("small_gicp", "1"),
    "gtsam": ("gtsam", "4.3"),
    "faiss": ("faiss-cpu", "1.8"),
    "mcap": ("mcap", "1.2"),
    "rosbags": ("rosbags", "0.11.2"),
    "pydantic": ("pydantic", "2.7"),
    "matplotlib": ("matplotlib", "3.8"),
    "jinja2": ("Jinja2", "3.1"),
    "plotly": ("plotly", "6"),
}
"""Distribution and first version known to work, by module."""
_WITHOUT_OPENVINO = "torch runs the network instead (OpenVINO asks for glibc 2.35)"
_WITHOUT_TORCH = "training, umf evaluate, a GPU and other weights need it: pip install 'umf_ros[torch]'"
_WITHOUT_LAB = "only the lab needs it: pip install 'umf_ros[lab]'"
_MESSAGE_PACKAGES = ("sensor_msgs", "nav_msgs", "geometry_msgs", "diagnostic_msgs", "visualization_msgs", "std_srvs")


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check.

    Attributes:
        name: what was checked.
        fine: whether the check passed.
        found: result of the check.
        advice: remedy, if it failed.
    """

    name: str
    fine: bool
    found: str
    advice: str = ""


def command() -> None:
    """Check this machine: packages, ROS 2, DDS, weights; name a remedy for every fault."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console()
    findings: list[Finding] = []
    with console.status("") as status:
        for name, check in checks():
            status.update(f"Checking {name}")
            findings.append(check())
    table = Table("", "", "found", box=None, pad_edge=False, show_header=False)
    for finding in findings:
        table.add_row("[green]ok[/]" if finding.fine else "[bold red]problem[/]", finding.name, escape(finding.found))
    console.print(table)
    problems = [finding for finding in findings if not finding.fine]
    for problem in problems:
        console.print(f"[bold]{problem.name}:[/] {escape(problem.advice)}", highlight=False, soft_wrap=True)
    if problems:
        console.print(f"[bold red]{len(problems)} of {len(findings)} checks found a problem.")
        raise typer.Exit(1)
    console.print("[green]Everything works.")


def checks() -> Iterator[tuple[str, Callable[[], Finding]]]:
    """Yield all checks by name."""
    yield "Python", check_python
    for module, (distribution, minimum) in _PACKAGES.items():
        yield distribution, partial(check_package, module, distribution, minimum)
    one_runs = any(map(importlib.util.find_spec, ("openvino", "torch")))
    yield "openvino", partial(check_package, "openvino", "openvino", "2025", _WITHOUT_OPENVINO if one_runs else "")
    yield "torch", partial(check_package, "torch", "torch", "2.4", _WITHOUT_TORCH if one_runs else "")
    for module, (distribution, minimum) in LAB_PACKAGES.items():
        yield distribution, partial(check_package, module, distribution, minimum, _WITHOUT_LAB)
    yield "ROS 2 Python", check_rclpy
    yield "ROS 2 messages", check_messages
    yield "DDS", check_dds
    yield "shared memory", check_shared_memory
    yield "weights", check_weights
    yield "processor", check_processor


def check_python() -> Finding:
    """Check the version of Python: Jazzy's is 3.12; its packages on PyPI also exist for 3.11."""
    found = ".".join(str(part) for part in sys.version_info[:3])
    return Finding("Python", sys.version_info[:2] in ((3, 11), (3, 12)), found, "use Python 3.11 or 3.12")


def check_package(module: str, distribution: str, minimum: str, without: str = "") -> Finding:
    """Import a package in a process of its own: a broken one may crash it.

    An optional package, with the consequence `without`, may be missing; an installed one has to work.
    """
    advice = f"pip install '{distribution}>={minimum}', or make install"
    if importlib.util.find_spec(module) is None:
        return Finding(distribution, bool(without), f"not installed; {without}" if without else "not installed", advice)
    status, output = _run("-c", f"import {module}; print(getattr({module}, '__version__', ''))")
    if status != 0:
        if "libusb" in output:
            advice = "sudo apt install libusb-1.0-0"
        return Finding(distribution, False, _last_line(output) or f"import ends with status {status}", advice)
    found = _version(distribution) or _last_line(output)
    return Finding(distribution, _at_least(found, minimum), found, f"{minimum} or newer is needed: {advice}")


def check_rclpy() -> Finding:
    """Check the ROS client library of Jazzy."""
    advice = "source /opt/ros/jazzy/setup.bash, or pip install 'ros-rclpy[fastrtps]==7.1.6'"
    status, output = _run("-c", "import rclpy; print(rclpy.get_rmw_implementation_identifier())")
    if status != 0:
        return Finding("ROS 2 Python", False, _last_line(output), advice)
    found = _version("ros-rclpy") or _version("rclpy")
    text = f"rclpy {found} with {_last_line(output)}"
    return Finding("ROS 2 Python", found.startswith("7."), text, f"Jazzy's rclpy is 7.x: {advice}")


def check_messages() -> Finding:
    """Check the message packages of common_interfaces."""
    missing = [name for name in _MESSAGE_PACKAGES if importlib.util.find_spec(name) is None]
    advice = "pip install ros-common-interfaces==5.3.6, or sudo apt install ros-jazzy-common-interfaces"
    return Finding("ROS 2 messages", not missing, f"missing: {', '.join(missing)}" if missing else "all there", advice)


def check_dds() -> Finding:
    """Check that a publisher and a subscriber find each other and exchange an image."""
    status, output = _run("-m", "umf_ros.nodes.diagnostics")
    advice = "check ROS_DOMAIN_ID, RMW_IMPLEMENTATION, and that a firewall lets UDP multicast pass on loopback"
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    return Finding("DDS", status == 0, f"{_last_line(output)} (domain {domain})", advice)


def check_shared_memory() -> Finding:
    """Check /dev/shm, through which Fast DDS passes images."""
    if not os.path.isdir("/dev/shm"):
        return Finding("shared memory", False, "there is no /dev/shm", "mount it, or images go through the network")
    free_mb = shutil.disk_usage("/dev/shm").free / 1e6
    advice = "free some of /dev/shm; for a container: --shm-size=512m"
    return Finding("shared memory", free_mb > 50, f"{free_mb:.0f} MB free in /dev/shm", advice)


def check_weights() -> Finding:
    """Check that the shipped weights load into the network."""
    advice = "reinstall the package, or name a file with the parameter embedding.weights"
    try:
        from umf_ros.core.config import EmbeddingSettings
        from umf_ros.embedding import make_embedder

        embedder = make_embedder(EmbeddingSettings())
    except (UmfError, ImportError) as error:
        return Finding("weights", False, str(error), advice)
    return Finding("weights", True, embedder.name)


def check_processor() -> Finding:
    """Check the processor, and the graphics card that the network can use."""
    cores = len(os.sched_getaffinity(0))
    found = f"{cores} {'core' if cores == 1 else 'cores'}"
    status, output = _run("-c", "import torch as t; print(t.cuda.get_device_name() if t.cuda.is_available() else '')")
    if status == 0 and _last_line(output):
        found += f", {_last_line(output)} (parameter embedding.device: cuda)"
    return Finding("processor", cores >= 2, found, "two cores are needed to keep up with a live rover")


def _run(*arguments: str) -> tuple[int, str]:
    command = [sys.executable, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return 1, f"no answer within {TIMEOUT_S} s"
    return done.returncode, done.stdout + (done.stderr if done.returncode else "")


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1].strip() if lines else ""


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return ""


def _at_least(found: str, minimum: str) -> bool:
    def numbers(text: str) -> list[int]:
        return [int(part) for part in text.split("+")[0].split(".") if part.isdigit()]

    return numbers(found) >= numbers(minimum)
