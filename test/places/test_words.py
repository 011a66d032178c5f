"""Words that a place database fits to its own images."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import make_keyframe

from umf_ros.core.config import Database, Loop
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import WORDS_WEIGHT, Candidate, Keyframe
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import delete_sessions
from umf_ros.places.words import FITTED_ON, SCAN_SHARE, WORDS, fit_words

RULES = Loop(min_similarity=-1, min_time_gap_s=20, min_travel_m=15, top_k=20)
CHANNELS, CELLS = 12, 60


def scene_of(place: int, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Local vectors of a place: elements that all places share, moved in a way of its own."""
    elements = np.random.default_rng(99).standard_normal((30, CHANNELS))
    rng = np.random.default_rng([7, place])
    vectors = elements[rng.integers(30, size=CELLS)] + 0.4 * rng.standard_normal((CELLS, CHANNELS))
    vectors += noise * np.random.default_rng([seed, place]).standard_normal(vectors.shape)
    return np.rint(127 * vectors / np.abs(vectors).max(axis=1, keepdims=True)).astype(np.int8)


def keyframe_of(place: int, stamp_s: float, scan: bool = False, scene: np.ndarray | None = None) -> Keyframe:
    """A keyframe whose descriptor is the same everywhere: only the words tell places apart."""
    found = make_keyframe(stamp_s, 100 * stamp_s)
    embedding = replace(found.embedding, descriptor=np.eye(1, 16, dtype=np.float32)[0])
    scene = scene_of(place) if scene is None else scene
    return replace(found, embedding=replace(embedding, scene=scene, cloud=embedding.image if scan else None))


def opened(path: Path | None = None, read_only: bool = False) -> PlaceDatabase:
    return PlaceDatabase(Database(path=str(path or "")), "test", 16, read_only)


def filled(path: Path | None = None, count: int = FITTED_ON + 3) -> PlaceDatabase:
    places = opened(path)
    for place in range(count):
        places.add(keyframe_of(place, place))
    return places


def query_of(place: int, scan: bool = False) -> Keyframe:
    return keyframe_of(place, 1000, scan, scene_of(place, noise=0.1, seed=1))


def scan_alone(keyframe: Keyframe) -> Keyframe:
    """The keyframe as a LiDAR sees it: local vectors of another length, and features of the scan."""
    scene, features = np.tile(np.asarray(keyframe.embedding.scene), 2), keyframe.embedding.image
    return replace(keyframe, embedding=replace(keyframe.embedding, scene=scene, image=None, cloud=features))


def found_by(places: PlaceDatabase, query: Keyframe) -> list[Candidate]:
    return places.query(query, RULES)


def test_places_before_and_after_the_fit_are_told_apart_by_words() -> None:
    with closing(filled(count=FITTED_ON - 1)) as places:
        assert places.words is None and {one.words for one in found_by(places, query_of(5))} == {0.0}
        for place in range(FITTED_ON - 1, FITTED_ON + 3):
            places.add(keyframe_of(place, place))
        for place in (0, FITTED_ON - 1, FITTED_ON + 2):
            best = found_by(places, query_of(place))[0]
            assert best.index == place
            assert best.combined == pytest.approx(best.similarity + WORDS_WEIGHT * best.words)
            assert best.similarity == pytest.approx(1.0)  # the network's, whatever the words say


def test_words_do_not_count_for_keyframes_with_a_scan_or_without_an_image() -> None:
    blind = replace(query_of(5), embedding=replace(query_of(5).embedding, scene=None))
    with closing(filled()) as places:
        for query in (query_of(5, scan=True), blind):
            assert [(one.index, one.words) for one in found_by(places, query)] == [(row, 0.0) for row in range(20)]


def test_scans_alone_have_words_of_their_own_and_keyframes_of_another_sensor_none_of_them() -> None:
    with closing(opened()) as places:
        for place in range(FITTED_ON):
            places.add(scan_alone(keyframe_of(place, place)) if place % 4 else keyframe_of(place, place))
        assert places.words is not None and places.words.centres.shape == (WORDS, 2 * CHANNELS)
        best = {one.index: one.words for one in found_by(places, scan_alone(query_of(5)))[:1]}
        assert best == {5: pytest.approx(0.8 * SCAN_SHARE, rel=0.25)}
        assert {one.words for one in found_by(places, query_of(5))} == {0.0}


