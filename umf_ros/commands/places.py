"""`umf places`: what a store of places holds, and how to get rid of a part of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Look at a store of places (parameter database.path), or delete sessions of it.")

StorePath = Annotated[Path, typer.Argument(help="File of the parameter database.path.")]


@app.command("list")
def list_sessions(store: StorePath) -> None:
    """List the sessions of a store: number, keyframes, and when."""
    from datetime import UTC, datetime

    from umf_ros.places.store import stored_sessions

    for session in stored_sessions(store):
        first, last = (datetime.fromtimestamp(ns // 10**9, UTC) for ns in (session.first_ns, session.last_ns))
        span = f"{first:%Y-%m-%d %H:%M:%S} to {last:%Y-%m-%d %H:%M:%S} UTC"
        typer.echo(f"session {session.number}: {session.keyframes} keyframes, {span}")


@app.command("delete")
def delete(
    store: StorePath,
    session: Annotated[list[int], typer.Option("--session", help="Number of a session; may be given repeatedly.")],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Delete sessions of a store for good, after a confirmation."""
    from umf_ros.places.store import check_sessions, delete_sessions

    check_sessions(store, session)
    if not yes:
        typer.confirm(f"Delete session {', '.join(map(str, session))} of {store} for good?", abort=True)
    typer.echo(f"{delete_sessions(store, session)} keyframes deleted")
