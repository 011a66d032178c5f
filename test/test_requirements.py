"""The pinned requirements are those of pyproject.toml, the one list."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.version import Version
from sources import ROOT, requirements

from umf_ros.commands.doctor import checks


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """The files that the check reads, to be changed."""
    (tmp_path / "tools").mkdir()
    shutil.copy(ROOT / "tools" / "requirements.py", tmp_path / "tools")
    for path in [ROOT / "pyproject.toml", *ROOT.glob("requirements*.txt")]:
        shutil.copy(path, tmp_path)
    return tmp_path


def check(tree: Path) -> list[str]:
    command = [sys.executable, str(tree / "tools" / "requirements.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == bool(done.stderr)
    return done.stderr.splitlines()


def test_every_pinned_file_is_that_of_the_list(tree: Path) -> None:
    assert check(tree) == []


@pytest.mark.parametrize(
    ("name", "old", "new", "finding"),
    [
        ("requirements.txt", "scipy==", "# scipy==", "requirements.txt: scipy>=1.17 is missing"),
        ("requirements-lab.txt", "nncf==3.4.0", "nncf==3.3.0", "nncf==3.3.0 does not pin nncf>=3.4"),
        ("requirements-lab.txt", "nncf==3.4.0", "nncf>=3.5", "nncf>=3.5 does not pin nncf>=3.4"),
        (
            "requirements-demo.txt",
            'open3d-cpu==0.20.0; platform_machine == "x86_64"',
            "open3d-cpu==0.20.0",
            "other machines",
        ),
        ("requirements-fleet.txt", "psycopg[binary]", "psycopg", "has other extras"),
        ("requirements-ros.txt", "ros-rclpy", "flask==3.0.0\nros-rclpy", "flask is not in pyproject.toml"),
        ("requirements-jazzy.txt", "numpy==1.26.4", "numpy==2.4.6", "numpy==1.26.4 is missing"),
        ("requirements-dev.txt", "-r requirements-lab.txt\n", "", "-r requirements-lab.txt is wrong"),
        ("pyproject.toml", '"rerun-sdk>=0.26"', '"rerun-sdk>=9"', "does not pin rerun-sdk>=9"),
    ],
)
def test_a_file_that_differs_is_named(tree: Path, name: str, old: str, new: str, finding: str) -> None:
    text = (tree / name).read_text()
    assert old in text
    (tree / name).write_text(text.replace(old, new))
    found = check(tree)
    assert found and finding in found[0]


def test_the_doctor_asks_for_the_lower_bounds() -> None:
    told = {check.args[1]: Version(check.args[2]) for _, check in checks() if len(getattr(check, "args", ())) > 2}
    bounds = requirements("dependencies", "torch", "lab")
    assert len(told) > 10
    for name, minimum in told.items():
        assert bounds[name.lower()].specifier.contains(minimum), f"{name}: {minimum}, {bounds[name.lower()]}"
