"""From synchronised frames to verified loop closures: the method of the thesis on one screen."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import small_gicp

from umf_ros.core.config import Settings
from umf_ros.core.errors import ConfigError, OutputError, UmfError
from umf_ros.core.frames import Candidate, Frame, Keyframe, LoopClosure
from umf_ros.core.keyframes import KeyframeSelector
from umf_ros.embedding import make_embedder
from umf_ros.embedding.depth import lift
from umf_ros.embedding.embedder import Embedder
from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps import SubmapFinder
from umf_ros.verification import Hypothesis, RejectReason, Verifier, thin_frame

if TYPE_CHECKING:
    from umf_ros.fleet.inter_robot_closures import InterRobotClosure, InterRobotMatcher

logger = logging.getLogger(__name__)
Other = TypeVar("Other")
"""Items of a stream beside frames, such as odometry."""
NOTHING_METRIC = "candidates are reported, but none becomes a loop closure"


@dataclass(frozen=True, slots=True)
class Detection:
    """Result of one frame.

    Attributes:
        frame_stamp_ns: key of the frame.
        keyframe: the keyframe it became, or None when it was passed over.
        verdicts: one for every candidate that was tested, best first.
        latency_ms: milliseconds of embed, query, verify and submaps, and of their total.
        fault: why the keyframe could not be remembered (a full disk); what was found stands.
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


@dataclass(slots=True)
class _Upcoming:
    """A frame that is known before it is processed, and the embedding that was begun for it."""

    frame: Frame
    is_keyframe: bool
    path_length_m: float
    embedding: Future[tuple[Keyframe, float]] | None = None


