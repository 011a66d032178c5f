"""Documents name what is there: files, classes with their methods, links and commands."""

from __future__ import annotations

import ast
import re

import pytest
import yaml
from sources import PACKAGE, ROOT

DOCUMENTS = ["README.md", "CONTRIBUTING.md", "docs/architecture.md", "docs/ros.md"]
WALK = "docs/architecture.md"


def text_of(document: str) -> str:
    return (ROOT / document).read_text(encoding="utf-8")


def classes() -> dict[str, set[str]]:
    """Methods and attributes of the package's public classes, by name."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")]
    found = [node for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)]
    return {node.name: {part.name for part in node.body if isinstance(part, ast.FunctionDef)} for node in found}


@pytest.mark.parametrize("document", DOCUMENTS)
def test_files_that_are_named_exist(document: str) -> None:
    named = re.findall(r"`((?:umf_ros|benchmarks|tools|config|docs|test|examples)/[\w/.]+)`", text_of(document))
    # NAME stands for what the reader calls it
    assert [name for name in named if not (ROOT / name).exists() and not name.split("/")[-1].startswith("NAME")] == []


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_somewhere(document: str) -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", text_of(document)) if not link.startswith("http")]
    assert links
    assert [link for link in links if not (ROOT / document).parent.joinpath(link).exists()] == []


def test_every_step_of_the_walk_is_a_class_of_the_package() -> None:
    known = classes()
    steps = re.findall(r"^\| \d+ \|(.*?)\|", text_of(WALK), re.MULTILINE)
    named = [pair for step in steps for pair in re.findall(r"`([A-Z]\w+)(?:\.(\w+))?`", step)]
    assert len(steps) == 13 and len(named) >= len(steps)
    assert [name for name, method in named if name not in known or (method and method not in known[name])] == []


def test_files_named_beside_a_room_are_in_it() -> None:
    """`rerank.py` in a step about `umf_ros/verification/verifier.py` is a file beside it."""
    for step in re.findall(r"^\| \d+ \|.*$", text_of(WALK), re.MULTILINE):
        room = re.search(r"`(umf_ros/[\w/]+)/\w+\.py`", step)
        for name in re.findall(r"`(\w+\.py)`", step):
            assert room and (ROOT / room[1] / name).exists(), name


def test_what_pre_commit_runs_is_what_lint_runs() -> None:
    hooks = yaml.safe_load(text_of(".pre-commit-config.yaml"))["repos"][0]["hooks"]
    lint = re.search(r"^lint:.*\n((?:\t.*\n)+)", text_of("Makefile"), re.MULTILINE)
    assert lint
    wanted = re.findall(r"\$\(BIN\)/([\w-]+)(?: (check|format))?", lint[1])
    given = [re.match(r"\.venv/bin/([\w-]+)(?: (check|format))?", hook["entry"]) for hook in hooks]
    assert [match.groups(default="") for match in given if match] == wanted


def test_the_changelog_has_the_version() -> None:
    (version,) = re.findall(r"<version>(.+)</version>", text_of("package.xml"))
    assert re.search(rf"^{re.escape(version)} \(\d{{4}}-\d\d-\d\d\)\n-+$", text_of("CHANGELOG.rst"), re.M)


def test_the_citation_is_a_citation() -> None:
    content = yaml.safe_load(text_of("CITATION.cff"))
    assert {"cff-version", "message", "title", "authors"} <= set(content)
    assert content["preferred-citation"]["authors"][0]["family-names"] == "García-Hernández"
    assert content["references"][0]["type"] == "thesis"


def test_every_source_that_is_cited_is_listed() -> None:
    text = "\n".join(path.read_text(encoding="utf-8") for path in [*PACKAGE.rglob("*.py"), *ROOT.glob("docs/**/*.md")])
    listed = set(re.findall(r"^- \*\*\[(.+?)\]\*\*", text_of("docs/references.md"), re.MULTILINE))
    cited = set(re.findall(r"\[([A-ZÀ-Ž][\w-]+ (?:19|20)\d\d)[\],]", text))
    assert "UMF" in listed and cited <= listed
    assert listed - {"UMF"} <= cited
