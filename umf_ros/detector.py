"""Loop detector: from synchronised frames to verified loop closures."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import small_gicp

from umf_ros.core.config import KeyframePolicy, Settings
from umf_ros.core.errors import ConfigError, OutputError, UmfError
from umf_ros.core.frames import Candidate, Embedding, Frame, Keyframe, LoopClosure
from umf_ros.core.geometry import Array, relative, rotation_angle
from umf_ros.embedding import Embedder, make_embedder
from umf_ros.embedding.depth import lift
from umf_ros.places.database import PlaceDatabase
from umf_ros.sensors.sensor_check import SensorCheck
from umf_ros.submaps import SubmapFinder
from umf_ros.verification import Hypothesis, RejectReason, Verifier, thin_frame
from umf_ros.verification.hypothesis import IMAGE

if TYPE_CHECKING:
    from umf_ros.fleet.inter_robot_closures import InterRobotClosure, InterRobotMatcher
    from umf_ros.submaps.history import SubmapHistory

logger = logging.getLogger(__name__)
Other = TypeVar("Other")
"""Items of a stream beside frames, such as odometry."""
NOTHING_METRIC = "candidates are reported, but none becomes a loop closure"
WITHHELD = "closures are withheld"
FRAMES_AHEAD = 20
"""Most frames that the sensor check may lag behind; bounds the memory."""
MOST_HELD = 400
"""Most items of a recording that are read ahead for the next keyframe; bounds the memory (*by hand*)."""
COUNTED_STEP_M = 0.05
"""Least motion that counts: odometry noise of a parked rover must not add up to metres (*by hand*)."""
NOT_EMBEDDED = Embedding(np.empty(0, np.float32))
"""Embedding of keyframes whose scan alone is used."""


@dataclass(frozen=True, slots=True)
class Detection:
    """Result of one frame.

    Attributes:
        frame_stamp_ns: key of the frame.
        keyframe: the keyframe made of it, or None when it was not selected.
        verdicts: one for every candidate that was tested, best first.
        latency_ms: milliseconds of embed, query, verify and submaps, and of their total.
        fault: error of storing the keyframe (a full disk); the closures are valid.
    """

    frame_stamp_ns: int
    keyframe: Keyframe | None = None
    verdicts: list[Hypothesis] = field(default_factory=list)
    latency_ms: dict[str, float] = field(default_factory=dict)
    fault: OutputError | None = None

    @property
    def closures(self) -> list[LoopClosure]:
        """The verified loop closures."""
        return [verdict.closure for verdict in self.verdicts if verdict.closure is not None]


class KeyframeSelector:
    """Selection of keyframes by distance, angle and time, with the path length in each session.

    With odometry a frame is kept after enough motion; after `max_period_s` it is
    kept only if the rover moved at all, so that a parked rover does not fill the database. Without
    odometry frames are kept every `untracked_period_s`.
    """

    def __init__(self, policy: KeyframePolicy) -> None:
        self._policy = policy
        self.reset()

    def reset(self) -> None:
        """Reset, as at the start of a session."""
        self._last: Frame | None = None
        self._counted: Array | None = None
        self._path_length_m = 0.0

    def path_length_m(self, frame: Frame) -> float:
        """Return the metres driven from the start of the session to `frame`; NaN without odometry."""
        return self._path_length_m if frame.odom_T_body is not None else math.nan

    def select(self, frame: Frame) -> bool:
        """Return whether `frame` becomes a keyframe; call once per frame, in order of stamps within a session."""
        if self._last is not None and frame.session != self._last.session:
            self.reset()
        self._count_metres(frame)
        if self._last is not None and not self._is_due(self._last, frame):
            return False
        self._last = frame
        return True

    def _count_metres(self, frame: Frame) -> None:
        if frame.odom_T_body is None:
            return
        if self._counted is None:
            self._counted = frame.odom_T_body
        step = float(np.linalg.norm(frame.odom_T_body[:3, 3] - self._counted[:3, 3]))
        if step >= COUNTED_STEP_M:
            self._path_length_m += step
            self._counted = frame.odom_T_body

    def _is_due(self, last: Frame, frame: Frame) -> bool:
        policy = self._policy
        waited_s = (frame.stamp_ns - last.stamp_ns) * 1e-9
        if waited_s < policy.min_period_s:
            return False
        if frame.odom_T_body is None or last.odom_T_body is None:
            return waited_s >= policy.untracked_period_s
        moved = relative(last.odom_T_body, frame.odom_T_body)
        distance_m = float(np.linalg.norm(moved[:3, 3]))
        angle_deg = math.degrees(rotation_angle(moved))
        if distance_m >= policy.min_translation_m or angle_deg >= policy.min_rotation_deg:
            return True
        return waited_s >= policy.max_period_s and distance_m >= COUNTED_STEP_M


@dataclass(slots=True)
class _Upcoming:
    """A prefetched frame, and its embedding in progress."""

    frame: Frame
    is_keyframe: bool
    path_length_m: float
    embedding: Future[tuple[Embedding, float]] | None = None


class LoopDetector:
    """Loop detector on a stream of frames; the same in the live node, the replay and the evaluation.

    `process` takes a frame through all stages: `select`, `embed`, `query`, `verify`, `match_submaps`, `remember`.
    While localising in a map, the last one keeps places for a later session of the map, or none.

    Args:
        settings: all settings.
        embedder: the network.

    Attributes:
        database: the rover's places.
        seen: its places while it localises in a map that grows, in sessions of their own; None: they are not kept.
        inter_robot: closures with other rovers of a fleet; None of a rover on its own.
        sensors: check of all frames, in a thread of its own; what it finds impossible withholds closures.
        hint: poses `match_T_query` by stamps of places of the map near where the rover may be, verified first, as a
            function of the keyframe; None: searched only.
        embedder_name: name of the network.
        embed_ms: milliseconds that the last embedding took, prefetched or not.

    Raises:
        UmfError: the place database of the settings belongs to another embedder.
    """

    def __init__(self, settings: Settings, embedder: Embedder) -> None:
        small_gicp.PointCloud(np.eye(3))  # its binding must be initialised before there are other threads
        self._rules = settings.loop
        self._selector = KeyframeSelector(settings.keyframe)
        self._embedder: Embedder | None = embedder
        self.embedder_name = embedder.name
        self._verifier = Verifier(settings.verification)
        identity = embedder.name, embedder.dimension
        with ExitStack() as opened:  # closed again where one of them fails
            if settings.localizing:
                self.database = PlaceDatabase.of_map(Path(settings.map), *identity)
            else:
                self.database = PlaceDatabase(settings.database, *identity)
            opened.callback(self.database.close)
            self._map = self.database.listed
            self.seen = PlaceDatabase(settings.database, *identity) if settings.grows_map else None
            if self.seen is not None:
                opened.callback(self.seen.close)
            self._submaps = SubmapFinder(settings.verification, settings.loop, self.database, self._map)
            self.inter_robot = _connect_fleet(settings, embedder, self._submaps.history)
            opened.pop_all()
        self.hint: Callable[[Keyframe], dict[int, Array]] | None = None
        self._session: int | None = None
        self._stored_session = self.database.next_session
        self._ahead_m = 0.0
        self._warned_without_depth = False
        self.embed_ms = 0.0
        self._network = ThreadPoolExecutor(1, "embedding")
        self.sensors = SensorCheck()
        self._checking = ThreadPoolExecutor(1, "sensor-check")  # OpenCV releases the interpreter lock
        self._unchecked: deque[Future[None]] = deque()
        self._named: set[str] = set()
        self._queue: deque[_Upcoming] = deque()
        self._current: _Upcoming | None = None

    def retune(self, settings: Settings) -> None:
        """Search and verify with other settings from the next frame on."""
        self._rules = settings.loop
        self._verifier.retune(settings.verification)
        self._submaps.retune(settings.verification, settings.loop)
        if self.inter_robot is not None:
            self.inter_robot.retune(settings.verification)

    def process(self, frame: Frame, publish: Callable[[Detection], None] = lambda _: None) -> Detection:
        """Process one frame, in order of stamps within a session; `publish` gets the result before it is stored."""
        self._check(frame)
        if not self.select(frame):
            return Detection(frame.stamp_ns)
        keyframe = self.embed(frame)
        latency = {"embed": self.embed_ms}
        known = self.database.find_duplicate(keyframe) if self._map is None else None
        if known is not None:
            keyframe = self._continue_from(known)
        with _timed(latency, "query"):
            candidates = self.query(keyframe)
        with _timed(latency, "verify"):
            verdicts = self.verify(keyframe, candidates)
        with _timed(latency, "submaps"):
            verdicts = self.match_submaps(keyframe, verdicts)
        if any(one.accepted for one in verdicts):
            self.hint = None  # odometry carries the pose on from the closure
        self._withhold(verdicts)
        detection = Detection(frame.stamp_ns, keyframe, verdicts, latency | {"total": sum(latency.values())})
        publish(detection)
        try:
            self.remember(keyframe, known is not None)
        except OutputError as error:
            return replace(detection, fault=error)
        return detection

    def prefetch(
        self, stream: Iterable[Frame | Other], wanted: Callable[[], bool] = lambda: True
    ) -> Iterator[Frame | Other]:
        """Yield a recording's stream unchanged, each keyframe after the embedding of the next one has started.

        Args:
            stream: frames and odometry of a recording, in the order in which they are processed.
            wanted: whether keyframes are embedded at present.
        """
        held: list[Frame | Other] = []
        for item in stream:
            if isinstance(item, Frame):
                self._queue.append(self._decide(item))
                if self._queue[-1].is_keyframe and wanted():
                    self._begin(self._queue[-1])
                if self._queue[-1].is_keyframe or len(held) >= MOST_HELD:  # a parked rover has no next one
                    yield from held
                    held.clear()
            held.append(item)
        yield from held

    def select(self, frame: Frame) -> bool:
        """Return whether the frame becomes a keyframe; call once per frame, in order of stamps within a session."""
        while self._queue and self._queue[0].frame is not frame:
            self._queue.popleft()
        self._current = self._queue.popleft() if self._queue else self._decide(frame)
        if frame.session != self._session:
            self._start_session(frame)
        return self._current.is_keyframe

    def embed(self, frame: Frame) -> Keyframe:
        """Return the keyframe of the frame that `select` was called with last, prefetched or not."""
        if self._current is None or self._current.frame is not frame:
            raise ValueError("call select with this frame first")
        coming = self._begin(self._current)
        path_length_m = self._current.path_length_m + self._ahead_m
        keyframe = assemble(frame, NOT_EMBEDDED, path_length_m, self._stored_session)
        if not coming.done() and len(self.database):
            self._verifier.prefetch(keyframe)  # in parallel with the network
        embedding, self.embed_ms = coming.result()
        return replace(keyframe, embedding=embedding)

    def _decide(self, frame: Frame) -> _Upcoming:
        is_keyframe = self._selector.select(frame)
        return _Upcoming(frame, is_keyframe, self._selector.path_length_m(frame))

    def _begin(self, upcoming: _Upcoming) -> Future[tuple[Embedding, float]]:
        if upcoming.embedding is None:
            upcoming.embedding = self._network.submit(self._embed_timed, upcoming.frame)
        return upcoming.embedding

    def _embed_timed(self, frame: Frame) -> tuple[Embedding, float]:
        start = time.perf_counter()
        assert self._embedder is not None, "the detector is closed"
        embedding = lift(frame, self._embedder.embed(frame))
        return embedding, 1e3 * (time.perf_counter() - start)

    def query(self, keyframe: Keyframe) -> list[Candidate]:
        """Return the stored places most similar to a keyframe, best first."""
        return self.database.query(keyframe, self._rules, self._map)

    def verify(self, keyframe: Keyframe, candidates: Sequence[Candidate]) -> list[Hypothesis]:
        """Test the candidates geometrically."""
        if self.hint is not None and (verdicts := self._verify_near(keyframe, self.hint(keyframe))):
            return verdicts
        verdicts = self._verifier.verify(keyframe, [(found, self.database[found.index]) for found in candidates])
        self._warn_without_depth(verdicts)
        return verdicts

    def _verify_near(self, keyframe: Keyframe, guesses: dict[int, Array]) -> list[Hypothesis]:
        """Return verdicts with a closure with the places of a hint, by scans or by submaps; empty without any."""
        candidates = []
        if not guesses:
            self.hint = None
        for row in (row for stamp_ns in guesses for row in self.database.store.rows_at(stamp_ns)):
            similarity = float(self.database.store.descriptors(np.array([row]))[0] @ keyframe.embedding.descriptor)
            candidates.append(Candidate(row, self.database[row].stamp_ns, similarity))
        offered = [(found, self.database[found.index]) for found in candidates]
        verdicts = self._verifier.verify(keyframe, offered, guesses)
        if not any(one.accepted for one in verdicts):
            verdicts = self._submaps.compare(keyframe, candidates, guesses)
        return verdicts if any(one.accepted for one in verdicts) else []

    def match_submaps(self, keyframe: Keyframe, verdicts: list[Hypothesis]) -> list[Hypothesis]:
        """Return the verdicts, accepted ones first, with those of submaps where the scans gave no closure."""
        return self._submaps.find(keyframe, verdicts)

    def remember(self, keyframe: Keyframe, stored: bool = False) -> None:
        """Store a keyframe as a place, unless it is stored already.

        Raises:
            OutputError: the disk is full.
        """
        if self._map is not None:
            if self.seen is not None:
                self.seen.add(replace(keyframe, session=keyframe.session - self._map.stop))
        elif not stored:
            row = self.database.add(keyframe)
            if self.inter_robot is not None and not self.sensors.contradictions:
                self.inter_robot.link.enqueue(row)
        self._submaps.remember(keyframe)

    def resume(self, frame: Frame) -> bool:
        """Record a frame that an earlier run with the same database has processed, without a search.

        Returns:
            Whether it is a keyframe.
        """
        self._check(frame)
        if not self.select(frame):
            return False
        if known := self.database.store.rows_at(frame.stamp_ns):
            self._submaps.remember(self._continue_from(known[-1]))
        return True

    def next_inter_robot_closure(self) -> InterRobotClosure | None:
        """Return the next verified closure with another rover of a fleet; None without a new one."""
        return self.inter_robot.next() if self.inter_robot is not None else None

    def close(self) -> None:
        """Disconnect from the fleet's server, and release the database, the network and the scans."""
        self._network.shutdown(cancel_futures=True)
        self._checking.shutdown()
        self._embedder = None
        self._verifier.reset()
        if self.inter_robot is not None:
            self.inter_robot.link.close()
        self.database.close()
        if self.seen is not None:
            self.seen.close()

    def end_session(self) -> None:
        """End the session: the next frame begins a new one; all places are kept."""
        self._session = None
        self._selector.reset()

    def _check(self, frame: Frame) -> None:
        self._unchecked.append(self._checking.submit(self.sensors.take, frame))
        self._await_check(FRAMES_AHEAD)
        for one in self.sensors.contradictions:
            if one.subject not in self._named:
                self._named.add(one.subject)
                logger.error("%s: %s; %s", WITHHELD, one.what, one.remedy)

    def _await_check(self, at_most: int) -> None:
        while len(self._unchecked) > at_most or (self._unchecked and self._unchecked[0].done()):
            self._unchecked.popleft().result()

    def _withhold(self, verdicts: Sequence[Hypothesis]) -> None:
        """Reject closures that rest on axes, mountings or images that the frames so far prove wrong."""
        accepted = [one for one in verdicts if one.accepted]
        if accepted:
            self._await_check(0)  # so that the verdicts do not depend on threads
        for found in self.sensors.contradictions:
            for one in accepted:
                if found.subject != "camera" or one.kind == IMAGE:
                    one.reject(RejectReason.SENSORS, found.what)

    def _warn_without_depth(self, verdicts: Sequence[Hypothesis]) -> None:
        """Warn once that candidates have no metric pose: one camera without a LiDAR measures no depth."""
        if not self._warned_without_depth and any(verdict.reason is RejectReason.NO_DEPTH for verdict in verdicts):
            self._warned_without_depth = True
            logger.warning("%s: %s", NOTHING_METRIC, RejectReason.NO_DEPTH.value)

    def _start_session(self, frame: Frame) -> None:
        """Begin a session; if the clock was set back, keyframes with later stamps are not searched until then."""
        self._session = frame.session
        self._stored_session, self._ahead_m = self.database.next_session, 0.0
        if self.seen is not None:
            self._stored_session += self.seen.next_session
        if len(self.database) and self._map is None:
            logger.warning("a new session begins; the %d places known so far are kept", len(self.database))
        self._verifier.reset()
        self._submaps.reset()

    def _continue_from(self, known: int) -> Keyframe:
        """Return the stored keyframe of a frame processed before, and continue its session and path length."""
        keyframe = self.database[known]
        self._stored_session = keyframe.session
        ahead_m = keyframe.path_length_m - self._current.path_length_m if self._current else math.nan
        self._ahead_m = 0.0 if math.isnan(ahead_m) else ahead_m
        return keyframe


