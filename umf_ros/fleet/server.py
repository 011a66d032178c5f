"""The PostgreSQL server of a fleet: its tables and roles, and the connection of a rover."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple
from uuid import UUID

import numpy as np
import psycopg
from numpy.typing import NDArray
from pgvector import HalfVector
from pgvector.psycopg import register_vector
from psycopg import Connection, sql

from umf_ros.core.errors import UmfError, one_line
from umf_ros.core.frames import Keyframe
from umf_ros.places.store import pack

ROVERS = "umf_rover"
"""Role of all rovers: its members read every row and add rows of their own name."""
SEARCHED = 100
"""Candidate list of the search in the server's graph (`hnsw.ef_search`): recall against time."""
TIMEOUT_S = 5.0
"""Time after which a server without an answer counts as disconnected."""
NORM_SLACK = 0.02
"""Largest difference of a descriptor's norm from 1, in half precision: a longer one would be first in every query."""
LARGEST_PLACE = 2**23
"""Most bytes of a packed keyframe; those of dense scans have some hundred thousand."""
_KEY = "robot text, store uuid, session integer, stamp_ns bigint"
_KEY_NAMES = "robot, store, session, stamp_ns"
MIGRATIONS = (
    (
        "CREATE EXTENSION IF NOT EXISTS vector",
        # one row: every rover of a fleet embeds with the same network
        "CREATE TABLE fleet (embedder text NOT NULL, dimension integer NOT NULL)",
        f"CREATE TABLE place ({_KEY}, travelled_m double precision, descriptor halfvec({{dimension}}) NOT NULL, "
        f"PRIMARY KEY ({_KEY_NAMES}))",
        # apart from the descriptors, so that those of a million places stay in memory
        f"CREATE TABLE place_data ({_KEY}, data bytea STORAGE EXTERNAL NOT NULL, PRIMARY KEY ({_KEY_NAMES}), "
        f"FOREIGN KEY ({_KEY_NAMES}) REFERENCES place)",
        "CREATE INDEX place_descriptor ON place USING hnsw (descriptor halfvec_ip_ops)",
        "ALTER TABLE place ENABLE ROW LEVEL SECURITY",
        "ALTER TABLE place_data ENABLE ROW LEVEL SECURITY",
        "CREATE POLICY everybody_reads ON place FOR SELECT USING (true)",
        "CREATE POLICY everybody_reads ON place_data FOR SELECT USING (true)",
        "CREATE POLICY its_own ON place FOR INSERT WITH CHECK (robot = current_user)",
        "CREATE POLICY its_own ON place_data FOR INSERT WITH CHECK (robot = current_user)",
        f"GRANT SELECT ON fleet, fleet_version TO {ROVERS}",
        f"GRANT SELECT, INSERT ON place, place_data TO {ROVERS}",
    ),
    (
        # a member of the role of all rovers may become that role, but not another user of the session
        "DROP POLICY its_own ON place",
        "DROP POLICY its_own ON place_data",
        "CREATE POLICY its_own ON place FOR INSERT WITH CHECK (robot = session_user)",
        "CREATE POLICY its_own ON place_data FOR INSERT WITH CHECK (robot = session_user)",
        # not valid: stored rows are checked by the reader
        f"ALTER TABLE place ADD CHECK (abs(l2_norm(descriptor) - 1) < {NORM_SLACK}) NOT VALID",
        f"ALTER TABLE place_data ADD CHECK (octet_length(data) <= {LARGEST_PLACE}) NOT VALID",
    ),
)
"""Statements that lead from version n to n + 1; a released migration is never changed, only added to."""
_INSERT = "INSERT INTO place VALUES (session_user, %s, %s, %s, %s, %s) ON CONFLICT DO NOTHING"
_INSERT_DATA = "INSERT INTO place_data VALUES (session_user, %s, %s, %s, %s) ON CONFLICT DO NOTHING"
_NEAREST = (
    "SELECT robot, store, session, stamp_ns, -(descriptor <#> %s) FROM place WHERE robot <> session_user::text "
    "ORDER BY descriptor <#> %s LIMIT %s"
)
_ALONG = (
    f"SELECT DISTINCT ON (step) floor(travelled_m / %s) AS step, {_KEY_NAMES} FROM place WHERE robot = %s AND "
    "store = %s AND session = %s AND travelled_m BETWEEN %s AND %s ORDER BY step, stamp_ns"
)
_DATA = (
    "SELECT data FROM place_data WHERE robot = %s AND store = %s AND session = %s AND stamp_ns = %s AND "
    f"octet_length(data) <= {LARGEST_PLACE}"
)
_KNOWN_ROLE = (
    "SELECT NOT (rolsuper OR rolcreaterole OR rolcreatedb OR rolreplication OR rolbypassrls) AND EXISTS (SELECT 1 FROM "
    "pg_auth_members JOIN pg_roles AS groups ON groups.oid = roleid WHERE groups.rolname = %s AND member = one.oid) "
    "FROM pg_roles AS one WHERE rolname = %s"
)
"""Whether a known role is a rover's: a member of the role of rovers that administers nothing."""


