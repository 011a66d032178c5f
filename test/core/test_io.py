"""Files written in one step, and SQLite files: migrated, refused, copied."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import textwrap
from contextlib import closing
from pathlib import Path

import pytest
from processes import ENVIRONMENT

from umf_ros.core.errors import OutputError, UmfError
from umf_ros.core.io import Schema, SqliteFile, atomic_write

FIRST = Schema("log", (("CREATE TABLE line (text TEXT)",),))
SECOND = Schema("log", (*FIRST.migrations, ("ALTER TABLE line ADD COLUMN level INTEGER DEFAULT 7",)))
BESIDE = Schema("queue", (("CREATE TABLE queued (id INTEGER)",),))


def lines(file: SqliteFile) -> list[tuple[object, ...]]:
    with file.reading() as connection:
        return connection.execute("SELECT * FROM line").fetchall()


def made(path: Path, schema: Schema = FIRST) -> Path:
    file = SqliteFile(path, schema)
    with file.writing() as connection:
        connection.execute("INSERT INTO line (text) VALUES ('hello')")
    file.close()
    return path


def contents(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_file_appears_complete_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    with atomic_write(path) as part:
        part.write_text("one")
        assert not path.exists()
    with pytest.raises(ZeroDivisionError), atomic_write(path) as part:
        part.write_text("two")
        raise ZeroDivisionError
    assert path.read_text() == "one" and contents(path.parent) == {"a.json"}


def test_a_disk_error_is_one_line_and_named_kinds_too(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"cannot write .*/file/a"), atomic_write(tmp_path / "file" / "a"):
        pass
    with pytest.raises(OutputError, match=r"cannot write .*/b: no room"), atomic_write(tmp_path / "b", RuntimeError):
        raise RuntimeError("no room")


def test_a_file_of_an_earlier_version_is_migrated_once(tmp_path: Path) -> None:
    path = made(tmp_path / "a.sqlite")
    for _ in range(2):
        file = SqliteFile(path, SECOND)
        assert lines(file) == [("hello", 7)]
        file.close()


def test_a_file_holds_several_schemas(tmp_path: Path) -> None:
    path = made(tmp_path / "a.sqlite")
    file = SqliteFile(path, SECOND)
    file.migrate(BESIDE)
    file.migrate(BESIDE)
    assert lines(file) == [("hello", 7)] and file.connection.execute("SELECT * FROM queued").fetchall() == []
    file.close()


def test_a_migration_that_fails_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    path = made(tmp_path / "a.sqlite")
    broken = Schema("log", (*SECOND.migrations, ("CREATE TABLE other (id)", "no statement")))
    with pytest.raises(UmfError, match=r"cannot write"):
        SqliteFile(path, broken)
    file = SqliteFile(path, FIRST)
    assert lines(file) == [("hello",)]
    file.close()


def test_later_versions_other_files_and_two_writers_are_refused_in_one_line(tmp_path: Path) -> None:
    path = made(tmp_path / "a.sqlite", SECOND)
    with pytest.raises(UmfError, match=r"has version 2 of a log, this umf_ros reads 1"):
        SqliteFile(path, FIRST)
    with pytest.raises(UmfError, match=r"is no queue, or one of an earlier version: it holds line, schema_version"):
        SqliteFile(path, BESIDE)
    writer = SqliteFile(path, SECOND)
    reader = SqliteFile(path, SECOND, read_only=True)
    assert lines(reader) == [("hello", 7)]
    with pytest.raises(UmfError, match=rf"in use by another process \({os.getpid()}\)"):
        SqliteFile(path, SECOND)
    with pytest.raises(UmfError, match=r"there is no log"):
        SqliteFile(tmp_path / "b.sqlite", SECOND, read_only=True)
    reader.close()
    writer.close()
    assert "b.sqlite" not in contents(tmp_path)


def test_an_earlier_version_is_read_without_migration(tmp_path: Path) -> None:
    SqliteFile(made(tmp_path / "a.sqlite"), SECOND, read_only=True).close()


def test_a_refusal_of_the_check_changes_nothing(tmp_path: Path) -> None:
    path = made(tmp_path / "a.sqlite")
    before = path.read_bytes()

    def refuse(connection: sqlite3.Connection) -> None:
        raise UmfError("of another rover")

    with pytest.raises(UmfError, match=r"^of another rover$"):
        SqliteFile(path, SECOND, check=refuse)
    assert path.read_bytes() == before


@pytest.mark.parametrize("statement", ["CREATE VIEW v AS SELECT 1", "CREATE TABLE t (a, b AS (a + 1))"])
def test_a_file_that_computes_is_refused(tmp_path: Path, statement: str) -> None:
    path = made(tmp_path / "a.sqlite")
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(statement)
    with pytest.raises(UmfError, match=r"cannot be used as a log: it holds a"):
        SqliteFile(path, FIRST)


def test_a_copy_is_complete_and_a_temporary_file_is_in_no_folder(tmp_path: Path) -> None:
    file = SqliteFile(None, FIRST)
    with file.writing() as connection:
        connection.execute("INSERT INTO line VALUES ('hello')")
    file.copy(tmp_path / "copy.sqlite")
    file.close()
    assert contents(tmp_path) == {"copy.sqlite"}
    assert lines(SqliteFile(tmp_path / "copy.sqlite", FIRST, read_only=True)) == [("hello",)]


NO_LOCKS = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
static int refused(int fd) { /* of a file below $NO_LOCKS, as on an NFS without its lock service */
    char link[64], path[4096] = {0};
    const char *folder = getenv("NO_LOCKS");
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    return folder && readlink(link, path, sizeof path - 1) > 0 && !strncmp(path, folder, strlen(folder));
}
int flock(int fd, int how) {
    if (refused(fd)) { errno = ENOLCK; return -1; }
    return ((int (*)(int, int))dlsym(RTLD_NEXT, "flock"))(fd, how);
}
static int call(const char *name, int fd, int command, void *argument) {
    int is_lock = command == F_SETLK || command == F_SETLKW || command == F_GETLK || command == F_OFD_SETLK;
    if (is_lock && refused(fd)) { errno = ENOLCK; return -1; }
    return ((int (*)(int, int, void *))dlsym(RTLD_NEXT, name))(fd, command, argument);
}
#define WRAP(name) int name(int fd, int command, ...) { va_list more; va_start(more, command); \\
    void *argument = va_arg(more, void *); va_end(more); return call(#name, fd, command, argument); }
WRAP(fcntl)
WRAP(fcntl64)
"""


