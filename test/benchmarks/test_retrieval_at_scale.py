"""Places of other worlds as competitors: how they are made, and what they push out."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_keyframe, unit
from support.crowds import METHODS, CrowdedDetector, crowd_of

from umf_ros.core.config import Settings
from umf_ros.core.frames import Embedding, Frame

DIMENSION = 16


class Silent:
    """An embedder that is never called: the descriptors are given."""

    name, dimension = "silent", DIMENSION

    def embed(self, frame: Frame) -> Embedding:
        raise AssertionError(f"{frame.stamp_ns} is embedded already")


def detector_beside(crowd: np.ndarray, top_k: int) -> CrowdedDetector:
    settings = Settings.model_validate({"loop": {"top_k": top_k, "min_time_gap_s": 1.0, "min_travel_m": 1.0}})
    return CrowdedDetector(settings, Silent(), crowd)


def directions(count: int, seed: int = 0) -> np.ndarray:
    return np.stack([unit(row) for row in np.random.default_rng(seed).standard_normal((count, DIMENSION))])


def test_the_crowd_holds_what_is_known_and_mixtures_of_neighbours_of_one_world() -> None:
    known, worlds = directions(6), np.array([0, 0, 0, 1, 1, 1])
    crowd = crowd_of(known, worlds, 500)
    assert crowd.shape == (500, DIMENSION) and crowd.dtype == np.float32
    np.testing.assert_array_equal(crowd[:6], known.astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(crowd, axis=1), 1, atol=1e-5)
    # a mixture lies in the plane of two neighbours of one world, but for the noise: never in that of 2 and 3
    planes = [np.linalg.qr(known[[row, row + 1]].T)[0] for row in (0, 1, 3, 4)]
    assert np.stack([np.linalg.norm(crowd[6:] @ plane, axis=1) for plane in planes]).max(axis=0).min() > 0.97


def test_a_crowd_smaller_than_what_is_known_is_a_part_of_it() -> None:
    known = directions(6)
    np.testing.assert_array_equal(crowd_of(known, np.zeros(6), 4), known[:4].astype(np.float32))
    assert len(crowd_of(known, np.zeros(6), 0)) == 0


@pytest.mark.parametrize(("more_alike", "kept"), [(0, 3), (1, 2), (2, 1), (3, 0)])
def test_whoever_is_more_alike_takes_a_candidate_s_place(more_alike: int, kept: int) -> None:
    asked = directions(1)[0]
    crowd = np.repeat(asked[None], more_alike, axis=0).astype(np.float32).reshape(-1, DIMENSION)
    detector = detector_beside(crowd, top_k=3)
    for number in range(3):  # three places far apart, less alike than the crowd
        like = unit(asked + 0.3 * directions(1, seed=9 + number)[0])
        detector.remember(make_keyframe(10.0 * number, 20.0 * number, descriptor=like))
    query = make_keyframe(100.0, 200.0, descriptor=asked)
    assert len(detector.query(query)) == kept


def test_every_method_embeds_by_its_own_senses_alone() -> None:
    assert {
        method.name: (method.camera, method.lidar) for method in METHODS if not (method.camera and method.lidar)
    } == {
        "umf_lidar": (False, True),
        "umf_image": (True, False),
    }
