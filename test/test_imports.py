"""Imports: the contracts of pyproject.toml, checked in a fresh interpreter too."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

from sources import PACKAGE, ROOT, distributions, imports, requirements

STILL_SHARED = {"PoseGraph", "World"}
"""Names of classes that mean two things."""


def imported_after(statement: str, candidates: list[str]) -> list[str]:
    """Which of the candidates a fresh interpreter has loaded after the statement."""
    code = f"import sys\n{statement}\nprint(*[name for name in {candidates!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1].split()


def modules(paths: list[Path]) -> list[str]:
    """Names of modules and packages by their files."""
    return [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths]


def runtime() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE).parts[0] != "lab")


LIGHT = [
    *(f"commands/{name}.py" for name in ("demo", "graph", "compare", "inspect", "report")),
    *(
        *(f"{name}.py" for name in ("scan_files", "imported", "importing", "lidar_sets")),
        "simulation/bag_writer.py",
        "datasets/g2o.py",
        "datasets/graph_recording.py",
        "datasets/graph_units.py",
        *(f"evaluation/{name}.py" for name in ("comparison", "place_views", "inspection")),
        "live/*.py",
    ),
]
"""Files of the lab that `pip install .` serves too: they inspect, play, judge and draw runs, recordings and graphs."""


def light() -> list[Path]:
    return [path for pattern in LIGHT for path in sorted((PACKAGE / "lab").glob(pattern))]


def without(missing: list[str]) -> str:
    """A statement after which these modules are not there, as on a rover."""
    return (
        "class Missing:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if any((name + '.').startswith(gone + '.') for gone in {missing!r}):\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Missing())\n"
    )


def lab_packages() -> list[str]:
    """Modules of the distributions that only the lab asks for."""
    wanted = requirements("lab").keys() - requirements("torch").keys()
    return [module for module, owners in distributions().items() if owners & wanted]


def test_the_contracts_hold() -> None:
    lint = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([lint, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout


def test_a_rover_on_its_own_needs_nothing_of_a_fleet() -> None:
    missing = ["psycopg", "pgvector", "ray", "umf_ros.fleet"]
    rooms = ["detector", "places.database", "replay", "commands.replay", "commands.stores", "nodes.loop_closure_node"]
    statements = [without(missing), *(f"import umf_ros.{room}" for room in rooms)]
    assert imported_after("\n".join(statements), [*missing, "umf_ros.replay"]) == ["umf_ros.replay"]


def test_the_runtime_imports_without_the_lab() -> None:
    missing = ["umf_ros.lab", *lab_packages()]
    assert "open3d" in missing and "sklearn" in missing
    nodes = [name for name in modules(runtime()) if name.startswith("umf_ros.nodes.")]
    core = [name for name in modules(runtime()) if name not in nodes]
    no_ros = "assert 'rclpy' not in sys.modules, 'only nodes need ROS'"
    statements = [without(missing), *(f"import {name}" for name in core), no_ros, *(f"import {name}" for name in nodes)]
    assert imported_after("\n".join(statements), [*missing, nodes[-1]]) == [nodes[-1]]


def test_recordings_are_played_and_graph_files_read_without_the_packages_of_the_lab() -> None:
    names = modules(light())
    assert len(names) == 20
    used = {name for path in light() for name in imports(path) if name.startswith("umf_ros.lab.")}
    assert used - {"umf_ros.lab.commands"} <= set(names)  # the demo, beside play, simulates first
    statements = [without(lab_packages()), *(f"import {name}" for name in names)]
    assert imported_after("\n".join(statements), [*lab_packages(), *names]) == names


def test_who_does_without_the_packages_of_the_lab_asks_for_none_later() -> None:
    unwanted = set(lab_packages())
    for path in [*runtime(), *light()]:
        later = {module.split(".")[0] for module in imports(path)} & unwanted
        assert not later, f"{path} imports {later}"


def test_the_evaluation_imports_no_ros() -> None:
    statement = "\n".join(f"import {name}" for name in modules(sorted((PACKAGE / "lab" / "evaluation").glob("*.py"))))
    assert imported_after(statement, ["rclpy", "rclpy.node"]) == []


def test_help_imports_nothing_heavy() -> None:
    show_help = (
        "from umf_ros import cli\nsys.argv = ['umf', '--help']\ntry:\n    cli.main()\nexcept SystemExit:\n    pass"
    )
    assert imported_after(show_help, ["torch", "open3d", "gtsam", "cv2", "faiss", "matplotlib", "rclpy", "scipy"]) == []


def test_a_rover_with_openvino_carries_no_torch() -> None:
    """Two hundred megabytes of the live front-end were a library that computed nothing."""
    statement = "import umf_ros.nodes.loop_closure_node, umf_ros.commands.replay, umf_ros.embedding.umf"
    statement += ", umf_ros.embedding.local_features, openvino"
    assert imported_after(statement, ["torch", "matplotlib", "open3d", "gtsam"]) == []


def test_only_nodes_and_what_plays_and_records_topics_import_rclpy() -> None:
    for path in PACKAGE.rglob("*.py"):
        if path.parent not in (PACKAGE / "nodes", PACKAGE / "lab" / "live"):
            assert not any(name.split(".")[0] == "rclpy" for name in imports(path)), path


def test_modules_are_imported_by_their_full_names() -> None:
    """So that a search for a module finds all who use it."""
    for path in [*PACKAGE.rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]:
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
