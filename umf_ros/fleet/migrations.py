"""The tables of a fleet's server, made and brought up to date step by step; who may do what there."""

from __future__ import annotations

from psycopg import Connection, sql

from umf_ros.core.errors import UmfError

ROVERS = "umf_rover"
"""The group of all rovers: whoever is in it reads everything and adds rows of its own name, and no more."""
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
)
"""Statements by version: those of version n lead from n - 1 to n; what was released is never changed, only added to."""


def version_of(connection: Connection) -> int:
    """Version of a server's tables; 0 where there are none."""
    if connection.execute("SELECT to_regclass('fleet_version')").fetchone() == (None,):
        return 0
    row = connection.execute("SELECT max(version) FROM fleet_version").fetchone()
    return int(row[0] or 0) if row else 0


def migrate(connection: Connection, embedder: str, dimension: int) -> tuple[int, int]:
    """Bring the tables up to date, all or nothing; returns the version before and after.

    Args:
        connection: of somebody who may create roles and tables.
        embedder: the network of the fleet, where the tables are new.
        dimension: numbers per descriptor, likewise.

    Raises:
        UmfError: the tables are of a later version of umf_ros.
    """
    with connection.transaction():
        # two administrators at once: the second waits, and finds nothing to do
        connection.execute("SELECT pg_advisory_xact_lock(7215)")
        before = version_of(connection)
        if before > len(MIGRATIONS):
            raise UmfError(f"the server has tables of version {before}, this umf_ros knows {len(MIGRATIONS)}")
        if not before:
            _make_group(connection)
            connection.execute("CREATE TABLE IF NOT EXISTS fleet_version (version integer PRIMARY KEY)")
        for version, statements in enumerate(MIGRATIONS[before:], before + 1):
            for statement in statements:
                connection.execute(sql.SQL(statement).format(dimension=sql.Literal(dimension)))
            connection.execute("INSERT INTO fleet_version VALUES (%s)", (version,))
        if not before:
            connection.execute("INSERT INTO fleet VALUES (%s, %s)", (embedder, dimension))
    return before, len(MIGRATIONS)


def add_rover(connection: Connection, name: str, password: str) -> None:
    """Let a rover in, or give one that is in a new password. The password itself never reaches the server.

    Args:
        connection: of somebody who may create roles.
        name: of the rover; its rows and its keyframes bear it.
        password: what it says from now on.
    """
    verifier = connection.pgconn.encrypt_password(password.encode(), name.encode(), b"scram-sha-256").decode()
    known = connection.execute("SELECT 1 FROM pg_roles WHERE rolname = %s", (name,)).fetchone()
    verb = sql.SQL("ALTER ROLE" if known else "CREATE ROLE")
    with connection.transaction():
        parts = verb, sql.Identifier(name), sql.Literal(verifier)
        connection.execute(sql.SQL("{} {} LOGIN PASSWORD {}").format(*parts))
        connection.execute(sql.SQL("GRANT {} TO {}").format(sql.Identifier(ROVERS), sql.Identifier(name)))


def _make_group(connection: Connection) -> None:
    if not connection.execute("SELECT 1 FROM pg_roles WHERE rolname = %s", (ROVERS,)).fetchone():
        connection.execute(sql.SQL("CREATE ROLE {} NOLOGIN").format(sql.Identifier(ROVERS)))
