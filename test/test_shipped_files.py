"""Where an installed package and a checkout find their files."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
from sources import run

import umf_ros
from umf_ros.core.errors import UmfError
from umf_ros.core.resources import find, share_folders

PACKAGE = Path(umf_ros.__file__).parent
CONFIG = "config/calibration/simulated.yaml"


def install(site_packages: Path) -> None:
    """The part of the package that finds files, as pip and colcon install it."""
    target = site_packages / "umf_ros"
    (target / "core").mkdir(parents=True)
    for name in ("__init__.py", "core/__init__.py", "core/errors.py", "core/resources.py"):
        shutil.copy(PACKAGE / name, target / name)


def found_by(site_packages: Path, relative: str) -> str:
    """Where a fresh interpreter with this installation finds a file, or what it says."""
    code = (
        "import sys\nfrom umf_ros.core.resources import find\nfrom umf_ros.core.errors import UmfError\n"
        "try:\n    print(find(sys.argv[1]))\nexcept UmfError as error:\n    print(error)"
    )
    done = run(sys.executable, "-c", code, relative, env={"PYTHONPATH": str(site_packages)}, cwd=site_packages)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("relative", [CONFIG, "models/umf_scene.safetensors", "config/loop_closure.yaml", "models"])
def test_a_checkout_uses_its_own_files(relative: str) -> None:
    assert find(relative) == PACKAGE.parent / relative
    assert find(relative).exists()


def test_the_models_together_stay_small_enough_to_ship() -> None:
    assert sum(path.stat().st_size for path in find("models").iterdir()) < 60_000_000


def test_what_is_not_there_is_one_clear_line() -> None:
    with pytest.raises(UmfError) as caught:
        find("config/nothing.yaml")
    assert str(caught.value) == "config/nothing.yaml is not installed with umf_ros; reinstall the package"


def test_the_checkout_comes_before_what_is_installed() -> None:
    folders = share_folders()
    assert folders[0] == PACKAGE.parent and folders[-1] == Path(sys.prefix) / "share" / "umf_ros"


@pytest.mark.parametrize("library", ["lib/python3.12/site-packages", "local/lib/python3.12/dist-packages"])
def test_an_installation_finds_its_share_folder(tmp_path: Path, library: str) -> None:
    install(tmp_path / library)
    share = tmp_path / "share" / "umf_ros" / "config" / "calibration"
    share.mkdir(parents=True)
    (share / "simulated.yaml").write_text("")
    assert found_by(tmp_path / library, CONFIG) == str(share / "simulated.yaml")


def test_the_nearest_of_two_installations_is_used(tmp_path: Path) -> None:
    """A workspace on top of an installed distribution brings its own files."""
    inner = tmp_path / "workspace" / "install"
    install(inner / "lib" / "python3.12" / "site-packages")
    for prefix in (tmp_path, inner):
        (prefix / "share" / "umf_ros" / "models").mkdir(parents=True)
        (prefix / "share" / "umf_ros" / "models" / "a.safetensors").write_text(prefix.name)
    found = found_by(inner / "lib" / "python3.12" / "site-packages", "models/a.safetensors")
    assert Path(found).read_text(encoding="utf-8") == "install"


def test_an_installation_without_its_files_says_so(tmp_path: Path) -> None:
    install(tmp_path / "lib" / "python3.12" / "site-packages")
    told = found_by(tmp_path / "lib" / "python3.12" / "site-packages", "config/no_such_file.yaml")
    assert told == "config/no_such_file.yaml is not installed with umf_ros; reinstall the package"
