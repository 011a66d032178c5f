from __future__ import annotations

import math
import re

import numpy as np
from conftest import make_frame
from scipy.spatial.transform import Rotation

from umf_ros.core.config import KeyframePolicy, Loop, Settings, load_settings
from umf_ros.core.geometry import make_pose
from umf_ros.detector import KeyframeSelector
from umf_ros.places.database import is_past
from umf_ros.runs.findings import gap_remedy


def at(x_m: float, yaw_deg: float = 0.0) -> np.ndarray:
    return make_pose(Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix(), [x_m, 0, 0])


def chosen(poses: list[np.ndarray | None], period_s: float = 1.0, **policy: float) -> list[int]:
    selector = KeyframeSelector(KeyframePolicy(**policy))
    return [i for i, pose in enumerate(poses) if selector.select(make_frame(i * period_s, pose))]


def test_first_frame_is_a_keyframe() -> None:
    assert chosen([None]) == [0]
    assert chosen([at(3)]) == [0]


def test_distance_makes_keyframes() -> None:
    assert chosen([at(0.2 * i) for i in range(10)], min_translation_m=0.5) == [0, 3, 6, 9]


def test_rotation_makes_keyframes() -> None:
    assert chosen([at(0, 6 * i) for i in range(8)], min_rotation_deg=15) == [0, 3, 6]


def test_never_faster_than_the_minimum_period() -> None:
    assert chosen([at(5 * i) for i in range(9)], period_s=0.25, min_period_s=0.6) == [0, 3, 6]


def test_a_parked_rover_makes_no_keyframes_but_a_creeping_one_does() -> None:
    parked = [at(0.01 * (i % 2)) for i in range(60)]
    creeping = [at(0.02 * i) for i in range(20)]
    assert chosen(parked, max_period_s=5) == [0]
    assert chosen(creeping, max_period_s=5) == [0, 5, 10, 15]


def test_without_odometry_time_makes_keyframes() -> None:
    assert chosen([None] * 9, period_s=0.5, untracked_period_s=2) == [0, 4, 8]


def test_travelled_distance_ignores_jitter_and_counts_the_path() -> None:
    selector = KeyframeSelector(KeyframePolicy())
    rng = np.random.default_rng(0)
    frames = [make_frame(i, at(0.1 * min(i, 50)) @ make_pose(np.eye(3), rng.normal(0, 0.002, 3))) for i in range(500)]
    for frame in frames:
        selector.select(frame)
    assert abs(selector.path_length_m(frames[-1]) - 5.0) < 0.1
    assert math.isnan(selector.path_length_m(make_frame(501)))


def test_reset_starts_a_new_path() -> None:
    selector = KeyframeSelector(KeyframePolicy())
    for i in range(5):
        selector.select(make_frame(i, at(i)))
    selector.reset()
    frame = make_frame(0, at(100))
    assert selector.select(frame)
    assert selector.path_length_m(frame) == 0


def test_the_past_is_old_enough_and_far_enough_back() -> None:
    rules = Loop(min_time_gap_s=20, min_travel_m=15)
    age_ns = np.array([20, 19.999, 60, 60, 60, 60]) * 1e9
    way_m = np.array([15, 40, 14.99, 15, np.nan, 3.0])
    same_session = np.array([True, True, True, True, True, False])
    found = is_past(age_ns.astype(np.int64), way_m, rules, same_session)
    assert found.tolist() == [True, False, False, True, True, True]
    assert is_past(age_ns.astype(np.int64), way_m, rules).tolist() == [True, False, False, True, True, False]


def test_the_remedy_for_gap_rules_allows_matches_without_odometry() -> None:
    settings, stamps_ns = load_settings(), np.arange(120) * 10**8  # a corridor in 12 s

    def matches(settings: Settings) -> int:
        selector = KeyframeSelector(settings.keyframe)
        chosen = np.array([stamp for stamp in stamps_ns.tolist() if selector.select(make_frame(stamp * 1e-9))])
        ages = np.maximum(chosen[:, None] - chosen, 0)
        return int(is_past(ages, np.full(ages.shape, np.nan), settings.loop).sum())

    remedy = gap_remedy(12.0, 0.0, settings)
    named = dict(re.findall(r"([\w.]+): ([\d.]+)", remedy))
    changes = {name.replace(".", "__"): float(value) for name, value in named.items()}
    assert matches(settings) == 0
    assert matches(load_settings(loop__min_time_gap_s=changes["loop__min_time_gap_s"])) < 50
    assert matches(load_settings(**changes)) > 50 and "--odometry" in remedy


def test_the_remedy_for_gap_rules_names_the_rules_that_exclude() -> None:
    settings = load_settings()
    assert gap_remedy(600.0, 12.0, settings) == "loop.min_travel_m: 3"
    assert gap_remedy(12.0, 600.0, settings) == "loop.min_time_gap_s: 3"
    assert gap_remedy(12.0, None, settings).endswith("loop.min_travel_m: a quarter of the path length")
