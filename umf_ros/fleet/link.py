"""The thread that pushes a rover's places to the fleet's server, and queries those of other rovers."""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict, deque
from dataclasses import replace
from typing import NamedTuple
from uuid import UUID

from umf_ros.core.config import Database
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.fleet.server import FleetKey, FleetServer, LinkError
from umf_ros.places.store import KeyframeStore, unpack
from umf_ros.verification import constants as const

logger = logging.getLogger(__name__)

BATCH = 16
"""Keyframes of one transaction."""
ASKS_KEPT = 1000
"""Queries kept while disconnected, ten minutes of driving; the oldest are dropped."""
ANSWERS_KEPT = 20
"""Answers pending verification; while there are more, places are pushed and nothing is queried."""
CACHED = 200
"""Keyframes of other rovers kept in memory."""
RETRY_S = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Times between attempts to reconnect."""


class Answer(NamedTuple):
    """Places of one session of another rover.

    Attributes:
        keyframe: of this rover.
        robot: name of the other rover.
        found: candidates with their keyframes, whose sessions have negative numbers here.
        around: keyframes on the metres before and after the only candidate; None where they were not queried.
    """

    keyframe: Keyframe
    robot: str
    found: list[tuple[Candidate, Keyframe]]
    around: list[Keyframe] | None = None


class FleetLink:
    """Link to the fleet's server: pushes the store's outbox in order, and queries every keyframe of this run.

    No call waits for the server: while it is disconnected the outbox grows, and the thread reconnects.

    Args:
        store: the rover's places, with an outbox.
        settings: address of the server, and the number of candidates per query.
        identity: name of the embedder and its dimension.

    Attributes:
        robot: the rover's name on the server; empty until the first contact.
        connected: whether the latest request succeeded.
        pushed: places pushed in this run.
        trouble: the latest error, in one line; empty while there is none.
    """

    def __init__(self, store: KeyframeStore, settings: Database, identity: tuple[str, int]) -> None:
        self._store, self._settings, self._identity = store, settings, identity
        self.robot, self.connected, self.pushed, self.trouble = "", False, 0, ""
        self._server: FleetServer | None = None
        self._asks: deque[int | Answer] = deque(maxlen=ASKS_KEPT)
        self._answers: deque[Answer] = deque()
        self._cache: OrderedDict[FleetKey, Keyframe] = OrderedDict()
        self._sessions: dict[tuple[str, UUID, int], int] = {}
        self._asking = False
        self._work, self._end = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="fleet", daemon=True)
        self._thread.start()

    def enqueue(self, asked: int | Answer) -> None:
        """Push and query a stored keyframe; or query those around an answer's only candidate, for another answer."""
        self._asks.append(asked)
        self._work.set()

    def answer(self) -> Answer | None:
        """Take the oldest answer; None where there is none."""
        if not self._answers:
            return None
        self._work.set()
        return self._answers.popleft()

    def drain(self, timeout_s: float) -> bool:
        """Wait until all is pushed and queried; return whether it is. Answers have to be taken meanwhile."""
        end = time.monotonic() + timeout_s
        while self._asks or self._asking or self._store.waiting():
            if time.monotonic() > end:
                return False
            time.sleep(0.02)
        return True

    def close(self) -> None:
        """Disconnect; places that were not pushed are pushed after the next start."""
        self._end.set()
        self._work.set()
        self._thread.join()

    def _run(self) -> None:
        failures = 0
        while not self._end.is_set():
            try:
                busy = self._step()
                failures = 0
            except Exception as error:  # without the thread, places would be lost silently
                self._disconnect(error)
                self._end.wait(RETRY_S[min(failures, len(RETRY_S) - 1)])
                failures += 1
                continue
            if not busy:
                self._work.wait(1.0)
                self._work.clear()
        if self._server is not None:
            self._server.close()

    def _step(self) -> bool:
        """Push or query once; return whether there was anything to do."""
        if self._server is None:
            self._server = FleetServer(self._settings.server, self._store.store_id, self._identity)
            self.robot, self.connected, self.trouble = self._server.robot, True, ""
        if rows := self._store.outgoing(BATCH):
            self._server.push([self._store[row] for row in rows])
            self._store.delivered(rows)
            self.pushed += len(rows)
            return True
        if not self._asks or len(self._answers) >= ANSWERS_KEPT:
            return False
        self._asking = True
        asked = self._asks.popleft()
        try:
            if isinstance(asked, Answer):
                self._ask_around(self._server, asked)
            else:
                self._ask(self._server, asked)
        except LinkError:
            self._asks.appendleft(asked)
            raise
        finally:
            self._asking = False
        return True

    def _ask(self, server: FleetServer, row: int) -> None:
        keyframe = self._store[row]
        by_session: dict[tuple[str, int], list[tuple[Candidate, Keyframe]]] = {}
        for key, similarity in server.nearest(keyframe.embedding.descriptor, self._settings.fleet_candidates):
            match = self._keyframe(server, key)
            if match is not None:
                found = by_session.setdefault((key.robot, match.session), [])
                found.append((Candidate(len(found), key.stamp_ns, similarity), match))
        self._answers.extend(Answer(keyframe, robot, found) for (robot, _), found in by_session.items())

    def _ask_around(self, server: FleetServer, answer: Answer) -> None:
        ((_, match),) = answer.found
        key = FleetKey(*list(self._sessions)[-1 - match.session], match.stamp_ns)
        first_m, last_m = (match.path_length_m + sign * const.ODOMETRY_REACH_M for sign in (-1, 1))
        keys = [one for one in server.along(key, first_m, last_m, const.MERGE_STEP_M) if one != key]
        around = [one for one in (self._keyframe(server, key) for key in keys) if one is not None]
        self._answers.append(answer._replace(around=around))

    def _keyframe(self, server: FleetServer, key: FleetKey) -> Keyframe | None:
        if key not in self._cache:
            data = server.data(key)
            if data is None:
                return None
            try:
                keyframe = unpack(data)
            except Exception as error:  # another rover's bytes may be damaged
                logger.warning("%s of %s cannot be read: %s", key.stamp_ns, key.robot, error)
                return None
            # sessions and stamps of two rovers may coincide
            name = key.robot, key.store, key.session
            session = self._sessions.setdefault(name, -1 - len(self._sessions))
            self._cache[key] = replace(keyframe, stamp_ns=key.stamp_ns, session=session)
            while len(self._cache) > CACHED:
                self._cache.popitem(last=False)
        self._cache.move_to_end(key)
        return self._cache[key]

    def _disconnect(self, error: Exception) -> None:
        """Disconnect after an error, and log it when it is new."""
        if str(error) != self.trouble:
            logger.warning("%s; %d places are not pushed yet", error, self._store.waiting())
        self.trouble, self.connected = str(error), False
        if self._server is not None and isinstance(error, LinkError):
            self._server.close()
            self._server = None
