"""Every test of a hypothesis, at the true pose and beside it."""

from __future__ import annotations

import inspect
import math
from dataclasses import fields, replace

import numpy as np
import pytest

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe, LocalFeatures, ScanMotion
from umf_ros.core.geometry import make_pose, relative
from umf_ros.lab.simulation.scenes import landscape, pose_at, take, without_image, without_scan
from umf_ros.verification import Measurement, Verifier
from umf_ros.verification.constants import BLUR_M
from umf_ros.verification.hypothesis import IMAGE, SCAN
from umf_ros.verification.measurement import cloud_agreement, image_agreement
from umf_ros.verification.rerank import strongest

GROUND = landscape(20)
HERE, THERE = pose_at(GROUND, -14.0, 1.2, 6.0, 2.0), pose_at(GROUND, -15.0, 0.0, 0.0)
TRUE = relative(THERE, HERE)
QUERY, MATCH = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
OTHER = take(landscape(99), pose_at(landscape(99), -15.0, 0.0, 0.0), 20.0)
COUNTS = ["similarity", "inliers_image", "inliers_cloud", "superfeatures"]
SCANS = ["residual_m", "residual_p90_m", "noise_m", "overlap", "points", "relief_m"]
MAPS = ["terrain_correlation", "terrain_score"]
VIEWS = ["residual_m", "residual_sigmas", "overlap", "pose_inliers", "spread", "two_way_m"]
POSE = ["position_std_m", "heading_std_deg", "agreement_image", "agreement_cloud", "prior_sigmas", "support"]

KNOWN = {*COUNTS, *SCANS, *MAPS, *VIEWS, *POSE}
KINDS = {"": COUNTS, SCAN: COUNTS + SCANS + MAPS + POSE, IMAGE: COUNTS + VIEWS + POSE}


def measured(query: Keyframe, match: Keyframe) -> Measurement:
    """Of the most probable hypothesis about a pair."""
    examined = Verifier(Verification()).examine(query, [(Candidate(0, match.stamp_ns, 0.7), match)])
    return max(examined, key=lambda one: one.probability).measurement


@pytest.mark.parametrize(("kind", "names"), KINDS.items())
def test_tables_get_the_numbers_of_the_kind_under_names_that_stay(kind: str, names: list[str]) -> None:
    """Others may join them."""
    numbers = Measurement(similarity=0.5, kind=kind).numbers
    assert [name for name in numbers if name in KNOWN] == names


def test_every_field_says_what_it_is() -> None:
    documented = inspect.getdoc(Measurement) or ""
    assert [one.name for one in fields(Measurement) if f"\n    {one.name}: " not in documented] == []


def test_a_pair_of_scans_is_measured_completely() -> None:
    found = measured(QUERY, MATCH)
    assert found.kind == SCAN and found.similarity == 0.7
    assert found.residual_m < found.residual_p90_m < 0.1 < 0.8 < found.overlap
    assert found.noise_m > BLUR_M  # the motion during these scans is not removed
    steady = [replace(one, motion=ScanMotion.none(len(one.points))) for one in (QUERY, MATCH)]
    assert measured(*steady).residual_m < measured(*steady).noise_m < found.residual_p90_m
    assert found.points > 500 and found.relief_m > 0.04
    assert found.terrain_correlation > 0.7 and found.terrain_score > 10
    assert found.position_std_m < 0.1 and found.heading_std_deg < 0.5
    assert found.agreement_cloud > 5 and found.support == 0
    assert math.isnan(found.prior_sigmas) and math.isnan(found.pose_inliers)  # no odometry; not of this kind


def test_without_a_scan_the_views_are_measured() -> None:
    found = measured(without_scan(QUERY), MATCH)
    assert found.kind == IMAGE
    assert found.pose_inliers >= 15 and found.spread > 0.05 and found.residual_m < 0.5 and 0.3 < found.overlap <= 1
    assert found.two_way_m < 0.5 and 0.5 < found.residual_sigmas < 3
    assert math.isnan(found.agreement_cloud) and math.isnan(found.points)


def test_another_place_measures_worse() -> None:
    right, wrong = measured(QUERY, MATCH), measured(QUERY, OTHER)
    assert wrong.residual_m > 2 * right.residual_m and wrong.terrain_score < 0.7 * right.terrain_score
    assert wrong.overlap < right.overlap and wrong.position_std_m > right.position_std_m


@pytest.mark.parametrize("agreement", [image_agreement, cloud_agreement])
def test_agreement_is_far_beyond_chance_at_the_true_pose_only(agreement) -> None:
    beside = TRUE @ make_pose(np.eye(3), [0.0, 5.0, 0.0])
    assert agreement(QUERY, MATCH, TRUE) > 5.0
    assert agreement(QUERY, MATCH, beside) < 3.0
    assert abs(agreement(QUERY, OTHER, TRUE)) < 3.0


def few(features: LocalFeatures | None, count: int) -> LocalFeatures:
    assert features is not None
    return strongest(features, count)


@pytest.mark.parametrize("count", [0, 3])
def test_agreement_of_next_to_nothing_is_unknown_rather_than_bad(count: int) -> None:
    embedding = replace(
        MATCH.embedding, image=few(MATCH.embedding.image, count), cloud=few(MATCH.embedding.cloud, count)
    )
    match = replace(MATCH, embedding=embedding)
    assert math.isnan(image_agreement(QUERY, match, TRUE))
    assert math.isnan(cloud_agreement(QUERY, match, TRUE))
    assert math.isnan(image_agreement(QUERY, without_image(MATCH), TRUE))
    assert math.isnan(cloud_agreement(without_scan(QUERY), MATCH, TRUE))


def test_agreement_does_not_depend_on_the_scale_of_the_descriptors() -> None:
    """Other weights spread similarities differently; only their order may count."""

    def squeezed(keyframe: Keyframe) -> Keyframe:
        image = keyframe.embedding.image
        assert image is not None
        common = 3.0 * np.ones((1, image.descriptors.shape[1])) / np.sqrt(image.descriptors.shape[1])
        rows = image.descriptors + common
        unit = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float16)
        return replace(keyframe, embedding=replace(keyframe.embedding, image=replace(image, descriptors=unit)))

    plain, crowded = image_agreement(QUERY, MATCH, TRUE), image_agreement(squeezed(QUERY), squeezed(MATCH), TRUE)
    assert crowded == pytest.approx(plain, rel=0.2)
