"""Sources of the package, read and not run."""

from __future__ import annotations

import ast
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "umf_ros"


def imports(path: Path) -> list[str]:
    """Every module that a file imports, in functions too."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names.append(node.module or "")
    return names


def required(*lists: str) -> set[str]:
    """Names of the distributions in requirements files, in lower case."""
    lines = [line for name in lists for line in (ROOT / name).read_text().splitlines()]
    return {line.split("==")[0].split("[")[0].lower() for line in lines if line and line[0] != "#"}


@cache
def distributions() -> dict[str, set[str]]:
    """Names, in lower case, of the distributions that each installed module comes from."""
    return {module: {name.lower() for name in names} for module, names in packages_distributions().items()}
