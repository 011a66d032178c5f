from __future__ import annotations

import logging
import sqlite3
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from conftest import make_keyframe
from fleets import IDENTITY, administrator, keyframes, rover_places, settings, stored

from benchmarks.accuracy.postgres import PASSWORD, CuttableLink, PostgresServer, free_port
from umf_ros.core.frames import Keyframe
from umf_ros.fleet.link import Answer, FleetLink
from umf_ros.fleet.server import add_rover, migrate
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import delete_sessions


def link_of(places: PlaceDatabase, server: PostgresServer, rover: str, port: int | None = None) -> FleetLink:
    return FleetLink(places.store, settings(server, rover, port=port), IDENTITY)


def drive(places: PlaceDatabase, link: FleetLink, driven: list[Keyframe]) -> None:
    for keyframe in driven:
        link.enqueue(places.add(keyframe))


def until(holds: Callable[[], bool], seconds: float = 20) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


def answers_of(link: FleetLink) -> list[Answer]:
    found = []
    while (answer := link.answer()) is not None:
        found.append(answer)
    return found


def test_keyframes_stored_before_the_fleet_are_pushed(server: PostgresServer, tmp_path: Path) -> None:
    path = tmp_path / "ada.sqlite"
    alone = PlaceDatabase(settings(server, "ada", path).model_copy(update={"backend": "sqlite"}), *IDENTITY)
    for keyframe in keyframes(40):
        alone.add(keyframe)
    alone.close()
    places = rover_places(server, "ada", path)
    assert places.store.waiting() == 40
    link = link_of(places, server, "ada")
    assert link.drain(20) and link.pushed == 40 and link.robot == "ada" and link.connected
    link.close()
    assert [second for _, second in stored(server)] == list(range(40))


def test_places_of_another_rover_are_found_with_negative_sessions(server: PostgresServer) -> None:
    bea_places, ada_places = rover_places(server, "bea"), rover_places(server, "ada")
    bea = link_of(bea_places, server, "bea")
    drive(bea_places, bea, keyframes(10))
    assert bea.drain(20)
    ada = link_of(ada_places, server, "ada")
    drive(ada_places, ada, [make_keyframe(500, 3.0, seed=4)])
    assert ada.drain(20)
    (answer,) = answers_of(ada)
    keyframe, robot, found, around = answer
    assert around is None
    candidate, match = found[0]
    assert (robot, keyframe.stamp_ns, candidate.stamp_ns) == ("bea", 500 * 10**9, 4 * 10**9)
    assert match.session < 0 and match.stamp_ns == 4 * 10**9 and len(found) == 3
    assert match.embedding.image is not None  # all that verification needs
    assert len({one.index for one, _ in found}) == 3  # verification tells candidates apart by it
    ada.close(), bea.close()


def test_keyframes_around_a_candidate_are_fetched_one_of_every_step(server: PostgresServer) -> None:
    bea_places, ada_places = rover_places(server, "bea"), rover_places(server, "ada")
    bea, ada = link_of(bea_places, server, "bea"), link_of(ada_places, server, "ada")
    drive(bea_places, bea, [make_keyframe(i, 0.5 * i, seed=i) for i in range(120)])
    assert bea.drain(20)
    drive(ada_places, ada, [make_keyframe(500, 3.0, seed=60)])
    assert ada.drain(20)
    (answer,) = answers_of(ada)
    ada.enqueue(answer._replace(found=answer.found[:1]))
    assert ada.drain(20)
    (answer,) = answers_of(ada)
    ((_, match),) = answer.found
    assert match.path_length_m == 30.0 and answer.around is not None
    path_m = [one.path_length_m for one in answer.around]
    assert {one.session for one in answer.around} == {match.session}
    assert 10.0 <= min(path_m) < 11.5 and 48.5 < max(path_m) <= 50.0
    assert len(path_m) in (26, 27) and max(b - a for a, b in pairwise(path_m)) <= 3.0
    ada.close(), bea.close()


