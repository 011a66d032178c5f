from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ground import yard_scan

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe, ScanMotion
from umf_ros.core.geometry import Array, make_pose, near, relative, rotation_angle
from umf_ros.detector import NOT_EMBEDDED, assemble
from umf_ros.lab.scan_files import make_snapshot
from umf_ros.lab.simulation.domains.pairs import is_wrong
from umf_ros.lab.simulation.domains.survey import FIRST, OTHER_WAY, Domain, survey
from umf_ros.lab.simulation.scenes import landscape, pose_at, take, without_image, without_scan
from umf_ros.sensors.decode import Cloud
from umf_ros.verification import Hypothesis, RejectReason, Verifier
from umf_ros.verification import constants as const
from umf_ros.verification import verifier as verifier_module
from umf_ros.verification.hypothesis import SCAN
from umf_ros.verification.pose_search import Fit, RotatedMaps, search
from umf_ros.verification.prepared_scan import PreparedScan

GROUND, ELSEWHERE = landscape(20), landscape(99)
LEAST = 0.7  # probability of a right pose where nothing stands up from the ground


@pytest.fixture
def verifier() -> Verifier:
    return Verifier(Verification(min_probability=LEAST))


HERE, THERE = pose_at(GROUND, -14.0, 1.2, 6.0, 2.0), pose_at(GROUND, -15.0, 0.0, 0.0)
TRUE = relative(THERE, HERE)


def candidate(keyframe: Keyframe, index: int = 0, similarity: float = 0.7) -> tuple[Candidate, Keyframe]:
    return Candidate(index, keyframe.stamp_ns, similarity), keyframe


def others(count: int) -> list[tuple[Candidate, Keyframe]]:
    """Candidates of another landscape."""
    poses = [pose_at(ELSEWHERE, -20.0 + number, -15.0 + 5.0 * number, 20.0) for number in range(count)]
    return [candidate(take(ELSEWHERE, pose, 20.0 + n), n + 1, 0.75) for n, pose in enumerate(poses)]


def gap(verdict: Hypothesis) -> tuple[float, float]:
    assert verdict.closure is not None
    error = relative(TRUE, verdict.closure.match_T_query)
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(rotation_angle(error)))


def test_revisit_among_others_is_found_with_its_pose(verifier: Verifier) -> None:
    query, match = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
    verdicts = verifier.verify(query, [*others(5), candidate(match)])
    assert len(verdicts) == 6
    best = verdicts[0]
    assert best.accepted and best.outcome == "accepted"
    assert best.candidate.stamp_ns == match.stamp_ns
    assert gap(best)[0] < 0.05 and gap(best)[1] < 0.3
    assert best.closure is not None and best.closure.query_stamp_ns == query.stamp_ns
    assert best.closure.probability >= LEAST
    assert [verdict.closure for verdict in verdicts[1:]] == [None] * 5


def test_every_verdict_has_numbers_and_a_reason(verifier: Verifier) -> None:
    verdicts = verifier.verify(take(GROUND, HERE, 100.0), [*others(7), candidate(take(GROUND, THERE, 10.0))])
    assert all((verdict.accepted or verdict.reason) and verdict.measurements["similarity"] > 0 for verdict in verdicts)
    assert {"residual_m", "overlap", "probability", "inliers_image", "support"} <= set(verdicts[0].numbers)
    pixels = verdicts[0].inlier_pixels
    assert pixels.shape[1] == 4 and len(pixels) > 10


def test_the_most_probable_closures_are_published_and_no_more_than_asked_for() -> None:
    """Several candidates of one place: their closures share the query's scan, so their errors are correlated."""
    matches = [take(GROUND, pose_at(GROUND, -15.0 + 1.0 * n, 0.0, 0.0), 10.0 + n) for n in range(4)]
    places = [candidate(match, n) for n, match in enumerate(matches)]
    query = take(GROUND, HERE, 100.0)
    for most in (1, 2):
        found = Verifier(Verification(max_closures=most, refine_best=4, min_probability=LEAST)).verify(query, places)
        assert sum(verdict.closure is not None for verdict in found) == most
        left = [verdict for verdict in found if verdict.reason is RejectReason.LESS_PROBABLE]
        least = min(verdict.closure.probability for verdict in found if verdict.closure is not None)
        assert left and all(verdict.probability is not None and verdict.probability <= least for verdict in left)