class LoopDetector:
    """Finds loop closures in a stream of frames; the same class in the live node, the replay and the evaluation.

    `process` takes a frame through all stages: `select`, `embed`, `query`, `verify`, `match_submaps`, `remember`.
    The last one is skipped while localising in a map that stays as it is.

    Args:
        settings: all settings.
        embedder: the network.

    Attributes:
        database: the rover's places.
        encounters: with other rovers of a fleet; None of a rover on its own.
        embed_ms: milliseconds that the last embedding took, prefetched or not.

    Raises:
        UmfError: the place database of the settings belongs to another embedder.
    """

    def __init__(self, settings: Settings, embedder: Embedder) -> None:
        small_gicp.PointCloud(np.eye(3))  # its binding initialises itself once, before there are other threads
        self._rules = settings.loop
        self._selector = KeyframeSelector(settings.keyframe)
        self._embedder = embedder
        self._verifier = Verifier(settings.verification)
        self.database = _open_places(settings, embedder)
        self.inter_robot = _encounters(settings, self.database, embedder)
        self._map = range(self.database.next_session) if settings.localizing else None
        self._submaps = SubmapFinder(settings.verification, settings.loop, self.database)
        self._session: int | None = None
        self._stored_session = self.database.next_session
        self._ahead_m = 0.0
        self._depth_told = False
        self.embed_ms = 0.0
        self._network = ThreadPoolExecutor(1, "embedding")
        self._queue: deque[_Upcoming] = deque()
        self._current: _Upcoming | None = None

    def retune(self, settings: Settings) -> None:
        """Search and verify by other settings from the next frame on."""
        self._rules = settings.loop
        self._verifier.retune(settings.verification)
        self._submaps.retune(settings.verification, settings.loop)

    @property
    def embedder_name(self) -> str:
        """Name of the network."""
        return self._embedder.name

    def process(self, frame: Frame) -> Detection:
        """Take one frame, in order of stamps within a session."""
        if not self.select(frame):
            return Detection(frame.stamp_ns)
        latency = Stopwatch()
        keyframe = self.embed(frame)
        latency.add("embed", self.embed_ms)
        known = self.database.find_duplicate(keyframe) if self._map is None else None
        if known is not None:
            keyframe = self._go_on_from(known)
        with latency.measure("query"):
            candidates = self.query(keyframe)
        with latency.measure("verify"):
            verdicts = self.verify(keyframe, candidates)
        fault = None
        with latency.measure("submaps"):
            verdicts = self.match_submaps(keyframe, verdicts)
        if self._map is None:
            try:
                self.remember(keyframe, known is not None)
            except OutputError as error:
                fault = error
        else:
            self._submaps.remember(keyframe)
        return Detection(frame.stamp_ns, keyframe, verdicts, latency.milliseconds, fault)

    def prefetch(
        self, stream: Iterable[Frame | Other], wanted: Callable[[], bool] = lambda: True
    ) -> Iterator[Frame | Other]:
        """Yield a recording's stream unchanged, each keyframe after the network has begun to embed the next one.

        Args:
            stream: frames and odometry of a recording, in the order in which they are processed.
            wanted: whether keyframes are embedded at present.
        """
        held: list[Frame | Other] = []
        for item in stream:
            if isinstance(item, Frame):
                self._queue.append(self._decide(item))
                if self._queue[-1].is_keyframe:
                    if wanted():
                        self._begin(self._queue[-1])
                    yield from held
                    held.clear()
            held.append(item)
        yield from held

    def select(self, frame: Frame) -> bool:
        """Whether the frame becomes a keyframe; call once per frame, in order of stamps within a session."""
        while self._queue and self._queue[0].frame is not frame:
            self._queue.popleft()
        self._current = self._queue.popleft() if self._queue else self._decide(frame)
        if frame.session != self._session:
            self._start_session(frame)
        return self._current.is_keyframe

    def embed(self, frame: Frame) -> Keyframe:
        """Return the keyframe of the frame that `select` was called with last, prefetched or not."""
        if self._current is None or self._current.frame is not frame:
            raise ValueError("select has to be called with this frame first")
        coming = self._begin(self._current)
        if not coming.done() and len(self.database):
            self._verifier.prefetch(frame)  # beside the network
        keyframe, self.embed_ms = coming.result()
        path_length_m = self._current.path_length_m + self._ahead_m
        return replace(keyframe, path_length_m=path_length_m, session=self._stored_session)

    def _decide(self, frame: Frame) -> _Upcoming:
        is_keyframe = self._selector.select(frame)
        return _Upcoming(frame, is_keyframe, self._selector.path_length_m(frame))

    def _begin(self, upcoming: _Upcoming) -> Future[tuple[Keyframe, float]]:
        if upcoming.embedding is None:
            upcoming.embedding = self._network.submit(self._embed_timed, upcoming.frame)
        return upcoming.embedding

    def _embed_timed(self, frame: Frame) -> tuple[Keyframe, float]:
        start = time.perf_counter()
        keyframe = make_keyframe(frame, self._embedder)
        return keyframe, 1e3 * (time.perf_counter() - start)

    def query(self, keyframe: Keyframe) -> list[Candidate]:
        """Remembered places that look like a keyframe, best first."""
        return self.database.query(keyframe, self._rules, self._map)

    def verify(self, keyframe: Keyframe, candidates: Sequence[Candidate]) -> list[Hypothesis]:
        """Test the candidates geometrically."""
        verdicts = self._verifier.verify(keyframe, [(found, self.database[found.index]) for found in candidates])
        self._tell_depthless(verdicts)
        return verdicts

    def match_submaps(self, keyframe: Keyframe, verdicts: list[Hypothesis]) -> list[Hypothesis]:
        """The verdicts, accepted ones first, with those about submaps where the scans have found nothing."""
        return sorted(self._submaps.find(keyframe, verdicts), key=lambda verdict: verdict.closure is None)

    def remember(self, keyframe: Keyframe, stored: bool = False) -> None:
        """Make a keyframe, unless it is stored already, a place that later ones may find.

        Raises:
            OutputError: the disk is full.
        """
        if not stored:
            row = self.database.add(keyframe)
            if self.inter_robot is not None:
                self.inter_robot.link.enqueue(row)
        self._submaps.remember(keyframe)

    def resume(self, frame: Frame) -> bool:
        """Take note of a frame that an earlier run over the same store has dealt with: nothing is looked for.

        Returns:
            Whether it had become a keyframe.
        """
        if not self.select(frame):
            return False
        known = self.database.newest_at(frame.stamp_ns)
        if known is not None:
            self._submaps.remember(self._go_on_from(known))
        return True

    def meet(self) -> InterRobotClosure | None:
        """Verify what a fleet's server found for an earlier keyframe, if there is anything new."""
        return self.inter_robot.next() if self.inter_robot is not None else None

    def close(self) -> None:
        """Leave the fleet's server, and release the database."""
        self._network.shutdown(cancel_futures=True)
        if self.inter_robot is not None:
            self.inter_robot.close()
        self.database.close()

    def end_session(self) -> None:
        """End the session: the next frame begins a new one; every place is kept."""
        self._session = None
        self._selector.reset()

    def _tell_depthless(self, verdicts: Sequence[Hypothesis]) -> None:
        """Say, once, why nothing becomes metric: one camera without a LiDAR recognises places, no more."""
        if not self._depth_told and any(verdict.reason is RejectReason.NO_DEPTH for verdict in verdicts):
            self._depth_told = True
            logger.warning("%s: %s", NOTHING_METRIC, RejectReason.NO_DEPTH.value)

    def _start_session(self, frame: Frame) -> None:
        """A new way begins; where the clock was set back, what was stored later than now waits for its time."""
        self._session = frame.session
        self._stored_session, self._ahead_m = self.database.next_session, 0.0
        if len(self.database) and self._map is None:
            logger.warning("a new session begins; the %d places known so far are kept", len(self.database))
        self._verifier.reset()
        self._submaps.reset()

    def _go_on_from(self, known: int) -> Keyframe:
        """The stored keyframe that a frame became before; what follows belongs to its session, and to its way."""
        keyframe = self.database[known]
        self._stored_session = keyframe.session
        ahead_m = keyframe.path_length_m - self._current.path_length_m if self._current else math.nan
        self._ahead_m = 0.0 if math.isnan(ahead_m) else ahead_m
        return keyframe