def test_repeated_disconnections_lose_no_keyframe(server: PostgresServer, tmp_path: Path) -> None:
    proxy = CuttableLink(server.port)
    places = rover_places(server, "ada", tmp_path / "ada.sqlite")
    link = link_of(places, server, "ada", proxy.port)
    for part in range(6):
        until(lambda: link.connected)
        drive(places, link, keyframes(50, 50 * part))
        proxy.cut(0.1)
    assert link.drain(30)
    assert stored(server) == [("ada", second) for second in range(300)] and proxy.cuts >= 5
    link.close()
    proxy.close()


def test_a_disconnected_rover_continues_and_pushes_after_the_next_start(
    server: PostgresServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "ada.sqlite"
    places = rover_places(server, "ada", path)
    with caplog.at_level(logging.WARNING):
        link = link_of(places, server, "ada", free_port())
        drive(places, link, keyframes(5))
        until(lambda: bool(link.trouble))
        assert not link.connected and not link.drain(0.1) and places.store.waiting() == 5
        link.close()
    assert "cannot be reached" in caplog.text and "secret" not in caplog.text
    places.close()
    again = rover_places(server, "ada", path)
    link = link_of(again, server, "ada")
    assert link.drain(20) and len(stored(server)) == 5
    link.close()


def test_a_keyframe_enters_the_outbox_with_the_store_or_not_at_all(server: PostgresServer, tmp_path: Path) -> None:
    path = tmp_path / "ada.sqlite"
    places = rover_places(server, "ada", path)
    for keyframe in keyframes(3):
        places.add(keyframe)
    with sqlite3.connect(path) as other:  # as a killed process leaves it: no close, no checkpoint
        both = other.execute("SELECT (SELECT count(*) FROM keyframe), (SELECT count(*) FROM outbox)").fetchone()
    assert both == (3, 3)
    places.store.delivered([0, 2])
    assert places.store.outgoing(10) == [1] and places.store.waiting() == 1


def test_sessions_deleted_before_they_were_pushed_block_nothing(server: PostgresServer, tmp_path: Path) -> None:
    path = tmp_path / "ada.sqlite"
    places = rover_places(server, "ada", path)
    for second in range(6):
        places.add(make_keyframe(second, seed=second, session=second // 3))
    places.close()
    delete_sessions(path, [1])
    again = rover_places(server, "ada", path)
    assert again.store.waiting() == 3
    again.add(make_keyframe(77, seed=77, session=1))  # gets the id of one that is gone
    link = link_of(again, server, "ada")
    assert link.drain(20)
    assert [second for _, second in stored(server)] == [0, 1, 2, 77]
    link.close()


def test_unreadable_keyframes_of_another_rover_are_skipped(server: PostgresServer) -> None:
    bea_places, ada_places = rover_places(server, "bea"), rover_places(server, "ada")
    bea = link_of(bea_places, server, "bea")
    drive(bea_places, bea, keyframes(3))
    assert bea.drain(20)
    with administrator(server) as connection:
        connection.execute("UPDATE place_data SET data = 'nonsense' WHERE stamp_ns > 0")
    ada = link_of(ada_places, server, "ada")
    drive(ada_places, ada, [make_keyframe(500, seed=1)])
    assert ada.drain(20)
    (answer,) = answers_of(ada)
    assert [candidate.stamp_ns for candidate, _ in answer[2]] == [0]
    ada.close(), bea.close()


def test_a_killed_server_has_every_place_when_it_is_back() -> None:
    with PostgresServer() as server:
        with administrator(server) as connection:
            migrate(connection, *IDENTITY)
            add_rover(connection, "ada", PASSWORD)
        places = rover_places(server, "ada")
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("PGPASSWORD", PASSWORD)
            link = link_of(places, server, "ada")
            drive(places, link, keyframes(40))
            until(lambda: link.pushed > 0)
            server.kill()
            drive(places, link, keyframes(40, 40))
            server.start()
            assert link.drain(30)
            link.close()
        assert [second for _, second in stored(server)] == list(range(80))
