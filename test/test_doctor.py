from __future__ import annotations

from pathlib import Path

import pytest

from umf_ros import doctor
from umf_ros.commands.doctor import command


def broken_package(folder: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> str:
    (folder / "brokenpackage.py").write_text(code)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return "brokenpackage"


def test_a_good_package_is_fine_and_shows_its_version() -> None:
    finding = doctor.check_package("numpy", "numpy", "2")
    assert finding.fine
    assert finding.found.startswith("2.")


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
    finding = doctor.check_package(name, name, "2")
    assert not finding.fine
    assert found in finding.found
    assert advice in finding.advice


def test_a_missing_package_is_a_problem() -> None:
    finding = doctor.check_package("no_such_package", "no-such-package", "1")
    assert (finding.fine, finding.found) == (False, "not installed")
    assert "pip install 'no-such-package>=1'" in finding.advice


def test_dds_really_exchanges_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "77")
    finding = doctor.check_dds()
    assert finding.fine, finding.found
    assert "an image arrived" in finding.found


def test_dds_that_cannot_work_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_nonsense_cpp")
    finding = doctor.check_dds()
    assert not finding.fine
    assert "RMW_IMPLEMENTATION" in finding.advice


def test_every_check_has_its_own_name() -> None:
    names = [name for name, _ in doctor.checks()]
    assert len(names) == len(set(names)) > 15


@pytest.mark.parametrize(("fine", "status"), [(True, 0), (False, 1)])
def test_the_command_fails_exactly_when_something_is_wrong(
    fine: bool, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import typer

    finding = doctor.Finding("weights", fine, "what was found", "what helps")
    monkeypatch.setattr(doctor, "checks", lambda: [("weights", lambda: finding)])
    if fine:
        command()
    else:
        with pytest.raises(typer.Exit) as stopped:
            command()
        assert stopped.value.exit_code == status
    output = capsys.readouterr().out
    assert "what was found" in output
    assert ("what helps" in output) is not fine