def test_rejected_candidate_says_how_far_it_fell_short(verifier: Verifier) -> None:
    verdicts = verifier.verify(take(GROUND, HERE, 100.0), others(3))
    assert all(verdict.closure is None for verdict in verdicts)
    for verdict in verdicts:
        judged = verdict.probability is not None
        assert (verdict.reason is RejectReason.IMPROBABLE) == judged
        assert judged == (f"< {LEAST:g}" in verdict.outcome) and not verdict.accepted


def test_covariance_covers_the_error(verifier: Verifier) -> None:
    found = verifier.verify(take(GROUND, HERE, 100.0), [candidate(take(GROUND, THERE, 10.0))])[0]
    assert found.closure is not None
    covariance = found.closure.covariance
    assert np.linalg.eigvalsh(covariance)[0] > 0
    error = found.closure.match_T_query[:3, 3] - TRUE[:3, 3]
    assert error @ np.linalg.solve(covariance[:3, :3], error) < 30


def test_lidar_alone_is_enough(verifier: Verifier) -> None:
    query, match = without_image(take(GROUND, HERE, 100.0)), without_image(take(GROUND, THERE, 10.0))
    found = verifier.verify(query, [candidate(match)])[0]
    assert gap(found)[0] < 0.05
    assert len(found.inlier_pixels) == 0


def test_camera_alone_gives_a_pose_and_says_how_sure_it_is(verifier: Verifier) -> None:
    query, match = without_scan(take(GROUND, HERE, 100.0)), without_scan(take(GROUND, THERE, 10.0))
    found = Verifier(Verification(min_probability=0.0)).verify(query, [candidate(match)])[0]
    assert gap(found)[0] < 0.3 and gap(found)[1] < 2
    wrong = take(landscape(21), pose_at(landscape(21), -15, 0, 0), 10.0)
    rejected = verifier.verify(query, [candidate(without_scan(wrong))])[0]
    assert rejected.closure is None


def test_without_depths_on_either_side_the_reason_says_so(verifier: Verifier) -> None:
    def flat(keyframe: Keyframe) -> Keyframe:
        image = keyframe.embedding.image
        assert image is not None
        unknown = replace(image, points=np.full_like(image.points, np.nan))
        return replace(without_scan(keyframe), embedding=replace(keyframe.embedding, image=unknown, cloud=None))

    query, match = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
    assert verifier.verify(flat(query), [candidate(flat(match))])[0].reason is RejectReason.NO_DEPTH
    assert verifier.verify(flat(query), [candidate(without_scan(match))])[0].reason is not RejectReason.NO_DEPTH


def test_no_candidates_no_verdicts(verifier: Verifier) -> None:
    assert verifier.verify(take(GROUND, HERE, 100.0), []) == []


def test_threshold_is_the_one_knob() -> None:
    query, match = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
    assert Verifier(Verification(min_probability=1.0)).verify(query, [candidate(match)])[0].closure is None
    assert Verifier(Verification(min_probability=0.5)).verify(query, [candidate(match)])[0].closure is not None


@pytest.mark.parametrize("modalities", ["image", "cloud"])
def test_one_modality_can_rerank_alone(modalities: str) -> None:
    chosen = Verifier(Verification(modalities=modalities, min_probability=LEAST))
    found = chosen.verify(take(GROUND, HERE, 100.0), [candidate(take(GROUND, THERE, 10.0))])[0].measurements
    assert (found["inliers_image"] > 0) == (modalities == "image")
    assert (found["inliers_cloud"] > 0) == (modalities == "cloud")


def drive(shift: Array) -> list[tuple[Keyframe, Keyframe]]:
    """Queries and matches of a few steps along a path, with odometry that drifted by `shift`."""
    pairs = []
    for step in range(3):
        here, there = pose_at(GROUND, -14.0 + step, 1.2, 6.0), pose_at(GROUND, -15.0 + step, 0.0, 0.0)
        pairs.append(
            (take(GROUND, here, 100.0 + step, odom=shift @ here), take(GROUND, there, 10.0 + step, odom=there))
        )
    return pairs


def test_neighbouring_keyframes_support_each_other_until_reset(verifier: Verifier) -> None:
    support = []
    for query, match in drive(make_pose(np.eye(3), [2.0, 1.0, 0.0])):
        support.append(verifier.verify(query, [candidate(match)])[0].measurements["support"])
    assert support == [0, 1, 2]
    verifier.reset()
    query, match = drive(np.eye(4))[2]
    assert verifier.verify(query, [candidate(match)])[0].measurements["support"] == 0