def migrate(connection: Connection, embedder: str, dimension: int) -> tuple[int, int]:
    """Bring the tables up to date in one transaction; return the version before and after.

    The user of the connection may create roles and tables; new tables are for descriptors of this embedder and
    dimension. Tables made by a later version of umf_ros raise an `UmfError`.
    """
    with connection.transaction():
        # a concurrent set-up waits here
        connection.execute("SELECT pg_advisory_xact_lock(7215)")
        before = _version(connection)
        if before > len(MIGRATIONS):
            raise UmfError(f"the server has tables of version {before}, this umf_ros supports {len(MIGRATIONS)}")
        if not before:
            if not connection.execute("SELECT 1 FROM pg_roles WHERE rolname = %s", (ROVERS,)).fetchone():
                connection.execute(sql.SQL("CREATE ROLE {} NOLOGIN").format(sql.Identifier(ROVERS)))
            connection.execute("CREATE TABLE IF NOT EXISTS fleet_version (version integer PRIMARY KEY)")
        for version, statements in enumerate(MIGRATIONS[before:], before + 1):
            for statement in statements:
                connection.execute(sql.SQL(statement).format(dimension=sql.Literal(dimension)))
            connection.execute("INSERT INTO fleet_version VALUES (%s)", (version,))
        if not before:
            connection.execute("INSERT INTO fleet VALUES (%s, %s)", (embedder, dimension))
    return before, len(MIGRATIONS)


def add_rover(connection: Connection, name: str, password: str) -> None:
    """Add a rover's role, or change its password; the server gets the password's verifier only.

    Raises:
        UmfError: the name is that of a role that is no rover.
    """
    verifier = connection.pgconn.encrypt_password(password.encode(), name.encode(), b"scram-sha-256").decode()
    known = connection.execute(_KNOWN_ROLE, (ROVERS, name)).fetchone()
    if known == (False,):
        raise UmfError(f"{name} is a role of the server that is no rover: its password was not changed")
    verb = sql.SQL("ALTER ROLE" if known else "CREATE ROLE")
    with connection.transaction():
        parts = verb, sql.Identifier(name), sql.Literal(verifier)
        connection.execute(sql.SQL("{} {} LOGIN PASSWORD {}").format(*parts))
        connection.execute(sql.SQL("GRANT {} TO {}").format(sql.Identifier(ROVERS), sql.Identifier(name)))


class LinkError(UmfError):
    """Failed contact with the server; the request has to be repeated later."""


class FleetKey(NamedTuple):
    """Key of a keyframe in a fleet: rover, id of its place database, session in that database, stamp in ns."""

    robot: str
    store: UUID
    session: int
    stamp_ns: int


