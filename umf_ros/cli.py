"""The `umf` command: a list of its subcommands, and one line for every error that a user can cause."""

from __future__ import annotations

import signal

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during the imports: no traceback

import os
import re
import sys
from functools import cache
from importlib import import_module
from inspect import getdoc
from itertools import pairwise
from typing import Annotated, NoReturn

import typer

from umf_ros import __version__
from umf_ros.core.errors import UmfError, check_utf8, one_line, shortened
from umf_ros.core.resources import FLEET_PACKAGES, LAB_PACKAGES

COMMANDS = {
    "demo": "umf_ros.lab.commands.demo",
    "s3li": "umf_ros.lab.commands.s3li",
    "simulate": "umf_ros.lab.commands.simulate",
    "import": "umf_ros.lab.commands.import_data",
    "inspect": "umf_ros.lab.commands.inspect",
    "replay": "umf_ros.commands.replay",
    "config": "umf_ros.commands.recordings:show_parameters",
    "slam": "umf_ros.commands.slam",
    "map": "umf_ros.commands.map:app",
    "judge": "umf_ros.commands.judge",
    "compare": "umf_ros.lab.commands.compare",
    "sensors": "umf_ros.lab.commands.evaluate:sensors",
    "play": "umf_ros.lab.commands.demo:play",
    "report": "umf_ros.lab.commands.report",
    "evaluate": "umf_ros.lab.commands.evaluate",
    "why": "umf_ros.lab.commands.report:why",
    "explain": "umf_ros.lab.commands.compare:explain",
    "train": "umf_ros.lab.commands.train",
    "export": "umf_ros.lab.commands.train:export",
    "bench": "umf_ros.lab.commands.bench:app",
    "doctor": "umf_ros.lab.commands.inspect:doctor",
    "graph": "umf_ros.lab.commands.graph:app",
    "places": "umf_ros.commands.stores:places",
    "fleet": "umf_ros.commands.stores:fleet",
}
"""The module of every subcommand, and its function or group there; those of the lab by their names alone."""


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"umf_ros {__version__}")
        raise typer.Exit


Version = Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")]


@cache
def umf() -> typer.Typer:
    """Return the command with its subcommands."""
    app = typer.Typer(
        name="umf",
        help="Multimodal place recognition and loop closure for rovers with a camera and a LiDAR.",
        no_args_is_help=True,
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    for name, place in COMMANDS.items():
        module, _, member = place.partition(":")
        command = getattr(import_module(module), member or "command")
        if isinstance(command, typer.Typer):
            _join_lines(command)
            app.add_typer(command, name=name)
        else:
            app.command(name)(command)
    _join_lines(app)
    app.callback()(_options)
    return app


def _join_lines(app: typer.Typer) -> None:
    """Join the lines of each paragraph of the commands' help: typer keeps line ends, and wraps again at 80 columns."""
    for command in app.registered_commands:
        text = command.help or getdoc(command.callback) or ""
        command.help = "\n\n".join(" ".join(paragraph.split()) for paragraph in text.split("\n\n"))


def _options(version: Version = False) -> None:
    """Take the options of `umf` itself."""


def _remedy(package: str) -> str:
    """Return the source of a missing package."""
    known = dict.fromkeys(LAB_PACKAGES, "the lab needs it: run pip install 'umf_ros[lab]'")
    known |= dict.fromkeys(FLEET_PACKAGES, "run pip install 'umf_ros[fleet]'")
    known |= {"torch": "run pip install 'umf_ros[torch]', or make install-dev"}
    return known.get(package, "run umf doctor for a remedy")


def main() -> NoReturn:
    """Run the command line; 0 for success, 1 for an error, 2 for wrong arguments, 130 after Ctrl-C.

    SIGTERM ends with 143 after a clean-up: unfinished files are removed, nodes are ended.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for before, word in pairwise(sys.argv):
        if re.fullmatch(r"-\d[\d.]*", word) and not before.startswith("-"):
            typer.echo(f"umf: {word} is before the start, and no option", err=True)
            sys.exit(2)
    try:
        for word in sys.argv:
            check_utf8(word, UmfError)
        sys.exit(umf()(prog_name="umf"))  # also when it is run as a module
    except UmfError as error:
        typer.echo(f"umf: {error}", err=True)
        sys.exit(1)
    except ModuleNotFoundError as error:
        typer.echo(f"umf: {error.name} is not installed; {_remedy(str(error.name).split('.')[0])}", err=True)
        sys.exit(1)
    except MemoryError:
        typer.echo("umf: out of memory", err=True)
        sys.exit(1)
    except BrokenPipeError:
        # the reader of the output closed the pipe, as with `umf ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:  # a name that is too long, a folder without permission, a disk that is full
        where = shortened(error.filename) if error.filename else "a file cannot be used"
        typer.echo(f"umf: {where}: {error.strerror or one_line(error)}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
