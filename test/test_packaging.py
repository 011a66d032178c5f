"""The package as a Jazzy workspace sees it: built by colcon, its executables started."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from processes import Process
from sources import PACKAGE, ROOT, distributions, imports, requirements, run

from umf_ros.core.resources import LAB_PACKAGES

PARTS = ["package.xml", "pyproject.toml", "setup.py", "setup.cfg", "README.md", "NOTICE", "umf_ros", "resource"]
PARTS += ["config", "launch", "models", "tools"]
MODULES = {"tf2_ros_py": ["tf2_ros"], "tf2_ros": []}
"""Modules of packages that have other names: tf2_ros is a library of C++."""
ELSEWHERE = {"rerun": "rerun-sdk"}
"""Distributions of modules that not every machine has: this one asks for NumPy 2."""
TEMPLATE = Path("runs", "templates", "planted.html.j2")


def built(workspace: Path, *options: str) -> Path:
    """The package as colcon installs it from a copy of its sources."""
    source = workspace / "src" / "umf_ros"
    source.mkdir(parents=True)
    for part in PARTS:
        copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
        copy(ROOT / part, source / part)
    template = source / "umf_ros" / TEMPLATE
    template.parent.mkdir(exist_ok=True)
    template.write_text("")
    tools = Path(sys.executable).parent
    path = f"{tools}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "AMENT_PREFIX_PATH": str(Path(sys.prefix))}
    command = ["colcon", "build", *options]
    done = run(*command, cwd=workspace, env=environment, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return workspace / "install" / "umf_ros"


@pytest.fixture(scope="module")
def install(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("workspace"))


def test_a_workspace_of_links_has_the_same_executables(install: Path, tmp_path: Path) -> None:
    """`colcon build --symlink-install` builds beside links to the sources, without pyproject.toml."""
    linked = built(tmp_path, "--symlink-install")
    for folder in ("bin", "lib/umf_ros", "share/umf_ros/launch", "share/umf_ros/models"):
        there, here = ({path.name for path in (one / folder).iterdir()} for one in (linked, install))
        assert there == here
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    places = os.environ | {"PATH": path, "COLCON_CURRENT_PREFIX": str(linked)}
    done = run("bash", "-c", f". {linked}/share/umf_ros/package.sh && umf --version", env=places)
    assert done.stdout.startswith("umf_ros "), done.stderr


def test_everything_is_installed_to_share(install: Path) -> None:
    share = install / "share" / "umf_ros"
    for path in (
        "package.xml",
        "NOTICE",
        "config/loop_closure.yaml",
        "config/loop_closure.rviz",
        "config/foxglove_layout.json",
        "config/calibration/simulated.yaml",
        "config/calibration/s3li_etna.yaml",
        "launch/loop_closure.launch.py",
        "models/umf_scene.openvino",
        "models/umf_scene.safetensors",
        "models/umf_scene.json",
        "models/xfeat.openvino",
        "models/xfeat.safetensors",
        "models/xfeat.json",
    ):
        assert (share / path).is_file(), path
    assert (install / "share" / "ament_index" / "resource_index" / "packages" / "umf_ros").is_file()


def started(install: Path, executable: str) -> list[str]:
    """A command that starts an installed executable as `ros2 run` does."""
    setup = f". {install}/share/umf_ros/package.sh && exec {install}/lib/umf_ros/{executable}"
    environment = f"PATH={Path(sys.executable).parent}:$PATH COLCON_CURRENT_PREFIX={install}"
    return ["bash", "-c", f"export {environment}; {setup}"]


@pytest.mark.parametrize("executable", ["loop_closure_node", "pose_graph_node"])
def test_the_installed_executables_run(install: Path, executable: str, tmp_path: Path) -> None:
    process = Process("", tmp_path / "node.log", command=started(install, executable))
    try:
        process.wait_for("waiting for topics")  # no parameter names one
        assert process.interrupt() == 0
    finally:
        process.kill()


def test_the_installed_player_asks_for_its_recording(install: Path) -> None:
    command = started(install, "bag_player_node nowhere.mcap")
    done = run(*command)
    assert (done.returncode, done.stderr) == (1, "umf: there is no recording nowhere.mcap\n")


def test_package_xml_names_what_is_imported() -> None:
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.get("format") == "3"
    assert package.findtext("export/build_type") == "ament_python"
    depends = {element.text for element in package.iter("exec_depend")}
    imported = {
        line.split()[1].split(".")[0]
        for path in [*PACKAGE.glob("nodes/*.py"), *PACKAGE.glob("lab/live/*.py")]
        for line in path.read_text().splitlines()
        if line.startswith("from ") and (".msg import" in line or ".srv import" in line)
    }
    assert imported <= depends, imported - depends


def installed_package(install: Path) -> Path:
    return next(install.glob("lib/python*/site-packages/umf_ros"))


def test_the_version_is_that_of_package_xml(install: Path) -> None:
    written = ElementTree.parse(ROOT / "package.xml").getroot().findtext("version")
    show = "import umf_ros; print(umf_ros.__version__, umf_ros.__file__)"
    for place in (ROOT, installed_package(install).parent):
        done = run(sys.executable, "-c", show, cwd=place, env={})
        assert done.stdout.split() == [written, str(place / "umf_ros" / "__init__.py")]


def test_what_is_not_python_is_installed_with_the_package(install: Path) -> None:
    files = [path for path in PACKAGE.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")]
    for path in [TEMPLATE, *(path.relative_to(PACKAGE) for path in files)]:
        assert (installed_package(install) / path).is_file(), path


@pytest.mark.parametrize(
    ("wing", "lists"),
    [("runtime", ["dependencies", "elevation", "fleet", "rerun", "torch"]), ("lab", ["dependencies", "lab", "las"])],
)
def test_what_is_imported_is_required(wing: str, lists: list[str]) -> None:
    """Every distribution by its own name: what another one happens to bring along may be gone tomorrow."""
    lab = PACKAGE / "lab"
    paths = [path for path in PACKAGE.rglob("*.py") if (lab in path.parents) == (wing == "lab")]
    imported = {name.split(".")[0] for path in paths for name in imports(path)}
    depends = [element.text or "" for element in ElementTree.parse(ROOT / "package.xml").iter("exec_depend")]
    ros = {module for name in depends for module in MODULES.get(name, [name])}
    for module in imported - {"umf_ros", *sys.stdlib_module_names} - ros:
        assert distributions().get(module, {ELSEWHERE.get(module, module)}) & requirements(*lists).keys(), (
            f"{module} is imported but not in {' or '.join(lists)}"
        )


@pytest.mark.parametrize(
    ("module", "advice"),
    [
        ("open3d", "the lab needs it: run pip install 'umf_ros[lab]'"),
        # it is the lab that asks, but its extra would not bring this one
        ("cv2", "run umf doctor for a remedy"),
    ],
)
def test_a_package_that_is_missing_is_asked_for_in_one_line(module: str, advice: str, tmp_path: Path) -> None:
    missing = f"import sys; sys.modules[{module!r}] = None; from umf_ros import cli; cli.main()"
    done = run(sys.executable, "-c", missing, "simulate", tmp_path / "a.mcap")
    assert done.returncode == 1
    assert done.stderr == f"umf: {module} is not installed; {advice}\n"
    assert list(tmp_path.iterdir()) == []


def test_the_packages_of_the_lab_are_those_of_its_extra() -> None:
    listed = requirements("lab").keys() - {"open3d-cpu", "torch"}  # open3d without CUDA on x86-64; torch is of no wing
    assert {distribution for distribution, _ in LAB_PACKAGES.values()} == listed


def test_the_parameter_documentation_is_up_to_date() -> None:
    done = run(sys.executable, ROOT / "tools" / "parameters_doc.py", "--check")
    assert done.returncode == 0, done.stderr
