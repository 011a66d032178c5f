from __future__ import annotations

import importlib.util
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from umf_ros import embedding
from umf_ros.commands import doctor as checks
from umf_ros.commands.doctor import command
from umf_ros.core.errors import WeightsError


def broken_package(folder: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> str:
    (folder / "brokenpackage.py").write_text(code)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return "brokenpackage"


@pytest.mark.parametrize(
    ("code", "found", "advice"),
    [
        ("raise OSError('libusb-1.0.so.0: cannot open shared object file')", "libusb", "apt install libusb-1.0-0"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "status -11", "pip install"),
        ("__version__ = '1.9'", "1.9", "2 or newer"),
    ],
)
def test_a_broken_package_is_a_problem_with_advice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, found: str, advice: str
) -> None:
    name = broken_package(tmp_path, monkeypatch, code)
    finding = checks.check_package(name, name, "2", "a rover does without")
    assert not finding.fine
    assert found in finding.found
    assert advice in finding.advice


def test_a_missing_package_is_a_problem() -> None:
    finding = checks.check_package("no_such_package", "no-such-package", "1")
    assert (finding.fine, finding.found) == (False, "not installed")
    assert "pip install 'no-such-package>=1'" in finding.advice


@pytest.mark.parametrize(
    ("package", "told"),
    [("openvino", "torch runs the network"), ("torch", "umf_ros[torch]"), ("open3d", "umf_ros[lab]")],
)
def test_a_rover_may_do_without_some(package: str, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    check, real = dict(checks.checks())[package], importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else real(name))
    finding = check()
    assert finding.fine and finding.found.startswith("not installed; ") and told in finding.found


def test_the_network_needs_openvino_or_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    found = {name: check() for name, check in checks.checks() if name in ("openvino", "torch")}
    assert {name: finding.fine for name, finding in found.items()} == {"openvino": False, "torch": False}


def test_dds_really_exchanges_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "77")
    finding = checks.check_dds()
    assert finding.fine, finding.found
    assert "an image arrived" in finding.found


def test_dds_that_cannot_work_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_nonsense_cpp")
    finding = checks.check_dds()
    assert not finding.fine
    assert "RMW_IMPLEMENTATION" in finding.advice


@pytest.mark.parametrize(("fine", "status"), [(True, 0), (False, 1)])
def test_the_command_fails_exactly_when_something_is_wrong(
    fine: bool, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import typer

    finding = checks.Finding("weights", fine, "what was found", "what helps")
    monkeypatch.setattr(checks, "checks", lambda: [("weights", lambda: finding)])
    if fine:
        command()
    else:
        with pytest.raises(typer.Exit) as stopped:
            command()
        assert stopped.value.exit_code == status
    output = capsys.readouterr().out
    assert "what was found" in output
    assert ("what helps" in output) is not fine


@pytest.mark.parametrize(
    ("version", "minimum", "fine"),
    [
        ("2.10.1", "2.9", True),
        ("2.9", "2.10", False),
        ("10", "9.9", True),
        ("2.4.0+cpu", "2.4", True),
        ("2", "2.0.1", False),
    ],
)
def test_versions_are_compared_number_by_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, minimum: str, fine: bool
) -> None:
    name = broken_package(tmp_path, monkeypatch, f"__version__ = {version!r}")
    finding = checks.check_package(name, name, minimum)
    assert (finding.fine, finding.found) == (fine, version)


def test_the_ros_packages_of_this_machine_are_found() -> None:
    ros, messages = checks.check_rclpy(), checks.check_messages()
    assert ros.fine and ros.found.startswith("rclpy 7.") and "rmw_" in ros.found
    assert messages.fine and messages.found == "all there"


def test_a_missing_message_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.util.find_spec
    hidden = {"nav_msgs", "std_srvs"}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in hidden else real(name))
    finding = checks.check_messages()
    assert not finding.fine and finding.found == "missing: nav_msgs, std_srvs"
    assert "ros-jazzy-common-interfaces" in finding.advice


def test_weights_that_cannot_be_used_are_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(settings: object) -> None:
        raise WeightsError("umf_light.safetensors is damaged")

    monkeypatch.setattr(embedding, "make_embedder", refuse)
    finding = checks.check_weights()
    assert (finding.fine, finding.found) == (False, "umf_light.safetensors is damaged")
    assert "embedding.weights" in finding.advice


@pytest.mark.parametrize(("cores", "fine", "found"), [(1, False, "1 core"), (2, True, "2 cores")])
def test_one_core_is_too_few_for_a_live_rover(
    monkeypatch: pytest.MonkeyPatch, cores: int, fine: bool, found: str
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    finding = checks.check_processor()
    assert (finding.fine, finding.found) == (fine, found)


@pytest.mark.parametrize(("free_mb", "fine"), [(20, False), (64, True)])
def test_little_shared_memory_is_a_problem(monkeypatch: pytest.MonkeyPatch, free_mb: int, fine: bool) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free_mb * 10**6))
    finding = checks.check_shared_memory()
    assert (finding.fine, finding.found) == (fine, f"{free_mb} MB free in /dev/shm")
    assert "--shm-size" in finding.advice


def test_a_program_that_hangs_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "TIMEOUT_S", 0.5)
    name = broken_package(tmp_path, monkeypatch, "import time; time.sleep(60)")
    finding = checks.check_package(name, name, "1")
    assert not finding.fine and finding.found == "no answer within 0.5 s"
