"""`umf fleet`: the server that the rovers of a fleet share their places by."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.core.errors import UmfError

if TYPE_CHECKING:
    from psycopg import Connection

app = typer.Typer(help="Set up the server of a fleet (parameter database.backend: postgres); for its administrator.")

Address = Annotated[
    str,
    typer.Argument(help="postgresql://ADMINISTRATOR@HOST/DATABASE; the password is in ~/.pgpass or PGPASSWORD."),
]


@app.command("setup")
def setup(
    server: Address,
    embedder: Annotated[str, typer.Option(help="Network of all rovers, as umf doctor names it.")] = "umf_scene",
    dimension: Annotated[int, typer.Option(min=1, max=4000, help="Numbers per descriptor of it.")] = 768,
) -> None:
    """Make the tables of a fleet, or bring them up to date; PostgreSQL 15 and pgvector 0.8 or later."""
    with _connected(server) as connection:
        from umf_ros.fleet.server import migrate

        before, after = migrate(connection, embedder, dimension)
    typer.echo(f"the tables are of version {after}" + (", as before" if before == after else f", were of {before}"))


@app.command("add")
def add(server: Address, rover: Annotated[str, typer.Argument(help="Name of the rover.")]) -> None:
    """Let a rover in, or give it a new password; the password is read from the terminal or from standard input."""
    if not rover.replace("_", "").isalnum() or len(rover) > 63:
        raise UmfError(f"{rover!r} is no name for a rover: letters, digits and _, 63 at most")
    secret = typer.prompt("password", hide_input=True) if sys.stdin.isatty() else sys.stdin.readline().rstrip("\n")
    if not secret:
        raise UmfError("a rover needs a password")
    with _connected(server) as connection:
        from umf_ros.fleet.server import add_rover

        add_rover(connection, rover, secret)
    typer.echo(f"{rover} may come in; database.server: postgresql://{rover}@...")


@contextmanager
def _connected(server: str) -> Iterator[Connection]:
    """A connection whose faults are one line."""
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
        raise UmfError(f"the server cannot do that: {' '.join(str(error).split())[:300]}") from None
