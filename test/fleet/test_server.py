from __future__ import annotations

from uuid import UUID, uuid4

import numpy as np
import psycopg
import pytest
from conftest import make_keyframe
from fleets import IDENTITY, administrator, stored

from benchmarks.accuracy.postgres import PASSWORD, PostgresServer, free_port
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Keyframe
from umf_ros.fleet.server import LARGEST_PLACE, MIGRATIONS, ROVERS, FleetServer, LinkError, add_rover, migrate
from umf_ros.places.store import unpack

STORE = uuid4()


def place(second: int, session: int = 0) -> Keyframe:
    return make_keyframe(second, seed=second, session=session)


def connect(server: PostgresServer, rover: str, store: UUID = STORE) -> FleetServer:
    return FleetServer(server.address(rover), store, IDENTITY)


def test_one_rover_finds_and_reads_keyframes_of_another(server: PostgresServer) -> None:
    ada, bea = connect(server, "ada"), connect(server, "bea")
    ada.push([place(second) for second in range(20)])
    found = bea.nearest(place(7).embedding.descriptor, 3)
    key, similarity = found[0]
    assert (key.robot, key.stamp_ns, key.store) == ("ada", 7 * 10**9, STORE) and len(found) == 3
    assert similarity == pytest.approx(1, abs=2e-3)
    data = bea.data(key)
    assert data is not None and unpack(data).stamp_ns == 7 * 10**9
    assert ada.nearest(place(7).embedding.descriptor, 3) == []  # the only rover there
    assert ada.robot == "ada"


def test_pushing_twice_stores_once_and_two_stores_of_one_rover_are_kept_apart(server: PostgresServer) -> None:
    ada = connect(server, "ada")
    ada.push([place(1), place(2)])
    ada.push([place(2), place(3)])
    assert stored(server) == [("ada", 1), ("ada", 2), ("ada", 3)]
    connect(server, "ada", uuid4()).push([place(3)])  # its clock began at 0 again
    assert len(stored(server)) == 4


@pytest.mark.parametrize(
    "statement",
    [
        "INSERT INTO place SELECT 'ada', gen_random_uuid(), 0, 5, 0, descriptor FROM place LIMIT 1",
        "INSERT INTO place_data SELECT 'ada', store, session, stamp_ns, '' FROM place LIMIT 1",
        "UPDATE place SET travelled_m = 0",
        "DELETE FROM place",
        "TRUNCATE place CASCADE",
        "DROP TABLE place",
        "SET ROLE ada",
        "ALTER TABLE place DISABLE ROW LEVEL SECURITY",
        "UPDATE fleet SET embedder = 'mine'",
    ],
)
def test_a_rover_cannot_change_rows_of_others(server: PostgresServer, statement: str) -> None:
    connect(server, "ada").push([place(1)])
    with psycopg.connect(server.address("bea")) as connection, pytest.raises(psycopg.errors.InsufficientPrivilege):
        connection.execute(statement)
    assert stored(server) == [("ada", 1)]


def test_a_rover_writes_under_its_own_name_whatever_its_role(server: PostgresServer) -> None:
    """Rows under the name of the role of all rovers would be those of no rover."""
    connect(server, "ada").push([place(1)])
    write = "INSERT INTO place SELECT current_user, gen_random_uuid(), 0, 5, 0, descriptor FROM place LIMIT 1"
    with psycopg.connect(server.address("bea")) as connection:
        connection.execute(f"SET ROLE {ROVERS}")
        with pytest.raises(psycopg.errors.InsufficientPrivilege):
            connection.execute(write)
    assert stored(server) == [("ada", 1)]


@pytest.mark.parametrize("number", [60000, 0])
def test_a_descriptor_that_is_not_of_unit_length_is_refused_by_the_server(server: PostgresServer, number: int) -> None:
    descriptor = f"[{','.join([str(number)] * IDENTITY[1])}]"
    with psycopg.connect(server.address("bea")) as connection, pytest.raises(psycopg.errors.CheckViolation):
        connection.execute("INSERT INTO place VALUES ('bea', gen_random_uuid(), 0, 5, 0, %s)", (descriptor,))