class FleetServer:
    """A rover's connection to the server; calls time out within seconds, with a `LinkError`.

    Args:
        address: `postgresql://ROVER@HOST/DATABASE?sslmode=verify-full`; libpq takes the password from a `.pgpass` file
            or the environment.
        store: id of the rover's place database.
        identity: name of the embedder and its dimension.

    Attributes:
        robot: the rover's name on the server.

    Raises:
        LinkError: the server cannot be reached.
        UmfError: its tables are of another version or another network.
    """

    def __init__(self, address: str, store: UUID, identity: tuple[str, int]) -> None:
        self._store = store
        with _link():
            self._connection = psycopg.connect(
                address,
                autocommit=True,
                connect_timeout=round(TIMEOUT_S),
                tcp_user_timeout=round(1e3 * TIMEOUT_S),
                keepalives_idle=5,
                keepalives_interval=2,
                keepalives_count=2,
                application_name="umf_ros",
                options=f"-c statement_timeout={round(1e3 * TIMEOUT_S)}",
            )
        try:
            with _link():
                self.robot = self._check(identity)
        except BaseException:
            self.close()
            raise

    def push(self, keyframes: Sequence[Keyframe]) -> None:
        """Store keyframes, all or none; those that are stored already stay unchanged."""
        places, data = [], []
        for one in keyframes:
            key = self._store, one.session, one.stamp_ns
            path_m = None if np.isnan(one.path_length_m) else one.path_length_m
            places.append((*key, path_m, HalfVector(np.asarray(one.embedding.descriptor, np.float32))))
            data.append((*key, pack(one)))
        with _link(), self._connection.transaction(), self._connection.cursor() as cursor:
            cursor.executemany(_INSERT, places)
            cursor.executemany(_INSERT_DATA, data)

    def nearest(self, descriptor: NDArray[np.float32], count: int) -> list[tuple[FleetKey, float]]:
        """Return the most similar places of other rovers with their similarity, best first."""
        vector = HalfVector(descriptor)
        with _link():
            rows = self._connection.execute(_NEAREST, (vector, vector, count)).fetchall()
        most = 1 + 2 * NORM_SLACK
        return [(FleetKey(*key), float(similarity)) for *key, similarity in rows if abs(similarity) <= most]

    def along(self, key: FleetKey, first_m: float, last_m: float, step_m: float) -> list[FleetKey]:
        """Return keyframes on a part of the path of a keyframe's session, in its order, one of every step."""
        with _link():
            rows = self._connection.execute(_ALONG, (step_m, *key[:3], first_m, last_m)).fetchall()
        return [FleetKey(*row[1:]) for row in rows]

    def data(self, key: FleetKey) -> bytes | None:
        """Return a packed keyframe; None where there is none, or one of more than `LARGEST_PLACE` bytes."""
        with _link():
            row = self._connection.execute(_DATA, key, binary=True).fetchone()
        return row[0] if row else None

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _check(self, identity: tuple[str, int]) -> str:
        version = _version(self._connection)
        if version != len(MIGRATIONS):
            found = f"tables of version {version}, not {len(MIGRATIONS)}" if version else "no tables of a fleet"
            raise UmfError(f"the fleet's server has {found}; the administrator has to run umf fleet setup")
        known = self._connection.execute("SELECT embedder, dimension FROM fleet").fetchone()
        if known != identity:
            raise UmfError(f"the fleet's places were made with {known}, not with {identity}")
        register_vector(self._connection)
        self._connection.execute("SELECT set_config('hnsw.ef_search', %s, false)", (str(SEARCHED),))
        self._connection.execute("SET hnsw.iterative_scan = strict_order")
        row = self._connection.execute("SELECT session_user::text").fetchone()
        return str(row[0]) if row else ""


def _version(connection: Connection) -> int:
    """Return the version of the server's tables; 0 where there are none."""
    if connection.execute("SELECT to_regclass('fleet_version')").fetchone() == (None,):
        return 0
    row = connection.execute("SELECT max(version) FROM fleet_version").fetchone()
    return int(row[0] or 0) if row else 0


@contextmanager
def _link() -> Iterator[None]:
    """Report server errors in one line; neither libpq nor this line contains a password."""
    try:
        yield
    except psycopg.errors.InsufficientPrivilege as error:
        raise UmfError(f"the fleet's server refuses the request: {one_line(error)}") from None
    except psycopg.Error as error:
        raise LinkError(f"the fleet's server cannot be reached: {one_line(error)}") from None
