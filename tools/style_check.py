"""Check the prose of the tree: docstrings, comments, strings and pages follow a short list of rules.

Patterns: a sentence that begins with what, who or whoever; "nobody"; "of ours"; path length written as "way";
metaphors of buildings; states of a closure other than accepted, pending, rejected, refused. Code in backticks and in
fenced blocks of pages is not read. `--baseline` prints the number of findings by folder and exits with 0.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

RULES: dict[str, str] = {
    r"(?:^|(?<=[.!?] ))(?:What|Who|Whoever|Whom|Whose)\b(?![^.!?]*\?)": "a sentence begins with what, who or whoever",
    r"(?i)\bnobody\b": "nobody: name the subject",
    r"(?i)\bwhoever\b": "whoever: name the subject",
    r"(?i)\bof ours\b": "of ours: name the package",
    r"(?i)\b(?:metres|meters|m|km) of way\b|\bway travelled\b": "way: write path length",
    r"(?i)\b(?:this|the|our) house\b|\bhouse (?:rule|word)s?\b": "house: write architecture or package",
    r"(?i)\b(?:honesty|retrials?|foresees?|confess(?:es)?)\b": "write consistency, reprocess, prefetch, raise",
    r"(?i)\b(?:undecided|waiting) closures?\b|\bclosures? (?:is|are) (?:undecided|waiting)\b": "write pending closure",
}
"""Patterns and the sentence of each finding."""

SKIPPED = {"CHANGELOG.rst", "CHANGELOG.md", "tools/style_check.py", "LICENSE", "NOTICE"}
"""Files that quote older words, or whose text is fixed."""

Line = tuple[int, str]


def of_python(text: str) -> Iterator[Line]:
    """Comments and strings with the number of their line."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("#! ")
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            for offset, line in enumerate(node.value.splitlines()):
                yield node.lineno + offset, line.strip()


def of_page(text: str) -> Iterator[Line]:
    """Lines of a page outside fenced blocks."""
    fenced = False
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif not fenced:
            yield number, line.strip().lstrip("#>*- ")


def findings(path: Path) -> Iterator[str]:
    """One line per rule broken in a file."""
    text = path.read_text(encoding="utf-8")
    for number, line in of_python(text) if path.suffix == ".py" else of_page(text):
        prose = re.sub(r"`[^`]*`", "", line)
        for pattern, sentence in RULES.items():
            if re.search(pattern, prose):
                yield f"{path}:{number}: {sentence}: {line[:80]}"


def files(asked: list[str]) -> list[Path]:
    """Files named, or all Python files and pages under version control."""
    listed = asked or subprocess.check_output(["git", "ls-files", "*.py", "*.md", "*.yaml"], text=True).splitlines()
    return [Path(name) for name in listed if name not in SKIPPED and Path(name).is_file()]


def main() -> int:
    """Print the findings; 1 if there are any."""
    parser = argparse.ArgumentParser(description="Check the prose of docstrings, comments, strings and pages.")
    parser.add_argument("paths", nargs="*", help="files; by default all of the tree")
    parser.add_argument("--baseline", action="store_true", help="print the number of findings by folder, exit with 0")
    arguments = parser.parse_args()
    found = [(path, one) for path in files(arguments.paths) for one in dict.fromkeys(findings(path))]
    if arguments.baseline:
        for folder, number in sorted(Counter("/".join(path.parts[:2]) for path, _ in found).items()):
            print(f"{folder:40} {number:5}")
        print(f"{'all':40} {len(found):5}")
        return 0
    for _, one in found:
        print(one)
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
