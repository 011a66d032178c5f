"""Four rovers and a real PostgreSQL, with links that are cut and a server that is killed.

    python benchmarks/accuracy/fleet.py --json fleet.json                 # simulates four drives first: an hour
    python benchmarks/accuracy/fleet.py --quick --map MAP --json F  # with the recordings of a map that umf map made

Rovers are the sessions of a map: their keyframes are stored, pushed and asked about one after the other, all four at
once, each through a link of its own, while links are cut and the server is killed and started again. The clocks of all
recordings start at the same second. Among many made-up places of an archive, they look for each other.

Prints and writes:
- `rovers`, `places` on the server at the end, `cut_links`, `killed_servers`;
- `pushes_per_s` of one rover while nothing is cut; `query_ms_p95` of the server, asked for 5 places after all that;
- `lost_places`: stored by a rover and not on the server with all their data when everything has come to rest;
- `closures_between` published, and `wrong_between` of them: those the truth refutes (0.5 m, 5 deg);
- `accepted_between`, `wrong_accepted`: the same before another closure had to agree;
- `foreign_writes_refused` of `foreign_writes_tried`: rows written, changed or deleted in another rover's name.
"""

from __future__ import annotations

import json
import os
import random
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch
from uuid import uuid4

import numpy as np
import psycopg
from pgvector import HalfVector
from pgvector.psycopg import register_vector
from postgres import PASSWORD, CuttableLink, PostgresServer
from sessions import QUICK, Size, mapped, simulated, truth_of

from umf_ros.core.config import Database, Settings
from umf_ros.core.frames import Keyframe, LoopClosure
from umf_ros.core.trajectory import Trajectory
from umf_ros.fleet.inter_robot_closures import InterRobotClosure, InterRobotMatcher
from umf_ros.fleet.server import FleetServer, add_rover, migrate
from umf_ros.lab.evaluation.places_bench import bare_keyframe, made_up_drives
from umf_ros.lab.program import parser_of, write_figures
from umf_ros.maps.map_folder import MapFolder
from umf_ros.maps.mapping import open_places
from umf_ros.places.store import KeyframeStore, stored_identity
from umf_ros.runs.truth import judge_closures
from umf_ros.submaps.history import SubmapHistory

ROVERS = 4
CUTS, KILLS = 20, 5
CUT_S = 0.3
PUSHED = 200
"""Places of the archive's rover that are timed."""
ASKED = 200
FOREIGN = (
    "INSERT INTO place SELECT '{other}', gen_random_uuid(), 0, 5, 0, descriptor FROM place LIMIT 1",
    "INSERT INTO place_data VALUES ('{other}', gen_random_uuid(), 0, 5, '')",
    "UPDATE place SET robot = '{other}'",
    "UPDATE place_data SET data = '' WHERE robot = '{other}'",
    "DELETE FROM place WHERE robot = '{other}'",
    "TRUNCATE place CASCADE",
)


class Rover:
    """One session of a map as a rover of its own.

    Attributes:
        name: on the server.
        keyframes: of its drive, on its own clock.
        truth: where it was.
    """

    def __init__(self, name: str, keyframes: list[Keyframe], truth: Trajectory) -> None:
        self.name, self.keyframes, self.truth = name, keyframes, truth
        self.accepted: list[tuple[str, LoopClosure]] = []
        self.published: list[tuple[str, LoopClosure]] = []

    def start(self, folder: Path, server: PostgresServer, identity: tuple[str, int]) -> None:
        """Open a store and a link that can be cut."""
        self.link = CuttableLink(server.port)
        address = server.address(self.name, self.link.port)
        self._database = Database(path=str(folder / f"{self.name}.sqlite"), backend="postgres", server=address)
        self.store = KeyframeStore(Path(self._database.path), identity, 400, outgoing=True)
        self.submaps = SubmapHistory(self.store)
        self.inter_robot = InterRobotMatcher(Settings(database=self._database), self.submaps, identity)

    def drive(self) -> Iterator[None]:
        """Store one keyframe after the other, and verify what comes back meanwhile."""
        for keyframe in self.keyframes:
            self.inter_robot.link.enqueue(self.store.add(keyframe))
            self.submaps.add(keyframe)
            inter_closure = self.inter_robot.next()
            if inter_closure is not None:
                self._note(inter_closure)
            yield

    def finish(self) -> None:
        """Wait until the server has everything, and has answered everything."""
        for inter_closure in self.inter_robot.finish(600):
            self._note(inter_closure)

    def _note(self, inter_closure: InterRobotClosure) -> None:
        self.accepted += [
            (inter_closure.robot, one.closure) for one in inter_closure.verdicts if one.closure is not None
        ]
        self.published += [(inter_closure.robot, closure) for closure in inter_closure.closures]


