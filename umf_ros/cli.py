"""The `umf` command: a list of its subcommands, and one clear line for every error a user can cause."""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from typing import Annotated, NoReturn

import typer

from umf_ros import __version__
from umf_ros.errors import UmfError

COMMANDS = {
    "demo": "umf_ros.lab.commands.demo",
    "simulate": "umf_ros.lab.commands.simulate",
    "replay": "umf_ros.commands.replay",
    "play": "umf_ros.commands.play",
    "report": "umf_ros.commands.report",
    "evaluate": "umf_ros.lab.commands.evaluate",
    "explain": "umf_ros.commands.explain",
    "train": "umf_ros.lab.commands.train",
    "export": "umf_ros.commands.export",
    "doctor": "umf_ros.commands.doctor",
    "pretrain": "umf_ros.lab.commands.pretrain",
    "graph": "umf_ros.commands.graph",
}
"""The module of every subcommand, by name: those of the lab are known here by their names alone."""

app = typer.Typer(
    name="umf",
    help="Multimodal place recognition and loop closure for rovers with a camera and a LiDAR.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _register() -> None:
    """Add every subcommand: a module offers either `command` or, for a group of them, `app`."""
    for name, module_name in COMMANDS.items():
        module = import_module(module_name)
        if hasattr(module, "app"):
            app.add_typer(module.app, name=name)
        else:
            app.command(name)(module.command)


_register()


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