def _open_places(settings: Settings, embedder: Embedder) -> PlaceDatabase:
    """The store of the settings, or that of the map to localise in."""
    if settings.localizing:
        return PlaceDatabase.of_map(Path(settings.map), embedder.name, embedder.dimension)
    return PlaceDatabase(settings.database, embedder.name, embedder.dimension)


def make_keyframe(frame: Frame, embedder: Embedder, path_length_m: float = float("nan"), session: int = 0) -> Keyframe:
    """The keyframe that a frame becomes: embedded, its features lifted to 3-D, its scan thinned.

    Args:
        frame: synchronised measurements.
        embedder: the network.
        path_length_m: metres driven since the start of the session, NaN when unknown.
        session: number of the session among all that are stored.
    """
    points, motion = thin_frame(frame)
    return Keyframe(
        stamp_ns=frame.stamp_ns,
        embedding=lift(frame, embedder.embed(frame)),
        camera=frame.camera,
        body_T_camera=frame.body_T_camera,
        points=points,
        odom_T_body=frame.odom_T_body,
        path_length_m=path_length_m,
        session=session,
        body_T_lidar=frame.body_T_lidar,
        motion=motion,
    )


def _encounters(settings: Settings, database: PlaceDatabase, embedder: Embedder) -> InterRobotMatcher | None:
    """The way to other rovers' places, where there is a fleet; what it takes is imported only then.

    Raises:
        ConfigError: the settings name no server.
        UmfError: what it takes is not installed.
    """
    if settings.database.backend == "sqlite" or settings.localizing:
        return None
    if not settings.database.server:
        raise ConfigError("database.backend: postgres needs database.server")
    try:
        from umf_ros.fleet.inter_robot_closures import InterRobotMatcher
    except ModuleNotFoundError as error:
        raise UmfError(f"{error.name} is not installed; database.backend: postgres needs umf_ros[fleet]") from None
    return InterRobotMatcher(settings, database.store, (embedder.name, embedder.dimension))


def make_detector_embedder(settings: Settings) -> Embedder:
    """The embedder the settings name, with the features that verification asks for.

    Raises:
        ConfigError: unknown method, runtime or device.
        WeightsError: the weights cannot be used.
    """
    chosen = settings.verification
    return make_embedder(settings.embedding, chosen.rerank == "superfeatures", chosen.features)


class Stopwatch:
    """Wall-clock milliseconds by name, with their total."""

    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {"total": 0.0}

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Time the block."""
        start = time.perf_counter()
        yield
        self.add(name, 1e3 * (time.perf_counter() - start))

    def add(self, name: str, elapsed_ms: float) -> None:
        """Add a time that was measured elsewhere."""
        self.milliseconds[name] = elapsed_ms
        self.milliseconds["total"] += elapsed_ms