def test_expected_place_is_tested_before_better_looking_ones() -> None:
    verifier = Verifier(Verification(refine_best=1, min_probability=LEAST))
    first, second = drive(np.eye(4))[:2]
    assert verifier.verify(first[0], [candidate(first[1])])[0].closure is not None
    lookalikes = [(replace(found, similarity=0.99), keyframe) for found, keyframe in others(4)]
    blind = replace(second[1], embedding=replace(second[1].embedding, image=None, cloud=None))
    verdicts = verifier.verify(second[0], [*lookalikes, candidate(blind, similarity=0.1)])
    assert verdicts[0].closure is not None and verdicts[0].candidate.stamp_ns == blind.stamp_ns


PROBE = """
from umf_ros.lab.simulation.scenes import *; from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate; from umf_ros.verification import Verifier
ground = landscape(20); verifier = Verifier(Verification())
for step in range(2):
    query = take(ground, pose_at(ground, -14.0 + step, 1.2, 6.0), 100.0 + step)
    matches = [take(ground, pose_at(ground, -15.0 + 3 * n, 4.0 * n, 20.0 * n), 10.0 + n) for n in range(4)]
    for verdict in verifier.verify(query, [(Candidate(n, m.stamp_ns, 0.5), m) for n, m in enumerate(matches)]):
        print(verdict.outcome, sorted(verdict.numbers.items()))
        found = verdict.closure
        if found: print(found.match_T_query.tobytes().hex(), found.covariance.tobytes().hex())
"""