def rovers_of(folder: MapFolder) -> list[Rover]:
    """The first sessions of a map, each on its own clock."""
    found = []
    with closing(open_places(folder.places)) as places:
        for number, session in enumerate(folder.sessions[:ROVERS]):
            rows = range(session.first_place, session.first_place + session.places)
            keyframes = [replace(places[row], stamp_ns=places[row].stamp_ns - session.shift_ns) for row in rows]
            keyframes = [replace(one, session=one.session - session.first_number) for one in keyframes]
            found.append(Rover(f"rover{number}", keyframes, truth_of(Path(session.recording["path"]))))
    return found


def connect(server: PostgresServer) -> psycopg.Connection[Any]:
    connection = psycopg.connect(server.address(), password=PASSWORD, autocommit=True)
    register_vector(connection)
    return connection


def set_up(server: PostgresServer, names: list[str], identity: tuple[str, int], secrets: Path) -> None:
    with psycopg.connect(server.address(), password=PASSWORD, autocommit=True) as connection:
        migrate(connection, *identity)
        for name in names:
            add_rover(connection, name, f"secret of {name}")
    secrets.write_text("".join(f"127.0.0.1:*:*:{name}:secret of {name}\n" for name in names), encoding="utf-8")
    secrets.chmod(0o600)


def fill_archive(server: PostgresServer, count: int, seed: int) -> None:
    """Many places that are never seen again, loaded at once and put into the graph afterwards."""
    rng, store, row = np.random.default_rng(seed), uuid4(), 0
    with connect(server) as connection:
        connection.execute("DROP INDEX place_descriptor")
        for part in made_up_drives(count, rng, drives_at_once=20):
            with connection.cursor() as cursor, cursor.copy("COPY place FROM STDIN WITH (FORMAT BINARY)") as copy:
                copy.set_types(["text", "uuid", "int4", "int8", "float8", "halfvec"])
                for descriptor in part:
                    copy.write_row(("archive", store, 0, row, None, HalfVector(descriptor)))
                    row += 1
        connection.execute("CREATE INDEX place_descriptor ON place USING hnsw (descriptor halfvec_ip_ops)")


def pushes_per_s(server: PostgresServer, identity: tuple[str, int], seed: int) -> float:
    """Places a second of one rover, each with as many bytes as a real one."""
    archive = FleetServer(server.address("archive"), uuid4(), identity)
    (descriptors,) = made_up_drives(PUSHED, np.random.default_rng(seed + 1))
    scan = np.random.default_rng(seed).random((10_000, 3), np.float32)
    start = time.perf_counter()
    for first in range(0, PUSHED, 16):
        part = descriptors[first : first + 16]
        archive.push([bare_keyframe(first + i, 1, 0.0, row, scan) for i, row in enumerate(part)])
    archive.close()
    return PUSHED / (time.perf_counter() - start)


def disturb(server: PostgresServer, rovers: list[Rover], seed: int) -> dict[str, int]:
    """Let all rovers drive at once; cut links and kill the server at even shares of the way."""
    rng, cut, killed = random.Random(seed), 0, 0
    steps = max(len(rover.keyframes) for rover in rovers)
    cuts = set(np.linspace(2, steps - 2, CUTS).astype(int).tolist())
    kills = set(np.linspace(5, steps - 5, KILLS).astype(int).tolist())
    drives = [rover.drive() for rover in rovers]
    for step in range(steps):
        for drive in drives:
            next(drive, None)
        if step in cuts:
            rover = rng.choice(rovers)
            wait_for(lambda rover=rover: rover.inter_robot.link.connected)
            before = rover.link.cuts
            threading.Thread(target=rover.link.cut, args=(CUT_S,)).start()
            wait_for(lambda rover=rover, before=before: rover.link.cuts > before)
            cut += 1
        if step in kills:
            server.kill()
            server.start()
            killed += 1
    for rover in rovers:
        rover.finish()
    return {"cut_links": cut, "killed_servers": killed}


def wait_for(holds: Any, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.01)


