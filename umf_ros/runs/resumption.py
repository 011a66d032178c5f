"""Which replay was cut off, and what it needs to go on."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

from umf_ros.core.config import Settings, load_settings
from umf_ros.core.errors import UmfError
from umf_ros.runs.folder import create_run_folder, write_atomically

PLACES = "places.sqlite"
"""Where a replay without a store of its own keeps its places until it is finished."""
_RUN = "run.json"


class ReplayFolder:
    """The folder of a replay, new or that of one that was cut off.

    Args:
        path: the folder.
        settings: of the run.
        resumed: whether an earlier process has begun it.
    """

    def __init__(self, path: Path, settings: Settings, resumed: bool = False) -> None:
        self.path = path
        self.resumed = resumed
        self._settings = settings

    @classmethod
    def create(cls, out: Path, bag: Path, settings: Settings) -> ReplayFolder:
        """Make a new folder inside `out` for a replay of `bag`.

        Raises:
            OutputError: it cannot be written.
        """
        folder = cls(create_run_folder(out), settings)
        write_atomically(folder.path / _RUN, json.dumps({"bag": str(bag.resolve()), "finished": False}) + "\n")
        return folder

    @classmethod
    def resume(cls, out: Path, bag: Path, settings: Settings) -> ReplayFolder:
        """The newest folder inside `out` of a replay of `bag` that was not finished; a new one where there is none.

        Raises:
            UmfError: it was begun with other settings.
            OutputError: a new one cannot be written.
        """
        begun = [path.parent for path in sorted(out.glob(f"*/{_RUN}"), reverse=True) if not path.parent.is_symlink()]
        for path in begun:
            about = _read(path / _RUN)
            if about.get("bag") != str(bag.resolve()) or about.get("finished") is not False:
                continue
            # cut off before its settings were written: nothing is in it
            if (path / "config.yaml").exists() and load_settings(path / "config.yaml") != settings:
                raise UmfError(f"{path} was begun with other settings; leave out --resume, or give the same options")
            (path / "summary.json").unlink(missing_ok=True)  # of a run that was interrupted by Ctrl-C
            return cls(path, settings, resumed=True)
        return cls.create(out, bag, settings)

    @property
    def working_settings(self) -> Settings:
        """The settings, with a store of places in the folder where they name none."""
        database = self._settings.database
        if database.path:
            return self._settings
        update = {"database": database.model_copy(update={"path": str(self.path / PLACES)})}
        return self._settings.model_copy(update=update)

    def finish(self) -> None:
        """The run has come to its end: it needs no places any more.

        Raises:
            OutputError: the folder cannot be written.
        """
        for path in self.path.glob(f"{PLACES}*"):
            path.unlink(missing_ok=True)
        about = _read(self.path / _RUN) | {"finished": True}
        write_atomically(self.path / _RUN, json.dumps(about) + "\n")


def _read(path: Path) -> dict[str, object]:
    with suppress(OSError, ValueError):
        about = json.loads(path.read_text(encoding="utf-8"))
        return about if isinstance(about, dict) else {}
    return {}
