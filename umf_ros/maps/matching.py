"""Closures between the sessions of a map: what one recording saw of the places of those before it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from umf_ros.core.config import Settings
from umf_ros.core.frames import Keyframe
from umf_ros.places.database import PlaceDatabase
from umf_ros.verification import Verdict, Verifier


@dataclass(frozen=True, slots=True)
class Match:
    """What became of one keyframe: the verdicts on its candidates, accepted ones first."""

    keyframe: Keyframe
    verdicts: list[Verdict]


def match_between(database: PlaceDatabase, rows: range, sessions: range, settings: Settings) -> Iterator[Match]:
    """Look for the keyframes of some rows among the places of other sessions, in order, one verification each.

    Args:
        database: the places of a map.
        rows: of one recording.
        sessions: numbers of the sessions that are looked through.
        settings: how to search and to verify.
    """
    verifier, session = Verifier(settings.verification), -1
    for row in rows:
        keyframe = database[row]
        if keyframe.session != session:
            verifier.reset()
            session = keyframe.session
        candidates = database.query(keyframe, settings.loop, sessions)
        yield Match(keyframe, verifier.verify(keyframe, [(found, database[found.index]) for found in candidates]))