def lost_places(server: PostgresServer, rovers: list[Rover]) -> int:
    """Descriptors and data that a rover stored and the server lacks."""
    with connect(server) as connection:
        query = "SELECT robot, stamp_ns FROM place JOIN place_data USING (robot, store, session, stamp_ns)"
        there = {(str(robot), int(stamp)) for robot, stamp in connection.execute(query)}
    return sum((rover.name, one.stamp_ns) not in there for rover in rovers for one in rover.keyframes)


def wrong_of(rovers: list[Rover], published: bool) -> tuple[int, int]:
    """Closures between rovers, and how many of them the truth refutes."""
    truths, judged = {rover.name: rover.truth for rover in rovers}, []
    for rover in rovers:
        for robot, closure in rover.published if published else rover.accepted:
            if robot == "archive":
                judged.append(False)
                continue
            query = rover.truth.at(np.array([closure.query_stamp_ns]))[0][0]
            match = truths[robot].at(np.array([closure.match_stamp_ns]))[0][0]
            judged.append(judge_closures([closure], query[None], match[None])[0].is_true)
    return len(judged), judged.count(False)


def query_ms_p95(server: PostgresServer, rovers: list[Rover], identity: tuple[str, int]) -> float:
    times = []
    for rover in rovers:
        asked = FleetServer(server.address(rover.name), uuid4(), identity)
        for keyframe in rover.keyframes[: ASKED // len(rovers)]:
            start = time.perf_counter()
            asked.nearest(keyframe.embedding.descriptor, 5)
            times.append(1e3 * (time.perf_counter() - start))
        asked.close()
    return float(np.percentile(times, 95))


def foreign_writes(server: PostgresServer, rovers: list[Rover]) -> dict[str, int]:
    """Every rover tries to write as every other one."""
    tried = refused = 0
    for rover in rovers:
        for other in rovers:
            for statement in FOREIGN if other is not rover else ():
                tried += 1
                try:
                    with psycopg.connect(server.address(rover.name), autocommit=True) as connection:
                        connection.execute(statement.format(other=other.name))
                except psycopg.errors.InsufficientPrivilege:
                    refused += 1
    return {"foreign_writes_tried": tried, "foreign_writes_refused": refused}


def measure(folder: MapFolder, places: int, seed: int) -> dict[str, Any]:
    identity = stored_identity(folder.places)
    rovers = rovers_of(folder)
    with tempfile.TemporaryDirectory(prefix="umf_fleet_") as work, PostgresServer() as server:
        secrets = Path(work) / "pgpass"
        set_up(server, [*(rover.name for rover in rovers), "archive"], identity, secrets)
        with patch.dict(os.environ, PGPASSFILE=str(secrets)):
            fill_archive(server, places, seed)
            figures: dict[str, Any] = {"rovers": len(rovers), "pushes_per_s": pushes_per_s(server, identity, seed)}
            for rover in rovers:
                rover.start(Path(work), server, identity)
            figures |= disturb(server, rovers, seed)
            figures["lost_places"] = lost_places(server, rovers)
            figures["closures_between"], figures["wrong_between"] = wrong_of(rovers, published=True)
            figures["accepted_between"], figures["wrong_accepted"] = wrong_of(rovers, published=False)
            figures["query_ms_p95"] = query_ms_p95(server, rovers, identity)
            figures |= foreign_writes(server, rovers)
            with connect(server) as connection:
                row = connection.execute("SELECT count(*) FROM place").fetchone()
            figures["places"] = row[0] if row else 0
            for rover in rovers:
                rover.inter_robot.link.close()
                rover.store.close()
    return {name: round(value, 2) if isinstance(value, float) else value for name, value in figures.items()}


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--map", type=Path, help="map with its recordings; default: four simulated drives")
    parser.add_argument("--seed", type=int, default=10001, help="seed of the worlds and of all random draws")
    parser.add_argument("--work", type=Path, default=Path("data/fleet"), help="folder of the simulated drives")
    parser.add_argument("--quick", action="store_true", help="an archive of 10,000 places, drives of 40 s")
    given = parser.parse_args()
    if given.map is None:
        size = QUICK if given.quick else Size(ROVERS, None, 0)
        work = given.work / f"{'quick' if given.quick else 'full'}_{given.seed}"
        work.mkdir(parents=True, exist_ok=True)
        recordings = [simulated(work, given.seed, number, size) for number in range(1, ROVERS + 1)]
        folder, *_ = mapped(work / "map", recordings)
    else:
        folder = MapFolder.open(given.map)
    figures = measure(folder, 10_000 if given.quick else 100_000, given.seed)
    print(json.dumps(figures, indent=2))
    write_figures(given.json, figures)


if __name__ == "__main__":
    main()
