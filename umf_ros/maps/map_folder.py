"""The folder of a map: its recordings and the paths of their files.

A map that is missing or damaged raises an `UmfError`, a folder that cannot be written an `OutputError`.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from umf_ros.absolute.measurement import AbsoluteMeasurement
from umf_ros.core.config import Settings, dump_settings, load_settings
from umf_ros.core.errors import OutputError, UmfError, reading, writing
from umf_ros.core.frames import State
from umf_ros.core.io import inside, plain_name, write_atomically
from umf_ros.core.limits import read_json
from umf_ros.places.database import PLACES_OF_MAP
from umf_ros.runs.run_file import RunFile
from umf_ros.sensors.decode import OdometrySample

SCHEMA_VERSION = 1
BETWEEN, EDITS = "closures_between.csv", "edits.json"
_DAY_NS = 86_400 * 10**9
APART_NS = 60 * 10**9
"""Least gap between sessions on the map's clock: longer than any interpolated gap of odometry."""


@dataclass(frozen=True, slots=True)
class MapSession:
    """One recording of a map.

    Attributes:
        name: of the session and its folder.
        recording: its description, as in the summary of a run.
        shift_ns: offset from its own clock to the map's, on which recordings do not overlap.
        first_ns, last_ns: the time it covers, own clock.
        first_place, places: its rows in the place database.
        first_number, numbers: its sessions in the place database: one, or more where its odometry restarted.
    """

    name: str
    recording: dict[str, Any]
    shift_ns: int
    first_ns: int
    last_ns: int
    first_place: int
    places: int
    first_number: int
    numbers: int

    def covers(self, map_ns: int) -> bool:
        """Return whether the recording covers a stamp of the map's clock."""
        return self.first_ns <= map_ns - self.shift_ns <= self.last_ns


class MapFolder:
    """A map on disk; `map.json` lists its sessions.

    Attributes:
        path: the folder.
        sessions: recordings in the order in which they were added.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.sessions: list[MapSession] = []

    @classmethod
    def open(cls, path: Path) -> MapFolder:
        """Open an existing map."""
        if not (path / "map.json").is_file():
            raise UmfError(f"{path} is not a map: map.json is missing; make one with umf map")
        folder = cls(path)
        with reading(path / "map.json", UmfError, "is damaged"):
            content = read_json(path / "map.json")
            if content["schema"] != SCHEMA_VERSION:
                raise UmfError(f"{path} is from another version of umf_ros; rebuild the map from its recordings")
            sessions = json.dumps(content["sessions"])
            folder.sessions = TypeAdapter(list[MapSession]).validate_json(sessions, strict=True)
            for session in folder.sessions:
                folder.folder_of(session.name)
        return folder

    @classmethod
    def open_or_create(cls, path: Path, settings: Settings) -> MapFolder:
        """Open an existing map, or create one with these settings; so is one without sessions, left by a failure."""
        if (path / "map.json").is_file():
            folder = cls.open(path)
            if folder.sessions:
                return folder
        elif path.is_dir() and any(path.iterdir()):
            raise OutputError(f"{path} holds other files and no map: name another folder; nothing was written")
        folder = cls(path)
        with writing(f"to {path}"):
            path.mkdir(parents=True, exist_ok=True)
        folder._write()
        write_atomically(path / "config.yaml", dump_settings(settings))
        return folder

    @property
    def settings(self) -> Settings:
        """Settings of the first recording, which apply to all."""
        return load_settings(self.path / "config.yaml")

    @property
    def places(self) -> Path:
        """Place database of all recordings, stamped by the map's clock."""
        return self.path / PLACES_OF_MAP

    def folder_of(self, name: str) -> Path:
        """Run folder of a recording, stamped by its own clock; raises an `UmfError` if the name leads elsewhere."""
        return inside(self.path / "sessions", name)

    def inputs_of(self, name: str) -> tuple[list[OdometrySample], list[AbsoluteMeasurement]]:
        """Return the odometry and the absolute measurements of a recording, stamped by its own clock."""
        with closing(RunFile(self.folder_of(name), read_only=True)) as file:
            inputs = list(file.graph_inputs())
        measurements = [one for one in inputs if isinstance(one, AbsoluteMeasurement)]
        return [one for one in inputs if isinstance(one, OdometrySample)], measurements

    def session_at(self, map_ns: int) -> MapSession | None:
        """Return the recording that covers a stamp of the map's clock."""
        return next((session for session in self.sessions if session.covers(map_ns)), None)

    def find(self, recording: dict[str, Any]) -> MapSession | None:
        """Return the session of a recording, independent of the path of its file."""
        keys = "start_ns", "end_ns", "messages"
        same = (one for one in self.sessions if all(one.recording[key] == recording[key] for key in keys))
        return next(same, None)

    def free_name(self, path: Path, reserved: Collection[str] = ()) -> str:
        """Return a session name for a recording that is neither taken nor reserved."""
        taken = {session.name for session in self.sessions} | set(reserved)
        stem = plain_name(path.stem)
        names = (stem if number == 1 else f"{stem}_{number}" for number in range(1, len(taken) + 2))
        return next(name for name in names if name not in taken)

    def shift_for(self, first_ns: int) -> int:
        """Shift in ns, of whole days, that puts a recording with this first stamp behind all others."""
        newest = max((session.last_ns + session.shift_ns for session in self.sessions), default=None)
        missing = 0 if newest is None else newest + APART_NS - first_ns
        return 0 if missing <= 0 else -(-missing // _DAY_NS) * _DAY_NS

    def edits(self) -> dict[tuple[int, int], State]:
        """Decisions by hand about closures, by the stamps of match and query on the map's clock."""
        if not (self.path / EDITS).is_file():
            return {}
        with reading(self.path / EDITS, UmfError, "is damaged"):
            rows = read_json(self.path / EDITS)
            return {(int(row["match"]), int(row["query"])): State(row["decision"]) for row in rows}

    def write_edits(self, edits: Mapping[tuple[int, int], State]) -> None:
        """Replace the decisions by hand."""
        rows = [{"match": match, "query": query, "decision": state} for (match, query), state in edits.items()]
        write_atomically(self.path / EDITS, json.dumps(rows, indent=1) + "\n")

    def add(self, session: MapSession) -> None:
        """Add a session whose places are in the place database."""
        self.sessions.append(session)
        self._write()

    def _write(self) -> None:
        content = {"schema": SCHEMA_VERSION, "sessions": [asdict(session) for session in self.sessions]}
        write_atomically(self.path / "map.json", json.dumps(content, indent=1) + "\n")