def test_what_an_earlier_server_took_is_checked_by_the_reader(server: PostgresServer) -> None:
    ada = connect(server, "ada")
    ada.push([place(1), place(2)])
    with administrator(server) as connection:
        connection.execute("ALTER TABLE place DROP CONSTRAINT place_descriptor_check")
        connection.execute("ALTER TABLE place_data DROP CONSTRAINT place_data_data_check")
        long = f"[{','.join(['99'] * IDENTITY[1])}]"
        connection.execute("UPDATE place SET descriptor = %s WHERE stamp_ns = 1000000000", (long,))
        connection.execute("UPDATE place_data SET data = repeat('x', %s)::bytea", (LARGEST_PLACE + 1,))
    bea = connect(server, "bea")
    found = bea.nearest(place(1).embedding.descriptor, 3)
    assert [key.stamp_ns for key, _ in found] == [2 * 10**9]
    assert bea.data(found[0][0]) is None


@pytest.mark.parametrize("name", ["postgres", ROVERS, "clerk", "pg_monitor"])
def test_the_password_of_a_role_that_is_no_rover_stays(server: PostgresServer, name: str) -> None:
    with administrator(server) as connection:
        if name == "clerk":
            connection.execute("CREATE ROLE clerk LOGIN CREATEROLE PASSWORD 'before'")
            connection.execute(f"GRANT {ROVERS} TO clerk")
        name = connection.execute("SELECT current_user").fetchone()[0] if name == "postgres" else name
        before = connection.execute("SELECT rolpassword FROM pg_authid WHERE rolname = %s", (name,)).fetchone()
        with pytest.raises(UmfError, match="is a role of the server that is no rover: its password was not changed"):
            add_rover(connection, name, "mine")
        assert connection.execute("SELECT rolpassword FROM pg_authid WHERE rolname = %s", (name,)).fetchone() == before


def test_passwords_reach_neither_log_nor_message(server: PostgresServer, monkeypatch: pytest.MonkeyPatch) -> None:
    with administrator(server) as connection:
        add_rover(connection, "ada", "secret of ada")  # again: a new password
    connect(server, "ada").close()
    assert "CREATE ROLE" in server.log and "secret of" not in server.log and PASSWORD not in server.log
    monkeypatch.setenv("PGPASSWORD", "wrong, and secret")
    with pytest.raises(LinkError, match="password authentication failed") as caught:
        connect(server, "bea")
    assert "wrong, and secret" not in str(caught.value) and "\n" not in str(caught.value)


def test_an_unreachable_server_is_one_line() -> None:
    with pytest.raises(LinkError, match="cannot be reached") as caught:
        FleetServer(f"postgresql://ada@127.0.0.1:{free_port()}/postgres", STORE, IDENTITY)
    assert "\n" not in str(caught.value)


def test_rovers_of_another_network_are_refused(server: PostgresServer) -> None:
    with pytest.raises(UmfError, match=r"were made with \('test', 16\), not with \('other', 16\)"):
        FleetServer(server.address("ada"), STORE, ("other", 16))


def test_migrating_twice_does_nothing_and_a_later_version_is_refused(server: PostgresServer) -> None:
    with administrator(server) as connection:
        assert migrate(connection, *IDENTITY) == (len(MIGRATIONS), len(MIGRATIONS))
        connection.execute("INSERT INTO fleet_version VALUES (99)")
        with pytest.raises(UmfError, match="tables of version 99"):
            migrate(connection, *IDENTITY)
        with pytest.raises(UmfError, match="tables of version 99, not"):
            connect(server, "ada")
        connection.execute("DELETE FROM fleet_version WHERE version = 99")


def test_the_graph_finds_what_an_exhaustive_search_finds(server: PostgresServer, rng: np.random.Generator) -> None:
    rows = rng.standard_normal((2000, 16)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    ada, bea = connect(server, "ada"), connect(server, "bea")
    for rover, part in ((ada, rows[:1000]), (bea, rows[1000:])):
        rover.push([make_keyframe(i * 1e-9, descriptor=row) for i, row in enumerate(part)])
    hits = 0
    for query in rows[:20]:
        true = set(np.argsort(-(rows[1000:] @ query))[:10].tolist())
        hits += len(true & {key.stamp_ns for key, _ in ada.nearest(query, 10)})
    assert hits >= 190
