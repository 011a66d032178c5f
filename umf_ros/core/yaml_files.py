"""YAML files of anybody: read with limits, each name once, and one clear line where something is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from umf_ros.core.errors import ConfigError, one_line, shortened

LARGEST_YAML = 2**22
MOST_NODES = 100_000
"""A file of settings has some hundreds; aliases of aliases are how a small one stands for a thousand million."""


class _OnceLoader(yaml.SafeLoader):
    """Refuses a name that is given twice: the first value would be dropped without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = [str(getattr(key, "value", "")) for key, _ in node.value]
        twice = next((name for i, name in enumerate(names) if name in names[:i] and name != "<<"), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(None, None, f"{twice} is given twice", node.start_mark)
        return dict(super().construct_mapping(node, deep))


def is_yaml(path: Path) -> bool:
    """Whether a path names a YAML file, and not data."""
    return path.suffix in (".yaml", ".yml")


def read_yaml(path: Path) -> Any:
    """What a YAML file holds; None where it is empty.

    Raises:
        ConfigError: the file cannot be read.
    """
    try:
        with path.open(encoding="utf-8") as file:  # also a pipe, whose size nobody knows
            text = file.read(LARGEST_YAML + 1)
        if len(text) > LARGEST_YAML:
            raise ConfigError(f"{path} is not valid YAML: larger than {LARGEST_YAML >> 20} MB")
        _count_nodes(yaml.compose(text, yaml.SafeLoader), {})
        return yaml.load(text, _OnceLoader)
    except ConfigError:
        raise
    except OSError as error:
        raise ConfigError(f"cannot read {shortened(path)}: {error.strerror}") from None
    except Exception as error:  # the library raises anything on a tag that its value does not fit
        raise ConfigError(f"{shortened(path)} is not valid YAML: {one_line(error)}") from None


def _count_nodes(node: yaml.Node | None, known: dict[int, int]) -> int:
    """Nodes of a document with every alias written out.

    Raises:
        ValueError: they are too many, or a node is its own part.
    """
    if id(node) in known:
        if not known[id(node)]:
            raise ValueError("a part of it contains itself")
        return known[id(node)]
    known[id(node)] = count = 0
    if isinstance(node, yaml.SequenceNode):
        count = sum(_count_nodes(item, known) for item in node.value)
    elif isinstance(node, yaml.MappingNode):
        count = sum(_count_nodes(item, known) for pair in node.value for item in pair)
    known[id(node)] = count + 1
    if count > MOST_NODES:
        raise ValueError("its aliases stand for too much")
    return count + 1


def read_values(path: Path) -> dict[str, Any]:
    """The names and values of a YAML file; none where it is empty.

    Raises:
        ConfigError: the file cannot be read, or holds something else.
    """
    content = read_yaml(path)
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected names and values, found a {type(content).__name__}")
    _check_names(content, path)
    return content


def _check_names(content: dict[Any, Any], path: Path) -> None:
    for name, value in content.items():
        if not isinstance(name, str):
            raise ConfigError(f"{path}: a name is text, not {name!r}")
        if isinstance(value, dict):
            _check_names(value, path)
