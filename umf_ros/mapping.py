"""Makes a map of many recordings: replays each, compares it with those before, and solves all of them together.

Three steps, each a function of files alone, so that the first two can run anywhere:

1. `replay_session`: one recording becomes a run folder with its own places;
2. `match_session`: what it saw of the places of the recordings before it;
3. `umf_ros.maps.joint_graph.solve`: one graph of all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import Bag, open_bag
from umf_ros.bags.trajectories import read_odometry
from umf_ros.core.config import Database, Settings
from umf_ros.core.errors import BagError, writing
from umf_ros.core.frames import Keyframe
from umf_ros.core.trajectory import Trajectory
from umf_ros.detector import Detection, LoopDetector, make_detector_embedder
from umf_ros.maps.map_folder import BETWEEN, MapFolder, MapSession
from umf_ros.maps.matching import Match, match_between
from umf_ros.maps.odometry_log import OdometryLog
from umf_ros.maps.tracking import track
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import delete_sessions, stored_identity, stored_sessions
from umf_ros.replay import Replay
from umf_ros.runs.reader import describe_recording, remember_recording
from umf_ros.runs.tables import CLOSURES, CsvTable, closure_row
from umf_ros.runs.writer import PLACES, count_drops

Heard = Callable[[float, Detection], None]
"""Told of every frame: the part of the recording that is done, 0 to 1, and what became of it."""
RECORDINGS = (".mcap", ".db3", ".bag")


@dataclass(frozen=True, slots=True)
class Opening:
    """How recordings are opened, as by the options of `umf replay`.

    Attributes:
        odometry: folder of TUM files named like the recordings, `NAME.tum` or `NAME.odometry.tum`; None: none.
        odometry_frame: whose poses they hold.
    """

    config: Path | None = None
    dataset: str = "auto"
    embedder: str | None = None
    weights: str | None = None
    odometry: Path | None = None
    odometry_frame: str = "body"

    def settings(self, bag: Bag) -> Settings:
        """The settings to read a recording with.

        Raises:
            UmfError: they are wrong, or the recording's data set is not known.
        """
        overrides = {"embedding__method": self.embedder, "embedding__weights": self.weights}
        return settings_for(bag, self.config, self.dataset, mode="mapping", **overrides)

    def odometry_of(self, recording: Path, settings: Settings) -> Trajectory | None:
        """The odometry of a recording from its file; None where there is no such file.

        Raises:
            BagError: the file is damaged, or its frame is not known.
        """
        folder = self.odometry
        paths = [folder / f"{recording.stem}{ending}" for ending in (".tum", ".odometry.tum")] if folder else []
        path = next((path for path in paths if path.is_file()), None)
        return None if path is None else read_odometry(path, self.odometry_frame, settings)


def find_recordings(paths: list[Path]) -> list[Path]:
    """The recordings among files and folders, each folder's in the order of their names.

    Raises:
        BagError: a path is not there, or a folder has no recording in it.
    """
    found = []
    for path in paths:
        if not path.exists():
            raise BagError(f"there is no recording {path}")
        inside = [path] if path.is_file() or _is_recording(path) else sorted(filter(_is_recording, path.iterdir()))
        if not inside:
            raise BagError(f"{path} holds no recording ({', '.join(RECORDINGS)}, or a folder with metadata.yaml)")
        found += inside
    return list(dict.fromkeys(path.resolve() for path in found))


def _is_recording(path: Path) -> bool:
    return path.suffix in RECORDINGS if path.is_file() else (path / "metadata.yaml").is_file()


def replay_session(recording: Path, opening: Opening, folder: Path, heard: Heard = lambda *_: None) -> None:
    """Find the places of one recording and the closures among them; what lies in the folder is made anew.

    Args:
        recording: any that `umf replay` can read.
        opening: how.
        folder: becomes a run folder with `places.sqlite` and `odometry.npz`, stamped by the recording's own clock.
        heard: is told of every frame.

    Raises:
        UmfError: the recording cannot be read, or the folder not be written.
    """
    bag = open_bag(recording)
    settings = opening.settings(bag)
    if folder.exists():
        rmtree(folder)
    with writing(f"to {folder}"):
        folder.mkdir(parents=True)
    store = Database(path=str(folder / PLACES), cached_keyframes=settings.database.cached_keyframes)
    settings = settings.model_copy(update={"database": store})
    reader, log = FrameReader(bag, settings, opening.odometry_of(recording, settings)), OdometryLog()
    replay = Replay(folder, settings, LoopDetector(settings, make_detector_embedder(settings)))
    for detection in replay.run(log.following(reader.stream())):
        heard(reader.progress, detection)
    replay.finish(count_drops(reader.counters))
    remember_recording(folder, bag)
    if not len(log):
        log = _track(folder, settings)
    log.save(folder)
    replay.raise_if_frames_failed()


def _track(folder: Path, settings: Settings) -> OdometryLog:
    """Follow a recording without odometry through its own keyframes, which take that as odometry from now on."""
    old, new = folder / PLACES, folder / f"tracked_{PLACES}"
    with closing(open_places(old)) as places:
        log, tracked = track((places[row] for row in range(len(places))), settings.verification)
    with closing(_create(new, *stored_identity(old))) as places:
        for keyframe in tracked:
            places.add(keyframe)
    with writing(old):
        new.replace(old)
    return log


def add_session(target: MapFolder, name: str, recording: Path) -> MapSession:
    """Take the run folder of a recording into the map: its places go to the map's store, on the map's clock.

    Where a process was killed meanwhile, what it left behind is taken out first.

    Raises:
        UmfError: the recording was embedded by another network than those before it.
        OutputError: the map cannot be written.
    """
    run = target.folder_of(name)
    bag = open_bag(recording)
    _discard_unfinished(target)
    with closing(_create(target.places, *stored_identity(run / PLACES))) as places:
        first_place, first_number = len(places), places.next_session
        with closing(open_places(run / PLACES)) as own:
            known = [own[row] for row in range(len(own))]
            stamps = [keyframe.stamp_ns for keyframe in known] or [bag.start_ns]
            log = OdometryLog.load(run)
            span = [*stamps, *log.stamps]
            shift_ns = target.shift_for(min(span))
            for keyframe in known:
                places.add(_moved(keyframe, shift_ns, first_number))
        session = MapSession(
            name=name,
            recording=describe_recording(bag),
            shift_ns=shift_ns,
            first_ns=min(span),
            last_ns=max(span),
            first_place=first_place,
            places=len(known),
            first_number=first_number,
            numbers=places.next_session - first_number,
            odometry=not log.covariances,
        )
    target.add(session)
    with writing(run):
        for path in run.glob(f"{PLACES}*"):
            path.unlink()
    return session


def match_session(target: MapFolder, session: MapSession) -> Iterator[Match]:
    """Look for a recording's places among those of the recordings before it; writes `closures_between.csv`.

    The map's store is only read: several sessions may be matched at once.

    Raises:
        UmfError: the map's store cannot be read.
        OutputError: the table cannot be written.
    """
    path = target.folder_of(session.name) / BETWEEN
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)
    table = CsvTable(part, CLOSURES)
    rows = range(session.first_place, session.first_place + session.places)
    with closing(open_places(target.places)) as places, closing(table):
        for match in match_between(places, rows, range(session.first_number), target.settings):
            found = [one for one in match.verdicts if one.closure is not None]
            table.append([closure_row(one.closure, one.candidate.similarity) for one in found if one.closure])
            yield match
    with writing(path):
        part.replace(path)  # it is there when it is whole


def replay_task(task: tuple[Path, Opening, Path]) -> None:
    """`replay_session` where nobody listens."""
    replay_session(*task)


def match_task(task: tuple[Path, str]) -> None:
    """`match_session` of a map's folder and the name of one of its sessions, where nobody listens."""
    target = MapFolder.open(task[0])
    session = next(one for one in target.sessions if one.name == task[1])
    for _ in match_session(target, session):
        pass


def unmatched(target: MapFolder) -> list[MapSession]:
    """Sessions that were added, but not compared with those before them to the end."""
    return [session for session in target.sessions if not (target.folder_of(session.name) / BETWEEN).is_file()]


def _discard_unfinished(target: MapFolder) -> None:
    """Take out of the store what a process that was killed had begun to add."""
    if not target.places.is_file():
        return
    known = max((session.first_number + session.numbers for session in target.sessions), default=0)
    unfinished = [one.number for one in stored_sessions(target.places) if one.number >= known]
    if unfinished:
        delete_sessions(target.places, unfinished)


def open_places(path: Path) -> PlaceDatabase:
    """A store of places to read, by whichever network it was made.

    Raises:
        UmfError: it cannot be read.
    """
    return PlaceDatabase(Database(path=str(path)), *stored_identity(path), read_only=True)


def _create(path: Path, embedder: str, dimension: int) -> PlaceDatabase:
    return PlaceDatabase(Database(path=str(path)), embedder, dimension)


def _moved(keyframe: Keyframe, shift_ns: int, number: int) -> Keyframe:
    return replace(keyframe, stamp_ns=keyframe.stamp_ns + shift_ns, session=keyframe.session + number)
