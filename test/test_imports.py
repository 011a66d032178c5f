"""Who may import what: the contracts of pyproject.toml, and what a fresh interpreter says to them."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

from sources import PACKAGE, ROOT, distributions, imports, required

STILL_SHARED = {
    *("Bag", "Calibration", "Embedding", "Entry", "Evidence", "Hits", "Picture", "PoseGraph", "Progress"),
    *("Scan", "Task", "Worker", "World"),
}
"""Names of classes that mean two things."""


def imported_after(statement: str, candidates: list[str]) -> list[str]:
    """Which of the candidates a fresh interpreter has loaded after the statement."""
    code = f"import sys\n{statement}\nprint(*[name for name in {candidates!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1].split()


def modules(room: str = "") -> list[str]:
    paths = sorted((PACKAGE / room).rglob("*.py"))
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths]


def runtime() -> list[str]:
    return [name for name in modules() if not name.startswith("umf_ros.lab.")]


def lab_packages() -> list[str]:
    """What can be imported of the distributions that only the lab asks for."""
    wanted = required("requirements-lab.txt")
    return [module for module, owners in distributions().items() if owners & wanted]


def test_the_contracts_hold() -> None:
    lint = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([lint, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout


def test_the_runtime_imports_without_the_lab() -> None:
    """With the lab and its packages not there, as on a rover."""
    missing = ["umf_ros.lab", *lab_packages()]
    assert "open3d" in missing and "sklearn" in missing
    block = (
        "class Missing:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if any((name + '.').startswith(gone + '.') for gone in {missing!r}):\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Missing())\n"
    )
    nodes = [name for name in runtime() if name.startswith("umf_ros.nodes.")]
    core = [name for name in runtime() if name not in nodes]
    no_ros = "assert 'rclpy' not in sys.modules, 'only nodes need ROS'"
    statements = [block, *(f"import {name}" for name in core), no_ros, *(f"import {name}" for name in nodes)]
    assert imported_after("\n".join(statements), [*missing, nodes[-1]]) == [nodes[-1]]


def test_the_runtime_asks_for_no_package_of_the_lab_later() -> None:
    unwanted = set(lab_packages())
    for name in runtime():
        path = ROOT / Path(*name.split(".")).with_suffix(".py")
        later = {module.split(".")[0] for module in imports(path)} & unwanted
        assert not later, f"{path} imports {later}"


def test_the_evaluation_imports_no_ros() -> None:
    statement = "\n".join(f"import {name}" for name in modules("lab/evaluation"))
    assert imported_after(statement, ["rclpy", "rclpy.node"]) == []


def test_help_imports_nothing_heavy() -> None:
    show_help = (
        "from umf_ros import cli\nsys.argv = ['umf', '--help']\ntry:\n    cli.main()\nexcept SystemExit:\n    pass"
    )
    assert imported_after(show_help, ["torch", "open3d", "gtsam", "cv2", "matplotlib", "rclpy", "scipy"]) == []


def test_only_nodes_import_rclpy() -> None:
    for path in PACKAGE.rglob("*.py"):
        if path.relative_to(PACKAGE).parts[0] != "nodes":
            assert not any(name.split(".")[0] == "rclpy" for name in imports(path)), path


def test_modules_are_imported_by_their_full_names() -> None:
    """So that a search for a module finds all who use it."""
    for path in [*PACKAGE.rglob("*.py"), *(ROOT / "benchmarks").glob("*.py")]:
        assert not re.search(r"^\s*from \.", path.read_text(), re.MULTILINE), path


def test_a_class_name_means_one_thing() -> None:
    names = [
        node.name
        for path in PACKAGE.rglob("*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    ]
    shared = {name for name, count in Counter(names).items() if count > 1}
    assert shared <= STILL_SHARED
