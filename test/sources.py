"""Sources of the package, read and not run; commands and tables of tests."""

from __future__ import annotations

import ast
import csv
import subprocess
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "umf_ros"


def imports(path: Path) -> list[str]:
    """Every module that a file imports, in functions too."""
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names.append(node.module or "")
    return names


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file by column."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def requirements(*parts: str) -> dict[str, Requirement]:
    """Requirements of `dependencies` and of extras in pyproject.toml, by their names in lower case."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    listed = {"dependencies": project["dependencies"], **project["optional-dependencies"]}
    return {one.name.lower(): one for part in parts for one in map(Requirement, listed[part])}


def run(*command: Any, timeout: float = 60, **options: Any) -> subprocess.CompletedProcess[str]:
    """A command that has ended, well or not, with its output."""
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=timeout, **options)


@cache
def distributions() -> dict[str, set[str]]:
    """Names, in lower case, of the distributions that each installed module comes from."""
    return {module: {name.lower() for name in names} for module, names in packages_distributions().items()}
