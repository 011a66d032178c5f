from __future__ import annotations

import io
import sys
from collections.abc import Iterator

import psycopg
import pytest
from command_line import only_line, umf

from benchmarks.accuracy.postgres import PASSWORD, PostgresServer, free_port
from umf_ros.core.config import parse_settings
from umf_ros.core.errors import ConfigError


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    with PostgresServer() as running:
        yield running


@pytest.fixture(autouse=True)
def secret(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PGPASSWORD", PASSWORD)


def test_an_administrator_sets_a_server_up_and_lets_a_rover_in(
    server: PostgresServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert umf("fleet", "setup", server.address()).out == "the tables have version 2, before 0\n"
    assert umf("fleet", "setup", server.address()).out == "the tables have version 2, as before\n"
    for said in ("first word\n", "second word\n"):
        monkeypatch.setattr(sys, "stdin", io.StringIO(said))
        assert umf("fleet", "add", server.address(), "ada").status == 0
    with psycopg.connect(server.address("ada"), password="second word") as connection:
        assert connection.execute("SELECT embedder, dimension FROM fleet").fetchone() == ("umf_scene", 768)
    assert "word" not in server.log.replace("password", "")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("add", "", "a b"), "not a valid name of a rover"),
        (("add", "", "bea"), "needs a password"),
        (("setup", f"postgresql://x@127.0.0.1:{free_port()}/y"), "the server refuses the request"),
        (("setup", "postgresql://x:hidden@h/y"), "the password belongs into"),
    ],
)
def test_what_a_person_does_wrong_is_one_line(
    server: PostgresServer, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], says: str
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    ended = umf("fleet", *(one or server.address() for one in arguments))
    assert ended.status == 1 and says in only_line(ended) and "hidden" not in ended.text


@pytest.mark.parametrize("address", ["postgresql://ada:hidden@h/d", "host=h user=ada password=hidden"])
def test_a_password_in_the_settings_is_refused_and_not_repeated(address: str) -> None:
    with pytest.raises(ConfigError, match=r"database\.server: the password belongs into") as caught:
        parse_settings({"database": {"server": address}})
    assert "hidden" not in str(caught.value)
    parse_settings({"database": {"server": "postgresql://ada@h:5432/d?sslmode=verify-full"}})
