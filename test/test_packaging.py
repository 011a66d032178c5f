"""The package as a Jazzy workspace sees it: built by colcon, its executables started."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from processes import Process

ROOT = Path(__file__).parents[1]
PARTS = ["package.xml", "setup.py", "setup.cfg", "umf_ros", "resource", "config", "launch", "models"]


@pytest.fixture(scope="module")
def install(tmp_path_factory: pytest.TempPathFactory) -> Path:
    workspace = tmp_path_factory.mktemp("workspace")
    source = workspace / "src" / "umf_ros"
    source.mkdir(parents=True)
    for part in PARTS:
        copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
        copy(ROOT / part, source / part)
    tools = Path(sys.executable).parent
    path = f"{tools}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "AMENT_PREFIX_PATH": str(Path(sys.prefix))}
    done = subprocess.run(
        ["colcon", "build"], cwd=workspace, env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return workspace / "install" / "umf_ros"


def test_everything_is_installed_to_share(install: Path) -> None:
    share = install / "share" / "umf_ros"
    for path in (
        "package.xml",
        "config/loop_closure.yaml",
        "config/loop_closure.rviz",
        "config/calibration/simulated.yaml",
        "config/calibration/s3li_etna.yaml",
        "launch/loop_closure.launch.py",
        "models/umf_light.safetensors",
        "models/umf_light.json",
        "models/umf_resnet50.safetensors",
        "models/umf_resnet50.json",
    ):
        assert (share / path).is_file(), path
    assert (install / "share" / "ament_index" / "resource_index" / "packages" / "umf_ros").is_file()


@pytest.mark.parametrize("executable", ["loop_closure_node", "pose_graph_node"])
def test_the_installed_executables_run(install: Path, executable: str, tmp_path: Path) -> None:
    setup = f". {install}/share/umf_ros/package.sh && exec {install}/lib/umf_ros/{executable}"
    environment = f"PATH={Path(sys.executable).parent}:$PATH COLCON_CURRENT_PREFIX={install}"
    process = Process("", tmp_path / "node.log", command=["bash", "-c", f"export {environment}; {setup}"])
    try:
        process.wait_for("ready")
        assert process.interrupt() == 0
    finally:
        process.kill()


def test_package_xml_names_what_is_imported() -> None:
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.get("format") == "3"
    assert package.findtext("export/build_type") == "ament_python"
    depends = {element.text for element in package.iter("exec_depend")}
    imported = {
        line.split()[1].split(".")[0]
        for path in (ROOT / "umf_ros" / "nodes").glob("*.py")
        for line in path.read_text().splitlines()
        if line.startswith("from ") and (".msg import" in line or ".srv import" in line)
    }
    assert imported <= depends, imported - depends


def test_versions_agree() -> None:
    from umf_ros import __version__

    assert ElementTree.parse(ROOT / "package.xml").getroot().findtext("version") == __version__
    assert f'version="{__version__}"' in (ROOT / "setup.py").read_text()


def test_the_parameter_documentation_is_up_to_date() -> None:
    command = [sys.executable, str(ROOT / "tools" / "parameters_doc.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
