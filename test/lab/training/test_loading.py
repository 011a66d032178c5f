"""Batches made ahead by other processes, of a process that has no threads of other tests to lose."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPT = """
import json, os, sys
from pathlib import Path
from umf_ros.core.errors import ConfigError
from umf_ros.lab.training.batches import made_ahead

workers, folder = int(sys.argv[1]), Path(sys.argv[2])

def make(step):
    (folder / str(step)).touch()
    return step * step, os.getpid()

def fail(step):
    if step == 2:
        raise ConfigError("data: nothing to see")
    return step

made = list(made_ahead(make, range(3, 8), workers))
seen, said = [], ""
try:
    for item in made_ahead(fail, range(5), workers):
        seen.append(item)
except ConfigError as error:
    said = str(error)
makers = {maker for _, maker in made}
print(json.dumps([[item for item, _ in made], len(makers), os.getpid() in makers, seen, said]))
"""


def made_by(workers: int, folder: Path) -> list[Any]:
    command = [sys.executable, "-c", SCRIPT, str(workers), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    return list(json.loads(done.stdout))


@pytest.mark.parametrize(("workers", "processes"), [(0, 1), (1, 1), (2, 2), (9, 5)])
def test_everything_comes_once_and_in_order(workers: int, processes: int, tmp_path: Path) -> None:
    made, makers, here, seen, said = made_by(workers, tmp_path)
    assert made == [9, 16, 25, 36, 49]
    assert (makers, here) == (processes, workers == 0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["3", "4", "5", "6", "7"]
    # an error of the user stays one line
    assert (seen, said) == ([0, 1], "data: nothing to see")
