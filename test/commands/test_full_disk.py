"""A disk that is full while a recording is replayed: one line, whatever it was that no longer fitted."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from command_line import only_line, umf
from recordings import traverse, write_mcap


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("bag") / "small.mcap", traverse(3.0))


@contextmanager
def no_file_longer_than(size: int) -> Iterator[None]:
    """As on a full disk: a larger file is an error."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def replay(bag: Path, out: Path):
    return umf("replay", bag, "--embedder", "scan_context", "--out", out)


def test_whatever_does_not_fit_is_one_line(bag: Path, tmp_path: Path) -> None:
    whole = replay(bag, tmp_path / "whole")
    assert whole.status in (0, 3), whole.text
    sizes = sorted({path.stat().st_size for path in (tmp_path / "whole" / "latest").iterdir() if path.is_file()})
    largest = [size for size in sizes if size > 1000]
    assert len(largest) > 4
    for number, size in enumerate([200, *largest[:: max(1, len(largest) // 5)], largest[-1]]):
        with no_file_longer_than(3 * size // 4):
            ended = replay(bag, tmp_path / f"full_{number}")
        assert "cannot write" in only_line(ended) or "cannot be used" in only_line(ended), size
