"""A fleet of two rovers on a real server."""

from __future__ import annotations

from pathlib import Path

import psycopg
from conftest import make_keyframe

from benchmarks.accuracy.postgres import PASSWORD, PostgresServer
from umf_ros.core.config import Database
from umf_ros.core.frames import Keyframe
from umf_ros.places.database import PlaceDatabase

IDENTITY = ("test", 16)
ROVERS = ("ada", "bea")


def administrator(server: PostgresServer) -> psycopg.Connection:
    return psycopg.connect(server.address(), password=PASSWORD, autocommit=True)


def settings(server: PostgresServer, rover: str, path: Path | None = None, port: int | None = None) -> Database:
    address = server.address(rover, port)
    return Database(path=str(path or ""), backend="postgres", server=address, fleet_candidates=3)


def rover_places(server: PostgresServer, rover: str, path: Path | None = None) -> PlaceDatabase:
    return PlaceDatabase(settings(server, rover, path), *IDENTITY)


def keyframes(count: int, first: int = 0) -> list[Keyframe]:
    return [make_keyframe(i, 2.0 * i, seed=i) for i in range(first, first + count)]


def stored(server: PostgresServer) -> list[tuple[str, int]]:
    """Rovers and stamps in s of all places on the server."""
    with administrator(server) as connection:
        rows = connection.execute(
            "SELECT robot, stamp_ns / 1000000000 FROM place JOIN place_data USING "
            "(robot, store, session, stamp_ns) ORDER BY 1, 2"
        ).fetchall()
    return [(str(robot), int(second)) for robot, second in rows]
