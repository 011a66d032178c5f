"""Which keyframes are paired, and how verdicts about them are counted."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_keyframe
from scipy.spatial.transform import Rotation

from benchmarks.accuracy.domains import Outcome, summary
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import make_pose
from umf_ros.lab.simulation.domains import Domain, DomainScan
from umf_ros.lab.simulation.domains.pairs import ELSEWHERE, SAME, TURNED, ScannedPlace, ScanPair, pairs_of
from umf_ros.lab.simulation.domains.scanners import Sweep

OPEN, INDOORS = Domain("spin16", "street", "rover"), Domain("spin16", "corridor", "rover")
NOTHING = Sweep(np.empty((0, 3), np.float32), None, None)


def place(x, label, heading_deg=0.0, world=1, seed=0):
    pose = make_pose(Rotation.from_euler("z", heading_deg, degrees=True).as_matrix(), [x, 0.0, 1.0])
    return ScannedPlace(make_keyframe(x, seed=seed), DomainScan(NOTHING, pose, pose, label), world)


@pytest.fixture
def places():
    drive = [place(x, "first", seed=x) for x in range(0, 60, 3)]
    elsewhere = [place(x, "first", world=2, seed=100 + x) for x in range(0, 60, 3)]
    return [*drive, place(10.0, "offset", 8.0), place(40.0, "opposite", 178.0), *elsewhere]


def test_a_revisit_is_paired_with_what_is_near_and_with_what_is_far(places):
    for _ in range(5):
        pairs = list(pairs_of(places, OPEN, np.random.default_rng(0)))
        near = [pair for pair in pairs if pair.kind == SAME]
        assert near
        assert {pair.match.position[0] for pair in near} <= {9.0, 12.0}
        assert near[0].match_T_query[0, 3] == pytest.approx(10 - near[0].match.position[0])
        far = [pair for pair in pairs if pair.kind == ELSEWHERE]
        assert len(far) == 2
        assert all(pair.match.world == 2 or abs(pair.match.position[0] - 10) > 12 for pair in far)
        turned = [pair for pair in pairs if pair.kind == TURNED]
        assert turned
        assert all(abs(pair.match.position[0] - 40) < 4 for pair in turned)


def test_the_keyframe_that_looks_most_alike_elsewhere_is_among_the_pairs(places):
    query = next(one for one in places if one.scan.label == "offset")
    twin = ScannedPlace(query.keyframe, place(30.0, "first").scan, 2)
    pairs = list(pairs_of([*places, twin], OPEN, np.random.default_rng(0)))
    assert any(pair.match is twin and pair.kind == ELSEWHERE for pair in pairs)


def test_indoors_another_place_begins_sooner(places):
    pairs = list(pairs_of(places, INDOORS, np.random.default_rng(0)))
    assert all(abs(pair.match.position[0] - pair.query.position[0]) < 2 for pair in pairs if pair.kind == SAME)


def test_a_world_too_small_for_another_place_still_gives_its_revisits():
    pairs = list(pairs_of([place(0, "first"), place(1.0, "offset")], OPEN, np.random.default_rng(0)))
    assert [pair.kind for pair in pairs] == [SAME]


def closure(pose):
    return LoopClosure(2, 1, pose, np.diag([0.01] * 3 + [1e-4] * 3))


def test_a_closure_between_two_worlds_is_wrong_wherever_it_lies():
    pair = ScanPair(place(10.5, "offset"), place(9.0, "first", world=2), ELSEWHERE)
    outcome = Outcome("one")
    outcome.judge(pair, closure(pair.match_T_query))
    assert outcome.figures["wrong"] == 1


def test_verdicts_are_counted_by_their_truth():
    same = ScanPair(place(10.5, "offset"), place(9.0, "first"), SAME)
    far = ScanPair(place(10.5, "offset"), place(40.0, "first"), ELSEWHERE)
    true = same.match_T_query
    outcome = Outcome("one")
    outcome.judge(same, closure(true @ make_pose(np.eye(3), [0.05, 0, 0])))
    outcome.judge(same, closure(true @ make_pose(np.eye(3), [0.9, 0, 0])))
    outcome.judge(same, closure(true @ make_pose(np.eye(3), [1.1, 0, 0])))
    outcome.judge(same, closure(true @ make_pose(Rotation.from_euler("z", 6, degrees=True).as_matrix(), [0, 0, 0])))
    outcome.judge(same, None)
    outcome.judge(far, closure(np.eye(4)))
    outcome.judge(far, None)
    outcome.verify_ms.append(5.0)
    figures = summary([outcome])
    assert figures["accepted"] == 5
    assert figures["wrong"] == 3
    assert outcome.figures["wrong_elsewhere"] == 1
    assert figures["recall_worst"] == pytest.approx(2 / 5)
    assert figures["inside_95_mean"] == pytest.approx(0.5)
    assert figures["verify_ms"] == 5