def make_keyframe(frame: Frame, embedder: Embedder, path_length_m: float = math.nan) -> Keyframe:
    """Return the keyframe of a frame: embedded, its features lifted to 3-D, its scan thinned."""
    return assemble(frame, lift(frame, embedder.embed(frame)), path_length_m)


def assemble(frame: Frame, embedding: Embedding, path_length_m: float = math.nan, session: int = 0) -> Keyframe:
    """Return the keyframe of a frame whose embedding is known, its scan thinned."""
    points, motion = thin_frame(frame)
    return Keyframe(
        stamp_ns=frame.stamp_ns,
        embedding=embedding,
        camera=frame.camera,
        body_T_camera=frame.body_T_camera,
        points=points,
        odom_T_body=frame.odom_T_body,
        path_length_m=path_length_m,
        session=session,
        body_T_lidar=frame.body_T_lidar,
        motion=motion,
    )


def _connect_fleet(settings: Settings, embedder: Embedder, submaps: SubmapHistory) -> InterRobotMatcher | None:
    """Connect to the server of a fleet; its packages are imported only then.

    Raises:
        ConfigError: the settings name no server.
        UmfError: a package of the fleet is not installed.
    """
    if settings.database.backend == "sqlite" or settings.localizing:
        return None
    if not settings.database.server:
        raise ConfigError("database.backend: postgres needs database.server")
    try:
        from umf_ros.fleet.inter_robot_closures import InterRobotMatcher
    except ModuleNotFoundError as error:
        raise UmfError(f"{error.name} is not installed; database.backend: postgres needs umf_ros[fleet]") from None
    return InterRobotMatcher(settings, submaps, (embedder.name, embedder.dimension))


def make_detector_embedder(settings: Settings) -> Embedder:
    """Return the embedder of the settings, with the features that verification needs.

    Raises:
        ConfigError: unknown method, runtime or device.
        WeightsError: the weights cannot be used.
    """
    return make_embedder(settings.embedding, features=settings.verification.features)


@contextmanager
def _timed(latency_ms: dict[str, float], name: str) -> Iterator[None]:
    """Add the milliseconds that the block takes, by name."""
    start = time.perf_counter()
    yield
    latency_ms[name] = 1e3 * (time.perf_counter() - start)
