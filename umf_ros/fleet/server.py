"""A rover's connection to the fleet's server."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from uuid import UUID

import numpy as np
import psycopg
from numpy.typing import NDArray
from pgvector import HalfVector
from pgvector.psycopg import register_vector

from umf_ros.core.errors import UmfError
from umf_ros.fleet.migrations import MIGRATIONS, version_of

LOOKED_AT = 100
"""Places that the search in the server's graph keeps in hand (`hnsw.ef_search`): recall against time."""
ANSWER_S = 5.0
"""A server that has not answered by then counts as gone."""
_INSERT = "INSERT INTO place VALUES (current_user, %s, %s, %s, %s, %s) ON CONFLICT DO NOTHING"
_INSERT_DATA = "INSERT INTO place_data VALUES (current_user, %s, %s, %s, %s) ON CONFLICT DO NOTHING"
_NEAREST = (
    "SELECT robot, store, session, stamp_ns, -(descriptor <#> %s) FROM place WHERE robot <> current_user::text "
    "ORDER BY descriptor <#> %s LIMIT %s"
)
_DATA = "SELECT data FROM place_data WHERE robot = %s AND store = %s AND session = %s AND stamp_ns = %s"


class LinkError(UmfError):
    """The server cannot be reached, or went away: what was to be done is done later."""


@dataclass(frozen=True, slots=True)
class FleetKey:
    """What names a keyframe in a fleet.

    Attributes:
        robot: the rover, which is the name of its role on the server.
        store: its file of places.
        session: number of the session in that file.
        stamp_ns: key of the keyframe.
    """

    robot: str
    store: UUID
    session: int
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class OutgoingPlace:
    """A keyframe on its way to the server.

    Attributes:
        session, stamp_ns: its key in its store.
        path_length_m: metres driven, NaN where they are unknown.
        descriptor: (D,) float32.
        data: the keyframe, packed.
    """

    session: int
    stamp_ns: int
    path_length_m: float
    descriptor: NDArray[np.float32]
    data: bytes


class FleetServer:
    """Places of all rovers of a fleet; every call ends within seconds, whatever becomes of the link.

    Args:
        address: `postgresql://ROVER@HOST/DATABASE?sslmode=verify-full`; the password comes from a `.pgpass` file or
            the environment, as libpq has it.
        store: the rover's file of places.
        identity: name of the embedder and its dimension.

    Attributes:
        robot: the rover's name on the server.

    Raises:
        LinkError: the server cannot be reached.
        UmfError: it has no tables of this version, or those of another network.
    """

    def __init__(self, address: str, store: UUID, identity: tuple[str, int]) -> None:
        self._store = store
        with _link():
            self._connection = psycopg.connect(
                address,
                autocommit=True,
                connect_timeout=round(ANSWER_S),
                tcp_user_timeout=round(1e3 * ANSWER_S),
                keepalives_idle=5,
                keepalives_interval=2,
                keepalives_count=2,
                application_name="umf_ros",
                options=f"-c statement_timeout={round(1e3 * ANSWER_S)}",
            )
        try:
            with _link():
                self.robot = self._check(identity)
        except BaseException:
            self.close()
            raise

    def push(self, places: Sequence[OutgoingPlace]) -> None:
        """Store places for good, all or none; those that are there already are left as they are.

        Raises:
            LinkError: the link was cut; whether they were stored is unknown.
        """
        key = [(self._store, place.session, place.stamp_ns) for place in places]
        rows = [
            (*one, None if np.isnan(place.path_length_m) else place.path_length_m, HalfVector(place.descriptor))
            for one, place in zip(key, places, strict=True)
        ]
        with _link(), self._connection.transaction(), self._connection.cursor() as cursor:
            cursor.executemany(_INSERT, rows)
            cursor.executemany(_INSERT_DATA, [(*one, place.data) for one, place in zip(key, places, strict=True)])

    def nearest(self, descriptor: NDArray[np.float32], count: int) -> list[tuple[FleetKey, float]]:
        """The places of other rovers most like a descriptor with their similarity, best first.

        Raises:
            LinkError: the link was cut.
        """
        vector = HalfVector(descriptor)
        with _link():
            rows = self._connection.execute(_NEAREST, (vector, vector, count)).fetchall()
        return [(FleetKey(*key), float(similarity)) for *key, similarity in rows]

    def data(self, key: FleetKey) -> bytes | None:
        """A keyframe, packed; None where there is none.

        Raises:
            LinkError: the link was cut.
        """
        with _link():
            values = key.robot, key.store, key.session, key.stamp_ns
            row = self._connection.execute(_DATA, values, binary=True).fetchone()
        return row[0] if row else None

    def close(self) -> None:
        """Leave the server."""
        self._connection.close()

    def _check(self, identity: tuple[str, int]) -> str:
        version = version_of(self._connection)
        if version != len(MIGRATIONS):
            what = f"tables of version {version}, not {len(MIGRATIONS)}" if version else "no tables of a fleet"
            raise UmfError(f"the fleet's server has {what}; its administrator runs umf fleet setup")
        known = self._connection.execute("SELECT embedder, dimension FROM fleet").fetchone()
        if known != identity:
            raise UmfError(f"the fleet's places are of {known}, not of {identity}")
        register_vector(self._connection)
        self._connection.execute("SELECT set_config('hnsw.ef_search', %s, false)", (str(LOOKED_AT),))
        self._connection.execute("SET hnsw.iterative_scan = strict_order")
        row = self._connection.execute("SELECT current_user::text").fetchone()
        return str(row[0]) if row else ""


@contextmanager
def _link() -> Iterator[None]:
    """Tell whatever goes wrong with the server in one line; neither libpq nor this names a password."""
    try:
        yield
    except psycopg.errors.InsufficientPrivilege as error:
        raise UmfError(f"the fleet's server refuses: {_line(error)}") from None
    except psycopg.Error as error:
        raise LinkError(f"the fleet's server cannot be reached: {_line(error)}") from None


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
