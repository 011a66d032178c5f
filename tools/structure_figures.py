"""Figures of the package's structure, beside the limits of its architecture and a record that only ever falls.

python tools/structure_figures.py [CHECKOUT ...]    print them, one column for each checkout; default: this one
python tools/structure_figures.py --check           fail where a figure is above the record, as `make lint` does
python tools/structure_figures.py --record          take lower figures into the record

Code lines are those without blank lines, comments, docstrings and imports. The runtime is the package without `lab` and
`baselines`. Imported files are all that a module imports, directly or not, the module itself and late imports included.
Words of the documentation are those of the README and of `docs` without `docs/history`.
"""

from __future__ import annotations

import ast
import io
import json
import re
import subprocess
import sys
import tokenize
from pathlib import Path

import grimp

PACKAGE = "umf_ros"
NOT_RUNTIME = ("lab", "baselines")
RECORDS = ("Candidate", "Hypothesis", "LoopClosure", "ClosureVerdict", "ClosureDiagnosis")
"""Records that one pair of keyframes passes through; `Keyframe` is the sixth."""
ENTRY_POINTS = {"detector": "detector", "front-end": "nodes.loop_closure_node", "back-end": "nodes.pose_graph_node"}
RECORD = Path(__file__).with_name("structure_record.json")
LIMITS = {
    "runtime: code lines": 11_000,
    "runtime: files": 100,
    "runtime: classes": 170,
    "verification, submaps, scan: code lines": 1_500,
    "kernels: code lines of C++": 900,
    "verification, submaps: numeric constants": 50,
    "files imported by the detector": 35,
    "files imported by the front-end": 60,
    "files imported by the back-end": 40,
    "largest class: lines": 250,
    "largest class: members": 20,
    "most parameters of a function": 7,
    "uses of private members in tests": 30,
    "lab: lines": 18_000,
    "benchmarks: lines": 4_000,
    "tests: lines": 32_000,
    "docs: words": 20_000,
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

    def classes_of(self, files: list[Path]) -> list[ast.ClassDef]:
        """Classes of files, also those inside others."""
        return [node for path in files for node in ast.walk(self.trees[path]) if isinstance(node, ast.ClassDef)]

    def constants(self, files: list[Path]) -> int:
        """Names at the top of modules that stand for a number or for several."""
        return sum(len(_numeric_names(node)) for path in files for node in self.trees[path].body)

    def imported(self, name: str) -> int:
        """Files of the package that a module imports, itself included."""
        return len(self.graph.find_upstream_modules(f"{PACKAGE}.{name}")) + 1

    def parameters(self, files: list[Path]) -> int:
        """Most parameters of a function, without self and options of a command."""
        found = 0
        for path in files:
            for node in ast.walk(self.trees[path]):
                if isinstance(node, ast.FunctionDef) and not node.decorator_list and _part_of(path) != "commands":
                    named = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                    found = max(found, sum(one.arg not in ("self", "cls") for one in named))
        return found

    def records(self) -> int:
        """Records for one pair of keyframes."""
        defined = {node.name for node in self.classes_of(self.within())}
        return 1 + len(defined & set(RECORDS))

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
    """Figures by name, every row of the table of limits and the sizes of the packages."""
    runtime = checkout.within()
    verification, geometry = checkout.within("verification", "submaps"), checkout.within("scan")
    classes = checkout.classes_of(runtime)
    outside = checkout.root.parent
    tests = sorted((outside / "test").rglob("*.py"))
    kernels = sum(cpp_lines(path.read_text(encoding="utf-8")) for path in checkout.root.rglob("*.[ch]pp"))
    found = {
        "runtime: code lines": code_lines(runtime) + kernels,
        "runtime: files": len(runtime),
        "runtime: classes": len(classes),
        "verification, submaps, scan: code lines": code_lines(verification + geometry),
        "kernels: code lines of C++": kernels,
        "verification, submaps: numeric constants": checkout.constants(verification),
        **{f"files imported by the {name}": checkout.imported(module) for name, module in ENTRY_POINTS.items()},
        "largest class: lines": max((node.end_lineno or 0) - node.lineno + 1 for node in classes),
        "largest class: members": max(len(_members(node)) for node in classes),
        "most parameters of a function": checkout.parameters(runtime),
        "uses of private members in tests": sum(_private_uses(path) for path in tests),
        "lab: lines": lines(checkout.within("lab")),
        "benchmarks: lines": lines(sorted((outside / "benchmarks").rglob("*.py"))),
        "tests: lines": lines(tests),
        "docs: words": words(pages(outside)),
        "records for one pair of keyframes": checkout.records(),
        "largest complexity": checkout.complexity(),
        "imports of the lab or the baselines by the runtime": checkout.forbidden_imports(),
    }
    packages = sorted({_top(checkout.root, path) for path in runtime if path.parent != checkout.root})
    return found | {f"{name}: code lines": code_lines(checkout.within(name)) for name in packages}


def lines(paths: list[Path]) -> int:
    """Lines of files."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def pages(root: Path) -> list[Path]:
    """Pages that a user reads: the README and `docs` without `docs/history`."""
    return [root / "README.md", *sorted((root / "docs").glob("*.md"))]


def words(paths: list[Path]) -> int:
    """Words of files, as `wc -w` counts them."""
    return sum(len(path.read_text(encoding="utf-8").split()) for path in paths)


def code_lines(paths: list[Path]) -> int:
    """Code lines of Python files."""
    return sum(_code_lines(path.read_text(encoding="utf-8")) for path in paths)


def cpp_lines(text: str) -> int:
    """Code lines of C++: without blank lines, comments and includes."""
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    return sum(bool(line.strip()) and not line.strip().startswith(("//", "#")) for line in text.splitlines())


_SILENT = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)


def _code_lines(text: str) -> int:
    left_out = set()
    for node in ast.walk(ast.parse(text)):
        is_text = (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        )
        if is_text or isinstance(node, (ast.Import, ast.ImportFrom)):
            left_out |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    spans = [range(token.start[0], token.end[0] + 1) for token in tokens if token.type not in _SILENT]
    return len({number for span in spans for number in span} - left_out)


def _members(node: ast.ClassDef) -> set[str]:
    """Methods of a class, its fields and the attributes that it sets on itself."""
    names = {one.name for one in node.body if isinstance(one, ast.FunctionDef)}
    names |= {one.target.id for one in node.body if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)}
    for one in ast.walk(node):
        is_own = isinstance(one, ast.Attribute) and isinstance(one.value, ast.Name) and one.value.id == "self"
        if is_own and isinstance(one.ctx, ast.Store):
            names.add(one.attr)
    return names


def _private_uses(path: Path) -> int:
    """Uses of private members of other objects, as `found._rows`."""
    nodes = (node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Attribute))
    private = (node for node in nodes if re.match(r"_[a-z]", node.attr) and not node.attr.startswith("_replace"))
    return sum(not (isinstance(node.value, ast.Name) and node.value.id in ("self", "os")) for node in private)


def _part_of(path: Path) -> str:
    return next((part for part in path.parts if part in ("commands", "nodes")), "")


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


def above(found: dict[str, int], record: dict[str, int]) -> list[str]:
    """A sentence for every figure that is above the record."""
    return [f"{name}: {found[name]:,}, more than {most:,}" for name, most in record.items() if found[name] > most]


def main(arguments: list[str]) -> int:
    """Print the figures, check them against the record, or lower the record."""
    folders = [Path(word) for word in arguments if not word.startswith("-")] or [Path(__file__).parents[1]]
    columns = [figures(Checkout(folder)) for folder in folders]
    found = columns[-1]
    record: dict[str, int] = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}
    if "--check" in arguments:
        worse = above(found, record)
        for sentence in worse:
            sys.stdout.write(f"tools/structure_record.json: {sentence}\n")
        return bool(worse)
    if "--record" in arguments:
        lower = {name: min(found[name], record.get(name, found[name])) for name in LIMITS}
        RECORD.write_text(json.dumps(lower, indent=2) + "\n", encoding="utf-8")
    for name in found:
        limit = f"{LIMITS[name]:>8,}" if name in LIMITS else " " * 8
        values = [f"{column[name]:>8,}" for column in columns]
        over = "  over" if name in LIMITS and found[name] > LIMITS[name] else ""
        sys.stdout.write(f"{name:52} {' '.join(values)} | limit {limit}{over}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
