"""Map many recordings: replay each, match it against the earlier ones, and solve one joint pose graph.

Three steps, each a function of files alone, so that the first two can run on any machine:

1. `replay_session`: one recording becomes a run folder with its own place database;
2. `match_session`: closures between a recording and the earlier ones;
3. `umf_ros.maps.joint_graph.solve`: one graph of all sessions.

`grow` adds what a rover saw where it localises: the session is complete in a folder of its own, and its places are in
the store, before `map.json` names it in one step. Until then the map is what it was, whatever is killed; after that the
same drive is not added again. Poses of the new places come with the solution, which is repeated where it was cut off.

A recording or map that cannot be read raises an `UmfError`, a folder that cannot be written an `OutputError`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree
from typing import Any, NamedTuple

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.inputs import input_counts, present_topics
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import Bag, open_bag
from umf_ros.bags.scan_odometry import can_track, odometry_of_scans
from umf_ros.bags.trajectories import read_odometry
from umf_ros.core.config import Database, ParameterSource, Settings
from umf_ros.core.errors import BagError, UmfError, writing
from umf_ros.core.frames import Keyframe, LoopClosure
from umf_ros.core.io import lock_file, write_table
from umf_ros.core.limits import read_json
from umf_ros.core.resources import MADE_ODOMETRY, ODOMETRY_ENGINES
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.detector import Detection, LoopDetector, make_detector_embedder
from umf_ros.maps.joint_graph import solve
from umf_ros.maps.map_folder import BETWEEN, MapFolder, MapSession
from umf_ros.maps.outputs import summary_of, write_results
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import delete_sessions, stored_identity, stored_sessions
from umf_ros.replay import Replay
from umf_ros.runs.findings import look_first
from umf_ros.runs.reader import describe_recording, read_run, remember_recording
from umf_ros.runs.run_file import CLOSURES, COLUMNS, RunFile, closure_row, read_odometry_of
from umf_ros.runs.truth import JudgedRun
from umf_ros.runs.writer import PLACES, begin_folder, count_drops, is_of, is_unfinished
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sensor_check import find_contradictions
from umf_ros.submaps import SubmapFinder
from umf_ros.submaps.history import SubmapHistory
from umf_ros.verification import Hypothesis, Verifier

OnFrame = Callable[[float, Detection], None]
"""Called for every frame with the processed share of the recording, 0 to 1, and the detection."""
RECORDINGS = (".mcap", ".db3", ".bag")
REMEDY = "which a map needs: give --odometry FILE.tum"
WITHHELD = "closures are withheld until that is corrected; then make the map in another folder (--out)"
FEWEST = 2
"""Places of a session: one alone has no odometry to anything."""


@dataclass(frozen=True, slots=True)
class Opening:
    """Options that recordings are opened with, as in `umf replay`.

    Attributes:
        odometry: a TUM file, or a folder of files named like the recordings, `NAME.tum` or `NAME.odometry.tum`; None:
            that of the recording, or of its scans.
        odometry_frame: frame whose poses the files hold.
        engine: that makes the odometry from the scans also where the recording has one; empty: only where it has none.
    """

    config: ParameterSource = None
    dataset: str = "auto"
    embedder: str | None = None
    weights: str | None = None
    odometry: Path | None = None
    odometry_frame: str = "body"
    engine: str = ""

    def settings(self, bag: Bag) -> Settings:
        """Return settings for a recording."""
        overrides = {"embedding__method": self.embedder, "embedding__weights": self.weights}
        return settings_for(bag, self.config, self.dataset, mode="mapping", **overrides)

    def engine_for(self, bag: Bag, settings: Settings) -> str:
        """Return the engine that makes odometry without a file; empty where that of the recording is used.

        Raises:
            BagError: there are neither odometry nor scans.
        """
        if not self.engine and present_topics(bag, settings).odometry:
            return ""
        if not self.engine and not can_track(bag, settings):
            raise BagError(f"{bag.path} has neither odometry nor scans to make it from, {REMEDY}")
        return self.engine or ODOMETRY_ENGINES[0]

    def check(self, bag: Bag) -> None:
        """Raise an `UmfError` if a recording cannot be opened with these options, or has no odometry."""
        settings = self.settings(bag)
        if self.odometry_of(bag.path, settings) is None:
            self.engine_for(bag, settings)

    def odometry_of(self, recording: Path, settings: Settings) -> Trajectory | None:
        """Return the odometry of a recording from its TUM file; None where there is none."""
        given, endings = self.odometry, (".tum", ".odometry.tum")
        files = [given, *(given / f"{recording.stem}{ending}" for ending in endings)] if given else []
        path = next((one for one in files if one.is_file()), None)
        return None if path is None else read_odometry(path, self.odometry_frame, settings)


def find_recordings(paths: list[Path]) -> list[Path]:
    """Return the recordings among files and folders, those of a folder sorted by name."""
    found = []
    for path in paths:
        if not path.exists():
            raise BagError(f"there is no recording {path}")
        # else one of a data set, or none
        found += sorted(filter(_is_recording, [path] if path.is_file() else [path, *path.iterdir()])) or [path]
    return list(dict.fromkeys(path.resolve() for path in found))


def _is_recording(path: Path) -> bool:
    return path.suffix in RECORDINGS if path.is_file() else (path / "metadata.yaml").is_file()


def replay_session(recording: Path, opening: Opening, folder: Path, on_frame: OnFrame = lambda *_: None) -> None:
    """Replay one recording into a run folder; one of a process that was killed is continued.

    Scans make the odometry where there is none. The folder gets `places.sqlite`, stamped by the recording's own clock,
    and its summary the findings about the recording, worst first.
    `on_frame` is called for every frame.
    """
    bag = open_bag(recording)
    settings = opening.settings(bag)
    store = Database(path=str(folder / PLACES), cached_keyframes=settings.database.cached_keyframes)
    settings = settings.model_copy(update={"database": store})
    resume = is_unfinished(folder, recording) and is_of(folder, settings)
    if not resume:
        rmtree(folder, ignore_errors=True)
        begin_folder(folder, recording)
    reader = FrameReader(bag, settings, _odometry(bag, opening, settings, folder))
    detector = LoopDetector(settings, make_detector_embedder(settings))
    replay = Replay(folder, settings, detector, resume)
    for detection in replay.run(reader.stream()):
        on_frame(reader.progress, detection)
    has_odometry = replay.finish(count_drops(reader.counters))
    sensors = detector.sensors.report(read_odometry_of(folder))
    remember_recording(folder, bag, inputs=input_counts(reader.counters), sensors=sensors.as_json())
    replay.raise_if_frames_failed()
    if not has_odometry:
        raise BagError(f"{recording} has no usable odometry, {REMEDY}")
    found = look_first(JudgedRun(read_run(folder), bag=bag, sensors=sensors))
    withheld = [WITHHELD] if find_contradictions(sensors) else []
    lines = [one.line for one in found if one.severity != "note"] + withheld
    remember_recording(folder, bag, findings=lines, withheld=bool(withheld))


def _odometry(bag: Bag, opening: Opening, settings: Settings, folder: Path) -> Trajectory | None:
    """Return the odometry of a file, or of the scans where the recording has none, which is kept in the run folder."""
    given, made = opening.odometry_of(bag.path, settings), folder / MADE_ODOMETRY
    if given is not None or not (engine := opening.engine_for(bag, settings)):
        return given
    found = odometry_of_scans(bag, settings, engine, made)
    write_tum(made, found)
    return found


def add_session(target: MapFolder, name: str, recording: Path) -> MapSession:
    """Add the run folder of a recording to the map: its places move to the map's database, on the map's clock.

    Places that a killed process left behind are removed first. All recordings must be embedded by one network.
    """
    run = target.folder_of(name)
    bag = open_bag(recording)
    with closing(open_places(run / PLACES)) as own:
        known = (own[row] for row in range(len(own)))
        session = add_places(target, name, known, stored_identity(run / PLACES), describe_recording(bag))
    with writing(run):
        for path in run.glob(f"{PLACES}*"):
            path.unlink()
    return session


def add_places(
    target: MapFolder, name: str, known: Iterable[Keyframe], identity: tuple[str, int], recording: dict[str, Any]
) -> MapSession:
    """Add places of a session to the map's store, on the map's clock; `map.json`, written last, makes them its own.

    The run folder of the session holds its odometry; the known places are on its own clock. `identity` is the embedder
    of the places and the numbers per descriptor.
    """
    _discard_unfinished(target)
    with closing(PlaceDatabase(Database(path=str(target.places)), *identity)) as places:
        first_place, first_number = len(places), places.next_session
        odometry, _ = target.inputs_of(name)
        known = list(known)
        stamps = [keyframe.stamp_ns for keyframe in known] or [recording["start_ns"]]
        span = [*stamps, *(one.stamp_ns for one in odometry)]
        shift_ns = target.shift_for(min(span))
        for one in known:
            stamp_ns, number = one.stamp_ns + shift_ns, one.session + first_number
            places.add(replace(one, stamp_ns=stamp_ns, session=number))
        submaps = SubmapHistory(places.store)
        for number in range(first_number, places.next_session):
            submaps.describe(number)
        session = MapSession(
            name=name,
            recording=recording,
            shift_ns=shift_ns,
            first_ns=min(span),
            last_ns=max(span),
            first_place=first_place,
            places=len(known),
            first_number=first_number,
            numbers=places.next_session - first_number,
        )
    target.add(session)
    return session


def match_session(target: MapFolder, session: MapSession) -> Iterator[list[Hypothesis]]:
    """Match a recording against the earlier ones; yield the verdicts of every keyframe, accepted ones first.

    Closures of sessions whose sensors contradict each other are withheld. Writes `closures_between.csv` atomically.
    The map's database is only read: several sessions may be matched at once.
    """
    settings = target.settings
    rows = range(session.first_place, session.first_place + session.places)
    found_rows: list[list[Any]] = []
    wrong = [one for one in target.sessions if summary_of(target, one.name).get("withheld")]
    with closing(open_places(target.places)) as places:
        verifier, number, earlier = Verifier(settings.verification), -1, range(session.first_number)
        submaps = SubmapFinder(settings.verification, settings.loop, places, earlier)
        for row in rows:
            keyframe = places[row]
            if keyframe.session != number:
                verifier.reset()
                submaps.reset()
                number = keyframe.session
            candidates = places.query(keyframe, settings.loop, earlier)
            verdicts = verifier.verify(keyframe, [(found, places[found.index]) for found in candidates])
            verdicts = submaps.find(keyframe, verdicts)
            submaps.remember(keyframe)
            usable = [v for v in verdicts if not any(target.session_at(at) in wrong for at in v.endpoints)]
            found_rows += [closure_row(v.closure, v.candidate.similarity) for v in usable if v.closure]
            yield verdicts
    write_table(target.folder_of(session.name) / BETWEEN, CLOSURES, found_rows)


def replay_task(task: tuple[Path, Opening, Path]) -> None:
    """Run `replay_session` as a task of another process."""
    replay_session(*task)


def match_task(task: tuple[Path, MapSession]) -> None:
    """Run `match_session` as a task of another process, given the folder of the map."""
    for _ in match_session(MapFolder.open(task[0]), task[1]):
        pass


def unmatched(target: MapFolder) -> list[MapSession]:
    """Return the added sessions that are not matched completely against the earlier ones."""
    return [session for session in target.sessions if not (target.folder_of(session.name) / BETWEEN).is_file()]


def _discard_unfinished(target: MapFolder) -> None:
    """Delete the places of a recording that a killed process had not added completely."""
    if not target.places.is_file():
        return
    known = max((session.first_number + session.numbers for session in target.sessions), default=0)
    unfinished = [one.number for one in stored_sessions(target.places) if one.number >= known]
    if unfinished:
        delete_sessions(target.places, unfinished)


def open_places(path: Path) -> PlaceDatabase:
    """Open a place database of any embedder for reading."""
    return PlaceDatabase(Database(path=str(path)), *stored_identity(path), read_only=True)


def grow(map_folder: Path, run: Path) -> tuple[MapSession | None, dict[str, Any]]:
    """Add what a rover saw in a run that localised, since the run was added last, and solve the map.

    The run may go on. Returns the new session, None where there is nothing new, and the summary of the map.

    Raises:
        UmfError: either is missing or damaged, or another process adds to the map.
        OutputError: the map cannot be written.
    """
    if not (run / PLACES).is_file():
        raise UmfError(f"{run} holds no places: localization.update keeps them while a rover localises")
    lock = lock_file(map_folder / "map.json")
    try:
        target = MapFolder.open(map_folder)
        new = _new_places(target, run)
        session = _add_run(target, run, new) if len(new) >= FEWEST else None
        if session is None and _is_solved(target):
            return None, read_json(target.path / "summary.json")
        return session, write_results(target, solve(target))
    finally:
        os.close(lock)


def _new_places(target: MapFolder, run: Path) -> list[Keyframe]:
    """Places of a run, with odometry, that are in no session of the map."""
    known = [one for one in target.sessions if one.recording["path"] == str(run.resolve())]
    with closing(open_places(run / PLACES)) as own:
        found = [own[row] for row in range(len(own))]
    return [
        one
        for one in found
        if one.odom_T_body is not None and not any(s.first_ns <= one.stamp_ns <= s.last_ns for s in known)
    ]


def _add_run(target: MapFolder, run: Path, new: list[Keyframe]) -> MapSession:
    """Add what a rover saw in a run to the map, with the closures that it found there."""
    stamps, odometry = [one.stamp_ns for one in new], list[OdometrySample]()
    for one in new:
        assert one.odom_T_body is not None
        odometry.append(OdometrySample(one.stamp_ns, one.odom_T_body))
    with closing(RunFile(run, read_only=True)) as file:
        between = [one for one in file.closures() if one.query_stamp_ns in set(stamps)]
    about = {"path": str(run.resolve()), "start_ns": min(stamps), "end_ns": max(stamps), "messages": {}}
    drive = Drive(target.free_name(run), odometry, new, between)
    return add_drive(target, drive, stored_identity(run / PLACES), about)


class Drive(NamedTuple):
    """A session that no recording is replayed for, on its own clock.

    Attributes:
        name: of the session.
        odometry: of the drive.
        places: along it.
        between: closures with earlier places, whose matches are on the clock of the map.
    """

    name: str
    odometry: list[OdometrySample]
    places: list[Keyframe]
    between: list[LoopClosure]


def add_drive(target: MapFolder, drive: Drive, identity: tuple[str, int], about: dict[str, Any]) -> MapSession:
    """Write the run folder of a drive, and add its places to the map; `identity` and `about` as in `add_places`."""
    folder = target.folder_of(drive.name)
    with writing(folder):
        rmtree(folder, ignore_errors=True)  # of a process that was killed
        folder.mkdir(parents=True)
    with closing(RunFile(folder)) as file:
        for sample in drive.odometry:
            file.append_odometry(sample)
    keyframes = [[one.stamp_ns, one.session, f"{one.path_length_m:.4f}"] for one in drive.places]
    write_table(folder / "keyframes.csv", COLUMNS["keyframes"], keyframes)
    write_table(folder / "closures.csv", CLOSURES, [])
    shift_ns = target.shift_for(drive.odometry[0].stamp_ns)
    moved = [replace(one, query_stamp_ns=one.query_stamp_ns + shift_ns) for one in drive.between]
    write_table(folder / BETWEEN, CLOSURES, [closure_row(one, float("nan")) for one in moved])
    return add_places(target, drive.name, drive.places, identity, about)


def _is_solved(target: MapFolder) -> bool:
    """Whether the results of a map are about all of its sessions."""
    try:
        summary = read_json(target.path / "summary.json")
        return [one["name"] for one in summary["sessions"]] == [one.name for one in target.sessions]
    except (OSError, ValueError, KeyError, TypeError):
        return False
