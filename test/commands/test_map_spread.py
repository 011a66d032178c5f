"""`umf map` spread over workers, one of which is killed: the same map as by one process."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
from command_line import umf
from recordings import part_of

from umf_ros.core import tasks as spread_module
from umf_ros.maps.map_folder import MapFolder


@pytest.fixture(scope="module")
def recordings(mini_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("parts")
    return [part_of(mini_bag, folder / f"{name}.mcap", *span) for name, span in (("a", (0, 7)), ("b", (11, 99)))]


def tables(out: Path) -> dict[str, str]:
    """Closures and poses of a map."""
    names = [session.name for session in MapFolder.open(out).sessions]
    files = [f"sessions/{name}/{table}.csv" for name in names for table in ("closures", "closures_between")]
    return {name: (out / name).read_text() for name in [*files, "graph_verdicts.csv"]}


@pytest.fixture(scope="module")
def alone(recordings: list[Path], mini_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("alone") / "map"
    assert umf("map", *recordings, "--config", mini_config, "--out", out).status == 0
    return out


class Killer(threading.Thread):
    """Kills the first process that it finds at work on a recording."""

    def __init__(self, folder: Path) -> None:
        super().__init__(daemon=True)
        self._folder = folder
        self.killed = 0

    def run(self) -> None:
        """Look until there is one, for ten minutes at most."""
        end = time.monotonic() + 600
        while not self.killed and time.monotonic() < end:
            time.sleep(0.05)
            for path in Path("/proc").glob("[0-9]*/fd/*"):
                with suppress(OSError):
                    if path.readlink().is_relative_to(self._folder) and int(path.parts[2]) != os.getpid():
                        os.kill(int(path.parts[2]), signal.SIGKILL)
                        self.killed = int(path.parts[2])
                        return


def test_ray_makes_the_same_map_though_a_worker_is_killed(
    recordings: list[Path], mini_config: Path, alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = str(Path(spread_module.__file__).parents[1])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH", "")))))
    (killer := Killer(tmp_path / "map" / "sessions")).start()
    way = "--ray", "local", "--workers", "2"
    ended = umf("map", *recordings, "--config", mini_config, "--out", tmp_path / "map", *way)
    assert ended.status == 0, ended.text
    assert killer.killed
    assert tables(tmp_path / "map") == tables(alone)
    assert "2 of 2 sessions in one frame" in ended.text
    known = [json.loads((out / "map.json").read_text())["sessions"] for out in (alone, tmp_path / "map")]
    assert known[0] == known[1]
