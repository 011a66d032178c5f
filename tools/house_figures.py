"""Print the figures of the package's structure, one column for each checkout.

python tools/house_figures.py [CHECKOUT ...]    default: this one; the newest comes last
"""

import ast
import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import grimp

PACKAGE = "umf_ros"
LAB = ("lab", "simulation", "datasets", "training", "evaluation")
"""Rooms of the lab; the last four stood beside the runtime's once."""


class House:
    """One checkout."""

    def __init__(self, checkout: Path) -> None:
        self.root = checkout.resolve() / PACKAGE
        self.files = sorted(self.root.rglob("*.py"))
        sys.path.insert(0, str(checkout.resolve()))
        self.graph = grimp.build_graph(PACKAGE, cache_dir=None)
        sys.path.pop(0)

    def wing(self, lab: bool) -> list[Path]:
        """Files of the lab or of the runtime."""
        return [path for path in self.files if (path.relative_to(self.root).parts[0] in LAB) == lab]

    def rooms(self, *names: str) -> str:
        """Files of rooms wherever they stand, without the empty `__init__`s; a room may have changed its name."""
        kept = [path.relative_to(self.root) for path in self.files if path.name != "__init__.py"]
        return str(sum(bool(set(path.parts) & set(names)) for path in kept))

    def arrows(self) -> set[tuple[str, str]]:
        """Which room imports from which."""
        pairs = {(_room(importer), _room(imported)) for importer, imported in self._imports()}
        return {(importer, imported) for importer, imported in pairs if importer != imported}

    def breakers(self) -> set[tuple[str, str]]:
        """Imports that would have to go for no two neighbours, rooms or modules, to be in a circle."""
        packages = [module for module in self.graph.modules if self.graph.find_children(module)]
        return {pair for package in packages for pair in self.graph.nominate_cycle_breakers(package)}

    def runtime_to_lab(self) -> list[tuple[str, str]]:
        """Imports of the lab by the runtime."""
        return [pair for pair in self._imports() if not _in_lab(pair[0]) and _in_lab(pair[1])]

    def shared_names(self) -> list[str]:
        """Names that several public classes have."""
        trees = [ast.parse(path.read_text(encoding="utf-8")) for path in self.files]
        names = [node.name for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)]
        return sorted(name for name, count in Counter(names).items() if count > 1 and name[0] != "_")

    def complexity(self) -> int:
        """The largest cyclomatic complexity of a function."""
        limit = ["--select", "C901", "--config", "lint.mccabe.max-complexity=0"]
        ruff = [Path(sys.executable).with_name("ruff"), "check", "--isolated", "--output-format", "json", *limit]
        found = subprocess.run([*ruff, self.root], capture_output=True, text=True, check=False)
        return max(int(re.search(r"\((\d+) > 0\)", finding["message"])[1]) for finding in json.loads(found.stdout))

    def _imports(self) -> list[tuple[str, str]]:
        return [
            (importer, imported)
            for importer in self.graph.modules
            for imported in self.graph.find_modules_directly_imported_by(importer)
        ]


def _room(module: str) -> str:
    """The room of a module: a package or module of the runtime or of the lab."""
    parts = module.split(".")
    return ".".join(parts[1:3] if parts[1:2] == ["lab"] else parts[1:2])


def _in_lab(module: str) -> bool:
    return _room(module).split(".")[0] in LAB


def lines(paths: list[Path]) -> int:
    """Lines of files."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def figures(house: House) -> dict[str, str]:
    """Figures by name."""
    runtime, lab, shared = house.wing(lab=False), house.wing(lab=True), house.shared_names()
    return {
        "runtime: files": str(len(runtime)),
        "runtime: lines": str(lines(runtime)),
        "lab: files": str(len(lab)),
        "lab: lines": str(lines(lab)),
        "pose_graph: files": house.rooms("pose_graph"),
        "verification: files": house.rooms("verification"),
        "runs + lab/evaluation: files": house.rooms("runs", "results", "evaluation"),
        "lab/training: files": house.rooms("training"),
        "modules at the top": str(len([path for path in house.root.glob("*.py") if path.name != "__init__.py"])),
        "longest file: lines": str(max(lines([path]) for path in house.files)),
        "largest complexity": str(house.complexity()),
        "class names that mean several things": f"{len(shared)} {' '.join(shared)}",
        "arrows between rooms": str(len(house.arrows())),
        "arrows upwards or in a circle": str(len(house.breakers())),
        "imports of the lab by the runtime": str(len(house.runtime_to_lab())),
    }


if __name__ == "__main__":
    columns = [figures(House(Path(name))) for name in sys.argv[1:] or [Path(__file__).parents[1]]]
    for name in columns[-1]:
        sys.stdout.write(" | ".join([f"{name:38}", *(f"{column[name]:>6}" for column in columns)]) + "\n")
