"""Print the figures of the package's structure beside their limits, one column for each checkout.

python tools/structure_figures.py [CHECKOUT ...]    default: this one; the newest comes last

Lines are those of the files as `ruff format` leaves them. The runtime is the package without `lab` and `baselines`.
Imported files are all that a module imports, directly or not, the module itself and late imports included.
"""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import grimp

PACKAGE = "umf_ros"
NOT_RUNTIME = ("lab", "baselines")
RECORDS = ("Candidate", "Hypothesis", "LoopClosure", "ClosureVerdict", "ClosureDiagnosis")
"""Records that one pair of keyframes passes through; `Keyframe` is the sixth."""
SECOND_EDITION_RECORDS = (
    *("Candidate", "RankedCandidate", "Hypothesis", "AlignedHypothesis", "Measurement", "JudgedHypothesis", "Verdict"),
    *("TestedCandidate", "Pair", "LoopClosure", "WaitingClosure", "TrackedClosure", "GraphVerdict", "JudgedClosure"),
    *("Why", "ScenePair"),
)
ENTRY_POINTS = {
    "detector": ("detector", "loop_detector"),
    "live front-end": ("nodes.loop_closure_node",),
    "back-end node": ("nodes.pose_graph_node",),
}
"""Modules by their names, the present one first."""
LIMITS = {
    "runtime: lines": 20_000,
    "runtime: files": 130,
    "runtime: classes": 230,
    "verification: lines": 2_700,
    "verification: numeric constants": 90,
    "pose_graph: lines": 2_000,
    "runs: lines": 2_600,
    "sensors: lines": 2_000,
    "places: lines": 700,
    "embedding + networks: lines": 2_300,
    "lab: files": 90,
    "imported by the detector: files": 50,
    "imported by the live front-end: files": 75,
    "imported by the back-end node: files": 50,
    "records for one pair of keyframes": 6,
    "largest complexity": 10,
    "imports of the lab or the baselines by the runtime": 0,
}


class Checkout:
    """The package as it stands in one checkout of the repository."""

    def __init__(self, folder: Path) -> None:
        self.root = folder.resolve() / PACKAGE
        self.files = sorted(self.root.rglob("*.py"))
        self.trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in self.files}
        sys.path.insert(0, str(folder.resolve()))
        self.graph = grimp.build_graph(PACKAGE, cache_dir=None)
        sys.path.pop(0)

    def within(self, *packages: str) -> list[Path]:
        """Files of packages or modules at the top of the package; of the runtime without a name."""
        if packages:
            return [path for path in self.files if _top(self.root, path) in packages]
        return [path for path in self.files if _top(self.root, path) not in NOT_RUNTIME]

    def classes(self, files: list[Path]) -> int:
        """Classes of files, also those inside others."""
        return sum(isinstance(node, ast.ClassDef) for path in files for node in ast.walk(self.trees[path]))

    def constants(self, files: list[Path]) -> int:
        """Names at the top of modules that stand for a number or for several."""
        return sum(len(_numeric_names(node)) for path in files for node in self.trees[path].body)

    def imported(self, names: tuple[str, ...]) -> int:
        """Files of the package that the first of these modules that exists imports, itself included."""
        module = next(f"{PACKAGE}.{name}" for name in names if f"{PACKAGE}.{name}" in self.graph.modules)
        return len(self.graph.find_upstream_modules(module)) + 1

    def records(self) -> int:
        """Records for one pair of keyframes: those of `RECORDS`, or of the second edition where those are there."""
        defined = {
            node.name for path in self.within() for node in ast.walk(self.trees[path]) if isinstance(node, ast.ClassDef)
        }
        return 1 + len(defined & {*RECORDS, *SECOND_EDITION_RECORDS} - {"Keyframe"})

    def complexity(self) -> int:
        """The largest cyclomatic complexity of a function."""
        limit = ["--select", "C901", "--config", "lint.mccabe.max-complexity=0"]
        ruff = [Path(sys.executable).with_name("ruff"), "check", "--isolated", "--output-format", "json", *limit]
        found = subprocess.run([*ruff, self.root], capture_output=True, text=True, check=False)
        matches = (re.search(r"\((\d+) > 0\)", finding["message"]) for finding in json.loads(found.stdout))
        return max(int(match[1]) for match in matches if match)

    def forbidden_imports(self) -> int:
        """Imports of the lab or the baselines by modules of the runtime."""
        return sum(
            _part(imported) in NOT_RUNTIME and _part(importer) not in NOT_RUNTIME
            for importer in self.graph.modules
            for imported in self.graph.find_modules_directly_imported_by(importer)
        )


def figures(checkout: Checkout) -> dict[str, int]:
    """Figures by name, every row of the table of limits and the sizes of the other packages."""
    runtime, verification = checkout.within(), checkout.within("verification", "submaps")
    found = {
        "runtime: lines": lines(runtime),
        "runtime: files": len(runtime),
        "runtime: classes": checkout.classes(runtime),
        "verification: lines": lines(verification),
        "verification: numeric constants": checkout.constants(verification),
        **{f"{name}: lines": lines(checkout.within(name)) for name in ("pose_graph", "runs", "sensors", "places")},
        "embedding + networks: lines": lines(checkout.within("embedding", "networks")),
        "lab: files": len(checkout.within("lab")),
        **{f"imported by the {name}: files": checkout.imported(modules) for name, modules in ENTRY_POINTS.items()},
        "records for one pair of keyframes": checkout.records(),
        "largest complexity": checkout.complexity(),
        "imports of the lab or the baselines by the runtime": checkout.forbidden_imports(),
    }
    others = ("core", "bags", "maps", "fleet", "nodes", "commands", "lab", "baselines")
    found |= {f"{name}: lines": lines(checkout.within(name)) for name in others}
    found["longest file: lines"] = max(lines([path]) for path in checkout.files)
    return found


def lines(paths: list[Path]) -> int:
    """Lines of files."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def _top(root: Path, path: Path) -> str:
    return path.relative_to(root).parts[0].removesuffix(".py")


def _part(module: str) -> str:
    return [*module.split("."), ""][1]


def _numeric_names(node: ast.stmt) -> list[str]:
    """Names that a statement sets to numbers, or to an expression, tuple or table that holds some."""
    if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
        return []
    leaves = [leaf.value for leaf in ast.walk(node.value) if isinstance(leaf, ast.Constant)]
    if not any(isinstance(value, (int, float)) and not isinstance(value, bool) for value in leaves):
        return []
    if any(isinstance(part, ast.Call) for part in ast.walk(node.value)):
        return []  # a table of records, not a number
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]


if __name__ == "__main__":
    columns = [figures(Checkout(Path(name))) for name in sys.argv[1:] or [Path(__file__).parents[1]]]
    for name in columns[-1]:
        limit = f"{LIMITS[name]:>8,}" if name in LIMITS else " " * 8
        values = [f"{column[name]:>8,}" for column in columns]
        over = "  over" if name in LIMITS and columns[-1][name] > LIMITS[name] else ""
        sys.stdout.write(f"{name:52} {' '.join(values)} | limit {limit}{over}\n")
