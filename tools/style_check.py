"""Check the prose of the tree: docstrings, comments, strings and pages follow a short list of rules.

Patterns: a sentence that begins with what, who or whoever; "nobody"; "of ours"; path length written as "way";
metaphors of buildings; states of a closure other than accepted, pending, rejected, refused. Questions may begin with
what; code in backticks, fenced blocks of pages and strings of one word are not read. `--baseline` prints the number of
findings by folder, of the whole tree, and exits with 0.
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
    r"(?:^|(?<=[.!?:]\s)|(?<=\n\n))(?:What|Who|Whoever|Whom|Whose)\b(?![^.!?]*\?)": "a sentence begins with what, who",
    r"(?i)\bnobody\b": "nobody: name the subject",
    r"(?i)\bwhoever\b": "whoever: name the subject",
    r"(?i)\bof ours\b": "of ours: name the package",
    r"(?i)\b(?:metres|meters|m|km) of way\b|\bway travelled\b": "way: write path length",
    r"(?i)\b(?:this|the|our) house\b|\bhouse (?:rule|word)s?\b": "house: write architecture or package",
    r"(?i)\b(?:honesty|retrials?|foresees?|confess(?:es)?)\b": "write consistency, reprocess, prefetch, raise",
    r"(?i)\b(?:undecided|waiting) closures?\b|\bclosures? (?:is|are) (?:undecided|waiting)\b": "write pending closure",
}
"""Patterns and the sentence of each finding."""

SKIPPED = {"CHANGELOG.rst", "CHANGELOG.md", "tools/style_check.py", "test/test_style_check.py", "LICENSE", "NOTICE"}
"""Files that quote older words, or whose text is fixed."""

Block = tuple[int, str]
"""Number of the first line, and lines that belong together: a comment, a string, a paragraph."""


def of_python(text: str) -> Iterator[Block]:
    """Comments, with the lines that follow them, and strings of more than one word."""
    comment: list[str] = []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            comment.append(token.string.lstrip("#:! "))
            last = token.start[0]
        elif comment and token.type not in (tokenize.NL, tokenize.NEWLINE):
            yield last - len(comment) + 1, "\n".join(comment)
            comment = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value.strip():
            yield node.lineno, "\n".join(line.strip() for line in node.value.splitlines())


def of_page(text: str) -> Iterator[Block]:
    """Paragraphs, items of lists and rows of tables, outside fenced blocks."""
    fenced, first, block = False, 1, list[str]()
    for number, line in enumerate([*text.splitlines(), ""], 1):
        stripped = line.strip()
        fenced ^= stripped.startswith("```")
        if fenced or not stripped or stripped.startswith(("#", ">", "*", "-", "|", "```")):
            if block:
                yield first, "\n".join(block)
            first, block = number, []
        if not fenced and stripped and not stripped.startswith("```"):
            first = first if block else number
            block.append(stripped.lstrip("#>*-| "))


def findings(path: Path) -> Iterator[str]:
    """One line per rule broken in a file."""
    text = path.read_text(encoding="utf-8")
    for first, block in of_python(text) if path.suffix == ".py" else of_page(text):
        prose = re.sub(r"`[^`\n]*`", "``", block)
        for pattern, sentence in RULES.items():
            for match in re.finditer(pattern, prose):
                number = prose.count("\n", 0, match.start())
                yield f"{path}:{first + number}: {sentence}: {block.splitlines()[number][:80]}"


def files(asked: list[str]) -> list[Path]:
    """Python files and pages under version control: those of the paths named, else all."""
    listed = subprocess.check_output(["git", "ls-files", "--", *asked], text=True).splitlines()
    of_a_kind = [Path(name) for name in listed if name not in SKIPPED and name.endswith((".py", ".md", ".yaml"))]
    return [path for path in of_a_kind if path.is_file()]


def main() -> int:
    """Print the findings; 1 if there are any."""
    parser = argparse.ArgumentParser(description="Check the prose of docstrings, comments, strings and pages.")
    parser.add_argument("paths", nargs="*", help="files or folders; by default all")
    parser.add_argument("--baseline", action="store_true", help="print the number of findings by folder")
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
