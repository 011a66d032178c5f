"""Which room may import what."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "umf_ros"
CORE = ["networks", "places", "verification", "pose_graph", "runs", "lab/evaluation"]


def imported_after(statement: str, candidates: list[str]) -> list[str]:
    """Which of the candidates a fresh interpreter has loaded after the statement."""
    code = f"import sys\n{statement}\nprint(*[name for name in {candidates!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    return done.stdout.splitlines()[-1].split()


def modules(room: str) -> list[str]:
    paths = sorted((PACKAGE / room).rglob("*.py"))
    return [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in paths]


@pytest.mark.parametrize("room", CORE)
def test_the_core_imports_no_ros(room: str) -> None:
    statement = "\n".join(f"import {name}" for name in modules(room))
    assert imported_after(statement, ["rclpy", "rclpy.node"]) == []


def test_help_imports_nothing_heavy() -> None:
    show_help = (
        "from umf_ros import cli\nsys.argv = ['umf', '--help']\ntry:\n    cli.main()\nexcept SystemExit:\n    pass"
    )
    assert imported_after(show_help, ["torch", "open3d", "gtsam", "cv2", "matplotlib", "rclpy", "scipy"]) == []


def test_only_nodes_import_rclpy() -> None:
    for path in PACKAGE.rglob("*.py"):
        room = path.relative_to(PACKAGE).parts[0]
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in names:
                if room != "nodes":
                    assert not name.startswith("rclpy"), f"{path} imports {name}"
