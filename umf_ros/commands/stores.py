"""`umf places` and `umf fleet`: administration of stored places, on a rover and on the server of a fleet."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.core.errors import UmfError

if TYPE_CHECKING:
    from psycopg import Connection

places = typer.Typer(help="List or delete sessions of a place database (parameter database.path).")
fleet = typer.Typer(help="Set up the server of a fleet (parameter database.backend: postgres); for its administrator.")

StorePath = Annotated[Path, typer.Argument(help="File of the parameter database.path.")]


@places.command("list")
def list_sessions(store: StorePath) -> None:
    """List the sessions of a place database: number, keyframes and time."""
    from datetime import UTC, datetime

    from umf_ros.places.store import stored_sessions

    for session in stored_sessions(store):
        first, last = (datetime.fromtimestamp(ns // 10**9, UTC) for ns in (session.first_ns, session.last_ns))
        span = f"{first:%Y-%m-%d %H:%M:%S} to {last:%Y-%m-%d %H:%M:%S} UTC"
        typer.echo(f"session {session.number}: {session.keyframes} keyframes, {span}")


@places.command("delete")
def delete(
    store: StorePath,
    session: Annotated[list[int], typer.Option("--session", help="Number of a session; may be given repeatedly.")],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Delete sessions of a place database for good, after a confirmation."""
    from umf_ros.places.store import check_sessions, delete_sessions

    if (store.parent / "map.json").exists():
        raise UmfError(f"{store} is of a map, which lists its sessions: make the map again without them")
    check_sessions(store, session)
    if not yes:
        typer.confirm(f"Delete session {', '.join(map(str, session))} of {store} for good?", abort=True)
    typer.echo(f"{delete_sessions(store, session)} keyframes deleted")


Address = Annotated[
    str, typer.Argument(help="postgresql://ADMINISTRATOR@HOST/DATABASE; the password is in ~/.pgpass or PGPASSWORD.")
]


@fleet.command("setup")
def set_up(
    server: Address,
    embedder: Annotated[str, typer.Option(help="Network of all rovers, as listed by umf doctor.")] = "umf_scene",
    dimension: Annotated[int, typer.Option(min=1, max=4000, help="Its descriptor dimension.")] = 768,
) -> None:
    """Create or update the tables of a fleet; PostgreSQL 15 and pgvector 0.8 or later."""
    with _connected(server) as connection:
        from umf_ros.fleet.server import migrate

        before, after = migrate(connection, embedder, dimension)
    typer.echo(f"the tables have version {after}" + (", as before" if before == after else f", before {before}"))


@fleet.command("add")
def add_rover(server: Address, rover: Annotated[str, typer.Argument(help="Name of the rover.")]) -> None:
    """Add a rover, or change its password; the password is read from the terminal or from standard input."""
    if not rover.replace("_", "").isalnum() or len(rover) > 63:
        raise UmfError(f"{rover!r} is not a valid name of a rover: letters, digits and _, 63 at most")
    secret = typer.prompt("password", hide_input=True) if sys.stdin.isatty() else sys.stdin.readline().rstrip("\n")
    if not secret:
        raise UmfError("a rover needs a password")
    with _connected(server) as connection:
        from umf_ros.fleet import server as fleet_server

        fleet_server.add_rover(connection, rover, secret)
    typer.echo(f"{rover} can connect; database.server: postgresql://{rover}@...")


@contextmanager
def _connected(server: str) -> Iterator[Connection]:
    """Yield a connection; report its faults in one line."""
    import psycopg

    from umf_ros.core.config import without_password

    try:
        without_password(server)
    except ValueError as error:
        raise UmfError(str(error)) from None
    try:
        with psycopg.connect(server, autocommit=True, connect_timeout=10) as connection:
            yield connection
    except psycopg.Error as error:
        raise UmfError(f"the server refuses the request: {' '.join(str(error).split())[:300]}") from None
