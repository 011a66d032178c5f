"""The `umf` command in the process of the test: as a user types it, without starting an interpreter."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from umf_ros import cli


@dataclass(frozen=True)
class Ended:
    """Exit status and what was written."""

    status: int
    out: str
    err: str

    @property
    def text(self) -> str:
        """All output on one line, without the frames that typer draws."""
        return " ".join((self.out + self.err).replace("│", " ").split())


def umf(*arguments: str | Path) -> Ended:
    """Run `umf ARGUMENTS` to its end."""
    out, err, status = io.StringIO(), io.StringIO(), 0
    with patch.object(sys, "argv", ["umf", *map(str, arguments)]), redirect_stdout(out), redirect_stderr(err):
        try:
            cli.main()
        except SystemExit as ended:
            status = int(ended.code or 0)
    return Ended(status, out.getvalue(), err.getvalue())


def only_line(ended: Ended) -> str:
    """The one line that a user who got something wrong reads, without the program's name."""
    assert ended.status == 1, ended.text
    lines = ended.err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("umf: "), ended.err
    return lines[0].removeprefix("umf: ")