def test_same_bits_whatever_the_number_of_threads() -> None:
    outputs = set()
    for threads in ("1", "4"):
        limits = {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        done = subprocess.run(
            [sys.executable, "-c", PROBE], env=os.environ | limits, capture_output=True, text=True, check=True
        )
        outputs.add(done.stdout)
    assert len(outputs) == 1
    assert "accepted" in outputs.pop()


@pytest.mark.parametrize(
    ("limits", "word"), [({"max_turn_deg": 3.0}, "max_turn_deg: 6 deg > 3"), ({"max_shift_m": 0.5}, "m > 0.5")]
)
def test_right_pose_of_another_view_is_no_closure(limits: dict[str, float], word: str) -> None:
    verdict = Verifier(Verification(**limits, min_probability=LEAST)).verify(
        take(GROUND, HERE, 100.0), [candidate(take(GROUND, THERE, 10.0))]
    )[0]
    assert verdict.closure is None and word in verdict.outcome
    assert verdict.probability is not None and verdict.probability > LEAST


def test_without_limits_the_probability_decides_however_far_or_turned() -> None:
    """Half of the view is shared."""
    far = take(GROUND, pose_at(GROUND, -15.0, 0.4, 34.0), 100.0)
    found = [
        Verifier(settings).verify(far, [candidate(take(GROUND, THERE, 10.0))])[0]
        for settings in (Verification(min_probability=0.0), Verification(min_probability=0.0, max_turn_deg=30.0))
    ]
    assert found[0].closure is not None and found[0].probability == found[1].probability
    assert found[1].closure is None and found[1].reason is RejectReason.TURNED


def test_a_view_all_around_may_be_turned_as_far_as_the_user_lets_it() -> None:
    level = make_pose(np.eye(3), [0.0, 0.0, 1.0])
    turned = make_pose(np.diag([-1.0, -1.0, 1.0]), [0.6, 0.3, 1.0])
    match = replace(without_image(take(GROUND, THERE, 10.0)), points=yard_scan(1, level))
    query = replace(without_image(take(GROUND, HERE, 100.0)), points=yard_scan(1, turned))
    for limit, accepted in ((0.0, True), (90.0, False), (180.0, True)):
        settings = Verification(min_probability=0.0, max_turn_deg=limit)
        verdict = Verifier(settings).verify(query, [candidate(match)])[0]
        assert (verdict.closure is not None) == accepted, verdict.outcome
        assert accepted or verdict.outcome.endswith("180 deg > 90")


def steady(keyframe: Keyframe) -> Keyframe:
    """The same, with the motion during the scan removed."""
    return replace(keyframe, motion=ScanMotion.none(len(keyframe.points)))


def test_surfaces_that_do_not_coincide_are_improbable() -> None:
    query, match = (steady(take(GROUND, pose, stamp_s)) for pose, stamp_s in ((HERE, 100.0), (THERE, 10.0)))
    bent = query.points + np.column_stack(
        [np.zeros((len(query.points), 2)), 0.15 * np.sin(1.5 * query.points[:, 0])]
    ).astype(np.float32)
    pair = [candidate(match)]
    verdict = Verifier(Verification()).verify(replace(query, points=bent), pair)[0]
    assert verdict.closure is None and verdict.reason is RejectReason.IMPROBABLE
    assert Verifier(Verification()).verify(query, pair)[0].closure is not None


def test_what_is_expected_and_found_needs_no_comparison_of_the_others(verifier: Verifier) -> None:
    pairs = drive(np.eye(4))
    for query, match in pairs[:2]:
        assert verifier.verify(query, [*others(4), candidate(match)])[0].closure is not None
    found, *rest = verifier.verify(pairs[2][0], [*others(4), candidate(pairs[2][1])])
    assert found.closure is not None and found.closure.match_stamp_ns == pairs[2][1].stamp_ns
    assert {verdict.reason for verdict in rest} == {RejectReason.NOT_COMPARED} and len(rest) == 4
    assert not any("inliers_image" in verdict.measurements for verdict in rest)
    several = Verifier(Verification(max_closures=3, min_probability=LEAST))
    for query, match in pairs:
        last = several.verify(query, [*others(4), candidate(match)])
    assert RejectReason.NOT_COMPARED not in {verdict.reason for verdict in last}  # more were asked for


def test_the_predicted_pose_is_judged_without_a_search_but_every_few_keyframes(
    verifier: Verifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched: list[int] = []

    def counted(match: PreparedScan, turned: RotatedMaps) -> list[Fit]:
        searched.append(step)
        return search(match, turned)

    monkeypatch.setattr("umf_ros.verification.pose_search.search", counted)
    poses = [(pose_at(GROUND, x, 1.2, 6.0), pose_at(GROUND, x - 1.0, 0.0, 0.0)) for x in np.arange(-14.0, -9.0, 0.5)]
    for step, (here, there) in enumerate(poses):
        query, match = (
            replace(take(GROUND, pose, start_s + step), odom_T_body=pose)
            for pose, start_s in ((here, 100.0), (there, 10.0))
        )
        closure = verifier.verify(query, [candidate(match)])[0].closure
        assert closure is not None and near(closure.match_T_query, relative(there, here), 0.3, 0.1)
    assert searched == [0, 4, 8]


def test_what_odometry_predicts_wrongly_is_searched(verifier: Verifier) -> None:
    (first, match), (second, later) = drive(np.eye(4))[:2]
    assert verifier.verify(first, [candidate(match)])[0].closure is not None
    assert second.odom_T_body is not None
    slipped = replace(second, odom_T_body=second.odom_T_body @ make_pose(np.eye(3), [2.5, 0.0, 0.0]))
    alone = Verifier(Verification(min_probability=LEAST)).verify(second, [candidate(later)])[0]
    found = verifier.verify(slipped, [candidate(later)])[0]
    assert found.closure is not None and near(found.pose, alone.pose, 0.05, 0.02)


def test_the_others_are_compared_where_the_expected_place_is_refuted(
    verifier: Verifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A less probable hypothesis about it that nothing refutes does not decide, and spares no comparison."""
    pairs = drive(np.eye(4))
    verifier.verify(pairs[0][0], [candidate(pairs[0][1])])

    judge = Verifier._judge

    def judge_with_a_refuted_one(self: Verifier, *given: Any) -> list[Hypothesis]:
        judged = judge(self, *given)
        refuted = [replace(one, measurements=one.measurements | {"lead": 0.5}, probability=1.0) for one in judged[:1]]
        return judged + refuted

    monkeypatch.setattr(Verifier, "_judge", judge_with_a_refuted_one)
    verdicts = verifier.verify(pairs[1][0], [*others(2), candidate(pairs[1][1])])
    assert RejectReason.NOT_COMPARED not in {verdict.reason for verdict in verdicts}


def test_hypotheses_that_end_at_one_pose_are_judged_once(verifier: Verifier) -> None:
    query, match = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
    judged = verifier.examine(query, [candidate(match)])
    poses = [one.pose for one in judged]
    assert poses
    for number, pose in enumerate(poses):
        assert not any(near(pose, other, const.DISTINCT_M, const.DISTINCT_RAD) for other in poses[:number])


def test_given_poses_are_judged_as_if_the_search_had_found_them(monkeypatch: pytest.MonkeyPatch) -> None:
    query, match = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
    found = Verifier(Verification()).examine(query, [candidate(match)])
    rivals: list[list[Array]] = []
    monkeypatch.setattr(verifier_module, "compare_elsewhere", lambda *given: rivals.append(given[-1]) or {})
    away = TRUE @ make_pose(np.eye(3), [3.0, 5.0, 0.0])
    here, wrong = Verifier(Verification()).examine(query, [candidate(match)], [TRUE, away])[len(found) :]
    assert near(here.pose, TRUE, 0.05, 0.02) and not near(wrong.pose, TRUE, 1.0, 0.3)
    # the pose that the search found
    assert [any(near(pose, TRUE, 0.05, 0.02) for pose in beside) for beside in rivals[-2:]] == [False, True]


def rivals_known(verdicts: list[Hypothesis]) -> list[bool]:
    return ["rival_far" in one.measurements for one in verdicts if one.kind == SCAN]


def test_what_is_hopeless_is_held_against_no_rivals_and_all_else_is() -> None:
    query, match = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
    found = Verifier(Verification(min_probability=LEAST)).verify(query, [candidate(match)])
    assert found[0].closure is not None and rivals_known(found)[0]
    wrong = Verifier(Verification()).verify(query, others(4))
    assert wrong and not any(verdict.closure for verdict in wrong)
    assert wrong and not any(verdict.accepted for verdict in wrong)
    # who asks for improbable ones, or fits the decision, gets every number
    everything = Verifier(Verification(min_probability=0.0)).verify(query, others(4))
    assert rivals_known(everything) and all(rivals_known(everything))
    examined = Verifier(Verification()).examine(query, others(4))
    assert rivals_known(examined) and all(rivals_known(examined))
    # what was left out would have changed no verdict
    by_stamp = {verdict.candidate.stamp_ns: verdict for verdict in everything}
    for verdict in wrong:
        assert (by_stamp[verdict.candidate.stamp_ns].probability or 0.0) < 0.5


def on_even_ground(keyframe: Keyframe) -> Keyframe:
    """The same keyframe, where the LiDAR sees nothing but a bare plane."""
    x, y = np.meshgrid(np.arange(2.0, 20.0, 0.4), np.arange(-8.0, 8.0, 0.4))
    height = np.random.default_rng(keyframe.stamp_ns % 2**32).normal(0, 0.003, x.shape)
    points = np.column_stack([x.ravel(), y.ravel(), height.ravel()]).astype(np.float32)
    return replace(keyframe, points=points)


def test_where_both_scans_show_bare_ground_the_images_tell_the_pose() -> None:
    """A bare plane lies as well anywhere on another; a scan with something on it is still asked."""
    asked = Verifier(Verification(min_probability=0.0))
    query, match = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
    seen = asked.verify(on_even_ground(query), [candidate(on_even_ground(match))])[0]
    assert seen.kind == "image" and gap(seen)[0] < 0.3
    asked.reset()
    assert asked.verify(query, [candidate(match)])[0].kind == "scan"
    asked.reset()
    assert asked.verify(on_even_ground(query), [candidate(match)])[0].closure is None
    blind = [without_image(on_even_ground(one)) for one in (query, match)]
    asked.reset()
    assert asked.verify(blind[0], [candidate(blind[1])])[0].closure is None


def test_a_pose_is_compared_with_hypotheses_that_ranked_behind_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a room whose ends look alike the right pose can rank behind the one that is turned by 180 deg."""
    monkeypatch.setattr(const, "MAX_REFINED", 1)
    domain = Domain("solid360", "rooms", "tilted")
    scans = survey(domain, 20052, 4.0, 24.0)
    accepted = 0
    for query in (scan for scan in scans if scan.label == OTHER_WAY):
        for match in (scan for scan in scans if scan.label == FIRST):
            true = relative(match.world_T_body, query.world_T_body)
            if np.linalg.norm(true[:3, 3]) < 2.0:
                now, before = snapshot(query.sweep.points, 9.0), snapshot(match.sweep.points, 1.0)
                found = Verifier(Verification()).verify(now, [candidate(before)])[0]
                accepted += found.accepted
                assert not (found.accepted and is_wrong(found.pose, true))
    assert accepted >= 4


def snapshot(points: Array, at_s: float) -> Keyframe:
    """The keyframe of a scan that nothing else is known of."""
    cloud = Cloud(points.astype(np.float32), None)
    return assemble(make_snapshot(cloud, stamp_ns=round(at_s * 1e9)), NOT_EMBEDDED)
