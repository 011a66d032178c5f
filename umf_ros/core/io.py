"""YAML files, SQLite files, locks, atomic writes, and the memory of processes."""

from __future__ import annotations

import csv
import fcntl
import logging
import os
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from errno import EINVAL, ENOLCK, ENOSYS, EOPNOTSUPP
from functools import cache
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import yaml

from umf_ros.core.errors import ConfigError, OutputError, UmfError, one_line, reading, shortened, writing
from umf_ros.core.limits import LARGEST_UNPACKED, lines_of, read_text

_log = logging.getLogger(__name__)
NO_LOCKS = "is on a file system that does not support file locks"
Check = Callable[[sqlite3.Connection], None]
_DAMAGE = (sqlite3.Error, ArithmeticError, LookupError, RecursionError, TypeError, ValueError)
"""Exceptions that the values of a damaged file raise where rows are read and parsed."""
_VERSIONS = "CREATE TABLE IF NOT EXISTS schema_version (name TEXT PRIMARY KEY, version INTEGER NOT NULL)"


@contextmanager
def atomic_write(path: Path, *kinds: type[Exception]) -> Iterator[Path]:
    """Write a file in one step: it appears under its name complete, or not at all.

    The block writes the temporary file whose path it is given. It replaces `path` when the block ends without an error
    and is deleted otherwise; an `OSError` or one of `kinds` means that the file cannot be written.

    Raises:
        OutputError: the file cannot be written.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    with writing(path, *kinds):
        try:
            yield part
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def read_lines(path: str | Path, kind: type[UmfError]) -> Iterator[str]:
    """Yield the lines of a text file in UTF-8, or in UTF-16 with a byte-order mark.

    Raises:
        kind: the file cannot be read or is not text, or a line is too long.
    """
    with reading(path, kind, "is not a text file"):
        yield from lines_of(path)


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV file in one step.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def write_atomically(path: Path, text: str) -> None:
    """Write a text file that is never seen half-written."""
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")


def check_folder(folder: Path) -> None:
    """Raise an `OutputError` if there is something that is no folder."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"cannot write to {folder}: it is no folder")