def test_a_file_system_without_locks_takes_results_and_shares_nothing(tmp_path: Path) -> None:
    library, folder = tmp_path / "no_locks.so", tmp_path / "nfs"
    source = library.with_suffix(".c")
    source.write_text(NO_LOCKS)
    folder.mkdir()
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    environment = {**ENVIRONMENT, "LD_PRELOAD": str(library), "NO_LOCKS": str(folder)}

    def run(code: str) -> tuple[str, list[str]]:
        command = [sys.executable, "-c", textwrap.dedent(code), str(folder)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
        assert "Traceback" not in done.stderr, done.stderr
        return done.stdout, done.stderr.splitlines()

    _, told = run("""
        import sys
        from pathlib import Path
        from umf_ros.core.config import PoseGraphSettings
        from umf_ros.durable_graph import DurableGraph
        from umf_ros.places.store import KeyframeStore
        from umf_ros.runs.run_file import RunFile
        folder = Path(sys.argv[1])
        run, places = RunFile(folder), KeyframeStore(folder / "places.sqlite", ("thumbnail", 16), 2)
        graph = DurableGraph(PoseGraphSettings(), folder / "graph.sqlite", print)
        with run.writing():
            run.append("keyframes", [[5, 0, "1.0"]])
        places.save(folder / "copy.sqlite")
        graph.close()
        import os
        os._exit(0)  # killed
    """)
    where = f"{folder} is on a file system that does not support file locks"
    assert told == [f"{where}: no other process may use its files meanwhile"]
    shown, told = run("""
        import sys
        from pathlib import Path
        from umf_ros.core.errors import UmfError
        from umf_ros.core.io import lock_file
        from umf_ros.places.store import KeyframeStore
        from umf_ros.runs.run_file import RunFile
        folder = Path(sys.argv[1])
        print(RunFile(folder, read_only=True).rows("keyframes"))
        print(len(KeyframeStore(folder / "copy.sqlite", ("thumbnail", 16), 2, read_only=True)))
        again = RunFile(folder)
        print(len(again.rows("keyframes")))
        again.close()
        try:
            lock_file(folder / "map.json")  # as for a map that grows
        except UmfError as error:
            print(error)
    """)
    assert shown.splitlines()[:3] == ["[(5, 0, '1.0')]", "0", "1"]
    assert told == [f"{where}: no other process may use its files meanwhile"]
    assert "map.json is on a file system that does not support file locks: it cannot be shared" in shown