def test_words_stay_when_the_map_grows_and_its_first_session_is_deleted(tmp_path: Path) -> None:
    path = tmp_path / "places.sqlite"
    with closing(filled(path)) as places:
        assert places.words is not None
        name, before = places.words.name, found_by(places, query_of(FITTED_ON))
        for place in range(200, 220):
            places.add(replace(keyframe_of(place, place), session=1))
        assert places.words.name == name
    delete_sessions(path, [0])
    with closing(opened(path)) as places:
        assert places.words is not None and places.words.name == name
        assert found_by(places, query_of(210))[0].index == 10
    assert before[0].index == FITTED_ON


def test_a_process_killed_before_the_fit_fits_the_same_words_when_it_is_opened_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(filled(tmp_path / "whole.sqlite")) as whole, monkeypatch.context() as killed:
        killed.setattr("umf_ros.places.store.KeyframeStore.freeze_words", lambda *_: (_ for _ in ()).throw(OSError))
        places = filled(tmp_path / "places.sqlite", FITTED_ON - 1)
        with pytest.raises(OSError):
            places.add(keyframe_of(FITTED_ON - 1, FITTED_ON - 1))
        places.close()
        killed.undo()
        with closing(opened(tmp_path / "places.sqlite", read_only=True)) as reader:
            assert reader.words is None and len(reader) == FITTED_ON
        with closing(opened(tmp_path / "places.sqlite")) as places:
            for place in range(FITTED_ON, FITTED_ON + 3):
                places.add(keyframe_of(place, place))
            assert whole.words is not None and places.words is not None
            assert places.words.name == whole.words.name
            for place in (1, FITTED_ON + 1):
                assert found_by(places, query_of(place)) == found_by(whole, query_of(place))


def test_a_file_of_the_release_before_is_read_as_it_is_and_converted_when_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "places.sqlite"
    old = opened(path)
    for place in range(20):
        old.add(replace(keyframe_of(place, place), embedding=replace(keyframe_of(place, 0).embedding, scene=None)))
    old.close()
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executescript("DROP TABLE words; DROP TABLE code;")
        connection.execute("UPDATE schema_version SET version = version - 1")
    with closing(opened(path, read_only=True)) as places:
        assert {one.words for one in found_by(places, query_of(5))} == {0.0}
    with closing(opened(path)) as places:
        for place in range(100, 100 + FITTED_ON):
            places.add(keyframe_of(place, place))
        assert found_by(places, query_of(120))[0].index == 20 + 20


def test_words_that_were_changed_in_the_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "places.sqlite"
    filled(path).close()
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE words SET centres = zeroblob(length(centres))")
    with pytest.raises(UmfError, match="is damaged: its words are not those"):
        opened(path)


def test_codes_of_an_image_are_most_similar_to_themselves_and_vectors_of_another_trunk_have_none() -> None:
    words = fit_words([scene_of(place) for place in range(FITTED_ON)])
    codes = np.stack([words.describe(scene_of(place)) for place in range(20)])
    assert codes.shape == (20, WORDS // 8 + 2 * WORDS)
    similarity = np.stack([words.compare(code, codes) for code in codes])
    np.testing.assert_array_equal(similarity, similarity.T)
    np.testing.assert_allclose(np.diag(similarity), 1, atol=1e-6)
    assert (similarity - 2 * np.eye(20)).max() < 0.6
    assert words.describe(np.ones((CELLS, CHANNELS + 1), np.int8)) is None


def test_the_same_scene_everywhere_still_gives_words() -> None:
    flat = np.full((CELLS, CHANNELS), 127, np.int8)
    words = fit_words([flat] * FITTED_ON)
    code = words.describe(flat)
    assert code is not None and np.isfinite(words.centres).all()
    assert np.isfinite(words.compare(code, code[None])).all()
