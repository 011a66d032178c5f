"""The exceptions that a user of the package can see, and how they name a choice."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

LONGEST = 300
"""Most characters of an error's text or of a name in it; both may come from outside."""


def printable(text: object) -> str:
    """Return a text from outside on one line, with control characters and marks of direction escaped.

    Names of frames, topics and files could otherwise forge lines of a log, or control a terminal.
    """
    line = " ".join(str(text).split())
    return line if line.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def shortened(text: object) -> str:
    """Return a printable text, with the middle of a long one left out."""
    line = printable(text)
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} ... {line[-LONGEST // 3 :]}"


def check_utf8(name: object, kind: type[UmfError]) -> None:
    """Check a name: one that is not UTF-8 can be neither stored nor printed.

    Raises:
        kind: it is not.
    """
    try:
        str(name).encode()
    except UnicodeEncodeError:
        raise kind(f"{shortened(ascii(str(name)))} is not UTF-8; rename it") from None


def one_line(error: BaseException) -> str:
    """Return the text of an exception on one line; its type where it has none."""
    return shortened(error) or type(error).__name__


class UmfError(Exception):
    """Base of the package's own errors; the text is one printable line for the user."""

    def __init__(self, text: object = "") -> None:
        # a text that is fine is kept as the object that it is, such as a reason
        super().__init__(text if isinstance(text, str) and printable(text) == text else printable(text))


class MessageError(UmfError):
    """A sensor message that cannot be used; `kind` groups equal causes for counting."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(shortened(text))
        self.kind = kind


class BagError(UmfError):
    """A recording that is missing, foreign or damaged beyond use."""


class ConfigError(UmfError):
    """A parameter that is unknown, of the wrong type or out of range."""


class CalibrationError(UmfError):
    """A calibration that is missing or contradicts the data."""


class WeightsError(UmfError):
    """Weights that are missing, damaged or of another architecture."""


class OutputError(UmfError):
    """A result that cannot be written."""


class GraphError(UmfError):
    """A pose graph that cannot be read or solved."""


@contextmanager
def writing(what: object, *kinds: type[Exception]) -> Iterator[None]:
    """Raise an `OutputError` if the block cannot write `what` (an `OSError`, or one of `kinds`)."""
    caught: tuple[type[Exception], ...] = (OSError, *kinds)
    try:
        yield
    except caught as error:
        raise OutputError(f"cannot write {what}: {getattr(error, 'strerror', None) or error}") from None


@contextmanager
def reading(path: object, kind: type[UmfError], fault: str) -> Iterator[None]:
    """Raise anything that the block raises as one line of a `kind` of error; those of the package pass.

    `fault` is said of a file that can be opened: damaged bytes raise any exception in the libraries that read them.
    """
    try:
        yield
    except UmfError:
        raise
    except OSError as error:
        raise kind(f"cannot read {shortened(path)}: {error.strerror or one_line(error)}") from None
    except Exception as error:
        raise kind(f"{shortened(path)} {fault}: {one_line(error)}") from None


def command_line(*words: object) -> str:
    """Return a command of `umf` with its arguments as a shell takes it: for messages."""
    return shlex.join(["umf", *map(str, words)])


def either(names: Sequence[str]) -> str:
    """Return the names as a choice, "a, b or c": for messages and help."""
    return " or ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)
