from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from fleets import IDENTITY, ROVERS, administrator

from benchmarks.accuracy.postgres import PASSWORD, PostgresServer
from umf_ros.fleet.server import add_rover, migrate


@pytest.fixture(scope="package")
def running() -> Iterator[PostgresServer]:
    """A server with the tables of a fleet and two rovers."""
    with PostgresServer() as server:
        with psycopg.connect(server.address(), password=PASSWORD, autocommit=True) as connection:
            assert migrate(connection, *IDENTITY) == (0, 2)
            for rover in ROVERS:
                add_rover(connection, rover, f"secret of {rover}")
        yield server


@pytest.fixture
def server(running: PostgresServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PostgresServer:
    """The same, empty, with the passwords in a file as libpq wants it."""
    with administrator(running) as connection:
        connection.execute("TRUNCATE place, place_data")
    secrets = tmp_path / "pgpass"
    secrets.write_text("".join(f"127.0.0.1:*:*:{rover}:secret of {rover}\n" for rover in ROVERS))
    secrets.chmod(0o600)
    monkeypatch.setenv("PGPASSFILE", str(secrets))
    return running