def check_writable(folder: Path) -> None:
    """Make a folder and check that results can be written into it, before hours of work.

    Raises:
        OutputError: it cannot be written.
    """
    check_folder(folder)
    with writing(f"to {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise OutputError(f"cannot write to {folder}: permission denied")


def inside(folder: Path, name: str) -> Path:
    """Return the path of a file whose name comes from outside, such as from a file that others made.

    Raises:
        UmfError: the name is not a plain one, or a link leads out of the folder.
    """
    path = folder / name
    if name != plain_name(name) or path.resolve().parent != folder.resolve():
        raise UmfError(f"{shortened(name)!r} is not the name of a file in {folder}")
    return path


def plain_name(text: str) -> str:
    """Return a text as the name of a file: printable, without separators, of at most 120 characters."""
    letters = (letter if letter.isprintable() and letter not in "/\\" else "_" for letter in text)
    return "".join(letters)[:120].strip(". ") or "unnamed"


def create_run_folder(out: Path, latest: bool = True) -> Path:
    """Make a new folder inside `out`, named after the local time; `out/latest` links to it unless `latest` is false."""
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    check_writable(out)
    with writing(f"to {out}"):
        for number in count(1):
            folder = out / (stamp if number == 1 else f"{stamp}_{number}")
            with suppress(FileExistsError):
                folder.mkdir()
                break
        if latest:  # atomic, so that the link never dangles
            fresh = out / f".latest-{os.getpid()}"
            fresh.symlink_to(folder.name, target_is_directory=True)
            fresh.replace(out / "latest")
    return folder


def _lock_options(folder: Path) -> str:
    """Return SQLite's option for files that cannot be locked, on some NFS and FUSE file systems; else none."""
    try:
        with TemporaryFile(dir=folder) as file:  # locked by no other process
            for lock in (fcntl.flock, fcntl.lockf):  # the latter is that of SQLite
                lock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return "&nolock=1" if error.errno in (ENOLCK, ENOSYS, EOPNOTSUPP, EINVAL) else ""
    return ""


@cache
def _warn_without_locks(folder: Path) -> None:
    _log.warning("%s %s: no other process may use its files meanwhile", folder, NO_LOCKS)


def lock_file(path: Path) -> int:
    """Lock a file against other processes, until the descriptor is closed or the process ends.

    The lock lies on `<path>.lock`, which stays: SQLite uses locks of its own on `path`, and drops them when any thread
    of the process closes that file. Readers need no lock.

    Raises:
        UmfError: another process, which is named, holds the lock, or the file system does not support locks.
        OutputError: the lock file cannot be made.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path.with_name(path.name + ".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(descriptor, 20, 0).decode("ascii", "replace").strip()
        os.close(descriptor)
        raise UmfError(f"{path} is in use by another process ({holder or 'unknown'}); only one may write") from None
    except OSError:
        os.close(descriptor)
        raise UmfError(f"{path} {NO_LOCKS}: it cannot be shared by several processes") from None
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    return descriptor


@dataclass(frozen=True, slots=True)
class Schema:
    """The tables of one kind of SQLite file, by version; a file may hold several schemas.

    Attributes:
        name: kind of the file, such as "place database"; for errors and the table `schema_version`.
        migrations: statements; the n-th ones lead from version n to n + 1; released ones are never changed.
    """

    name: str
    migrations: tuple[tuple[str, ...], ...]


class SqliteFile:
    """An open SQLite file: checked, migrated, written by one process.

    Writes go to a write-ahead log without a sync per row: a killed process loses nothing that was committed. Any thread
    may use `connection`; the caller serialises its use.

    Args:
        path: the file, made where it is missing; None: a temporary file that disappears with the process.
        schema: its tables.
        read_only: only read the file, which must exist; another process may write it meanwhile.
        check: called before anything is changed in a file that has tables; raises an `UmfError` to refuse it.

    Raises:
        UmfError: the file is missing (`read_only`), another kind of file, damaged, of a later version, or in use.
        OutputError: the file cannot be written.
    """

    def __init__(
        self, path: Path | None, schema: Schema, *, read_only: bool = False, check: Check | None = None
    ) -> None:
        self.name = str(path or f"temporary {schema.name}")
        self._path, self._read_only = path, read_only
        self._lock: int | None = None
        self._options = ""
        self.connection = self._connect(schema)
        self.connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_UNPACKED)
        try:
            self._check_plain()
            self._open(schema, check)
        except BaseException as error:
            self.close()
            if isinstance(error, UmfError) or not isinstance(error, Exception):
                raise
            # damaged bytes raise any exception
            raise UmfError(f"{self.name} cannot be used as a {schema.name}: {one_line(error)}") from None

    def migrate(self, schema: Schema) -> None:
        """Bring the tables of a schema up to date in one transaction; a new file gets them all.

        Raises:
            UmfError: a later release wrote them.
            OutputError: the file cannot be written.
        """
        with self.writing() as connection:
            connection.execute("BEGIN IMMEDIATE")
            connection.execute(_VERSIONS)
            found = self._version(schema)
            for statement in chain.from_iterable(schema.migrations[found:]):
                connection.execute(statement)
            values = schema.name, len(schema.migrations)
            connection.execute("INSERT OR REPLACE INTO schema_version VALUES (?, ?)", values)

    @contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """Open a transaction: all statements of the block are kept, or none.

        Raises:
            OutputError: the file cannot be written.
        """
        with writing(self.name, sqlite3.Error), self.connection:
            yield self.connection

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """Report an error of a block that reads and parses rows as damage.

        Raises:
            UmfError: the file is damaged.
        """
        try:
            yield self.connection
        except _DAMAGE as error:
            raise UmfError(f"{self.name} is damaged: {one_line(error)}") from None

    def copy(self, path: Path) -> None:
        """Write a complete copy while the file stays in use; only a temporary file must not change meanwhile.

        Raises:
            OutputError: the copy cannot be written.
        """
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path, sqlite3.Error) as part, ExitStack() as opened:
            # of no other process, in a folder that may not support locks
            target = sqlite3.connect(f"{part.absolute().as_uri()}?nolock=1", uri=True)
            opened.enter_context(closing(target))
            source = self.connection
            if self._path is not None:  # a reader of its own makes no writer wait
                source = sqlite3.connect(f"{self._path.absolute().as_uri()}?mode=ro{self._options}", uri=True)
                opened.enter_context(closing(source))
            source.backup(target)

    @property
    def is_temporary(self) -> bool:
        """Whether it disappears with the process."""
        return self._path is None

    def close(self) -> None:
        """Close the file and let other processes write it; a temporary file is deleted."""
        self.connection.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _connect(self, schema: Schema) -> sqlite3.Connection:
        path = self._path
        if not self._read_only:
            with writing(self.name, sqlite3.Error):
                if path is not None:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    self._options = _lock_options(path.parent)
                # SQLite deletes a database without a name when it is closed
                name = f"{path.absolute().as_uri()}?mode=rwc{self._options}" if path else ""
                return sqlite3.connect(name, uri=True, check_same_thread=False)
        if path is None or not path.is_file():
            raise UmfError(f"there is no {schema.name} {shortened(path)}")
        # SQLite makes files beside one that it reads, unless the folder cannot be written
        self._options = _lock_options(path.parent)
        access = f"mode=ro{self._options}" if os.access(path.parent, os.W_OK) else "immutable=1"
        return sqlite3.connect(f"{path.resolve().as_uri()}?{access}", uri=True, check_same_thread=False)

    def _open(self, schema: Schema, check: Check | None) -> None:
        found, tables = self._version(schema), self._tables()
        if not found and (tables or self._read_only):
            held = shortened(", ".join(sorted(tables))) or "nothing"
            raise UmfError(f"{self.name} is no {schema.name}, or one of an earlier version: it holds {held}")
        if found and check is not None:
            check(self.connection)
        if not self._read_only:
            if self._options:
                _warn_without_locks(Path(self.name).parent)
            elif self._path is not None:
                self._lock = lock_file(self._path)
            # a write-ahead log needs locks
            self.connection.execute(f"PRAGMA journal_mode = {'DELETE' if self._options else 'WAL'}")
            self.connection.execute("PRAGMA synchronous = NORMAL")
            self.migrate(schema)

    def _version(self, schema: Schema) -> int:
        """Return the version of a schema's tables in the file, 0 where there are none.

        Raises:
            UmfError: a later release wrote them.
        """
        tables, versions = self._tables(), dict[str, int]()
        if "schema_version" in tables:
            versions = dict(self.connection.execute("SELECT name, version FROM schema_version"))
        found = int(versions.get(schema.name, 0))
        if found > len(schema.migrations):
            latest = len(schema.migrations)
            raise UmfError(f"{self.name} has version {found} of a {schema.name}, this umf_ros reads {latest}")
        if found:
            self._check_tables(schema, found)
        return found

    def _tables(self) -> set[str]:
        return {name for (name,) in self.connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}

    def _check_plain(self) -> None:
        """Check that the file holds tables and indices only: views, triggers and computed columns run code.

        Raises:
            ValueError: it holds something else.
        """
        self.connection.execute("PRAGMA trusted_schema = OFF")
        for kind, hidden in self.connection.execute(_COLUMNS):
            if kind not in ("table", "index"):
                raise ValueError(f"it holds a {kind}")
            if hidden:
                raise ValueError("it holds a table with computed columns")

    def _check_tables(self, schema: Schema, version: int) -> None:
        """Check that the tables of a schema and all that belongs to them are those of its version to the letter.

        Constraints and indices on expressions run code.

        Raises:
            ValueError: they are not.
        """
        with closing(sqlite3.connect(":memory:")) as empty:
            statements = [_VERSIONS, *chain.from_iterable(schema.migrations[:version])]
            for statement in statements:
                if statement.startswith(("CREATE", "ALTER")):
                    empty.execute(statement)
            expected = {row[:3]: _letters(row[3]) for row in empty.execute(_OBJECTS)}
        tables = {table for _, _, table in expected}
        for *key, text in self.connection.execute(_OBJECTS):
            if key[2] in tables and expected.get(tuple(key)) != _letters(text):
                raise ValueError(f"its {key[0]} {shortened(key[1])} is not that of a {schema.name}")


_COLUMNS = "SELECT one.type, hidden FROM sqlite_master AS one LEFT JOIN pragma_table_xinfo(one.name)"
"""Kinds of all objects of a file, and whether each of their columns is computed."""
_OBJECTS = "SELECT type, name, tbl_name, sql FROM sqlite_master WHERE sql IS NOT NULL"


def _letters(statement: str) -> str:
    return "".join(letter for letter in statement if letter not in '"`[] \n\t').lower()


MOST_NODES, DEEPEST = 100_000, 100
"""Most nodes and levels of nesting of a file; settings have some hundreds on five levels, and nested aliases expand a
small file to billions."""
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # in C, twenty times as fast


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML file; None where it is empty.

    Raises:
        ConfigError: the file cannot be read.
    """
    with reading(path, ConfigError, "is not valid YAML"):
        text, depth = read_text(path).removeprefix("\ufeff"), 0
        try:
            for number, event in enumerate(yaml.parse(text, _Loader)):  # the loader in C overflows where it nests
                depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
                if depth > DEEPEST or number > MOST_NODES:
                    raise ValueError(f"more than {DEEPEST} levels of nesting, or {MOST_NODES} nodes")
            _count_nodes(yaml.compose(text, _Loader), {})
            return yaml.load(text, _Loader)
        except yaml.MarkedYAMLError as error:
            where = _place(error.problem_mark or error.context_mark)
            raise ValueError(f"{where}{error.problem or error.context}") from None


def _place(mark: Any) -> str:
    return f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""


def _count_nodes(node: yaml.Node | None, known: dict[int, int]) -> int:
    """Return the nodes of a document with every alias written out.

    Raises:
        ValueError: they are too many, a node is its own part, or a name is given twice: one value would be lost.
    """
    if id(node) in known:
        if not known[id(node)]:
            raise ValueError("a part of it contains itself")
        return known[id(node)]
    known[id(node)] = count = 0
    if isinstance(node, yaml.SequenceNode):
        count = sum(_count_nodes(item, known) for item in node.value)
    elif isinstance(node, yaml.MappingNode):
        for name, times in Counter(str(getattr(key, "value", "")) for key, _ in node.value).items():
            if times > 1 and name != "<<":
                raise ValueError(f"{_place(node.start_mark)}{name} is given twice")
        count = sum(_count_nodes(item, known) for pair in node.value for item in pair)
    known[id(node)] = count + 1
    if count > MOST_NODES:
        raise ValueError("its aliases expand to too many nodes")
    return count + 1


def read_values(path: Path) -> dict[str, Any]:
    """Return the names and values of a YAML file; none where it is empty.

    Raises:
        ConfigError: the file cannot be read, or holds something else.
    """
    content = read_yaml(path)
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected names and values, found a {type(content).__name__}")
    groups = [content]
    while groups:
        group = groups.pop()
        wrong = [name for name in group if not isinstance(name, str)]
        if wrong:
            raise ConfigError(f"{path}: a name must be text, not {wrong[0]!r}")
        groups += [value for value in group.values() if isinstance(value, dict)]
    return content


def memory_mb(process: int | str = "self", peak: bool = False) -> float:
    """Return the resident memory of a process, or its peak."""
    # `getrusage` would count that of the process that started it
    lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    name = "VmHWM:" if peak else "VmRSS:"
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(name))
