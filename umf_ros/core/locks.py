"""One writer per file, among all processes of the machine."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from umf_ros.core.errors import UmfError, writing


class FileLock:
    """Held until `release`, or until the process ends, however it ends.

    The lock lies on a file of its own beside the one it protects: SQLite has locks on that one itself, and lets go of
    them when anybody in the process closes it. Whoever only reads needs no lock.

    Args:
        path: the file to protect; `<path>.lock` is made beside it and stays.

    Raises:
        UmfError: another process holds it; names that process.
        OutputError: the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        lock = path.with_name(path.name + ".lock")
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(self._descriptor, 20, 0).decode("ascii", "replace").strip()
            self.release()
            raise UmfError(f"{path} is in use by another process ({holder or 'unknown'}); only one may write") from None
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Let others write."""
        os.close(self._descriptor)
