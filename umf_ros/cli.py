"""The `umf` command: a list of its subcommands, and one clear line for every error a user can cause."""

from __future__ import annotations

import os
import signal
import sys
from typing import Annotated, NoReturn

import typer

from umf_ros import __version__
from umf_ros.commands import (
    demo,
    doctor,
    evaluate,
    explain,
    export,
    graph,
    play,
    pretrain,
    replay,
    report,
    simulate,
    train,
)
from umf_ros.errors import UmfError

app = typer.Typer(
    name="umf",
    help="Multimodal place recognition and loop closure for rovers with a camera and a LiDAR.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("demo")(demo.command)
app.command("simulate")(simulate.command)
app.command("replay")(replay.command)
app.command("play")(play.command)
app.command("report")(report.command)
app.command("evaluate")(evaluate.command)
app.command("explain")(explain.command)
app.command("train")(train.command)
app.command("export")(export.command)
app.command("doctor")(doctor.command)
app.add_typer(pretrain.app, name="pretrain")
app.add_typer(graph.app, name="graph")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"umf_ros {__version__}")
        raise typer.Exit


Version = Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")]


@app.callback()
def options(version: Version = False) -> None:
    """Options of `umf` itself."""


def main() -> NoReturn:
    """Run the command line; 0 for success, 1 for an error, 2 for wrong arguments, 130 after Ctrl-C.

    SIGTERM ends with 143 and tidies up on the way: no unfinished file stays behind, no node goes on.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        sys.exit(app(prog_name="umf"))  # also when it is run as a module
    except UmfError as error:
        typer.echo(f"umf: {error}", err=True)
        sys.exit(1)
    except BrokenPipeError:
        # the reader of our output went away, as with `umf ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


if __name__ == "__main__":
    main()
