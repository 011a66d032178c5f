"""Tests of a hypothesis.

A new test is three steps: a function of what a `Hypothesis` holds, a field of `Measurement` that `measure`
fills with it, and a `Criterion` in `acceptance` with the values that speak for a closure. Its weight is 0 until
`umf_ros/lab/fit/scan_acceptance.py` has fitted one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, make_pose, transform
from umf_ros.verification import constants as const
from umf_ros.verification.ambiguity import passage_rival, scan_ambiguity
from umf_ros.verification.elevation_map import evaluate, shared_relief
from umf_ros.verification.hypothesis import IMAGE, SCAN, SUBMAP, Hypothesis, Measurement
from umf_ros.verification.pose_search import TemporalMemory, near, prior_sigmas
from umf_ros.verification.prepared_scan import PreparedScan, common_blur, levelled
from umf_ros.verification.rerank import similarities, strongest
from umf_ros.verification.scan_alignment import (
    Alignment,
    CovarianceModel,
    covariance_of,
    nominal_deviations,
    scan_covariance,
)
from umf_ros.verification.scan_consistency import compare_scans
from umf_ros.verification.view_alignment import ViewAlignment


def measure(hypothesis: Hypothesis, memory: TemporalMemory, drift: float) -> Measurement:
    """Return the results of all tests of an aligned hypothesis but the slow ones and those that need others.

    Args:
        hypothesis: with its keyframes, scans and alignment.
        memory: findings of earlier keyframes.
        drift: odometry error per distance driven.
    """
    (query, match), pose, alignment = hypothesis.keyframes, hypothesis.pose, hypothesis.alignment
    known = Measurement.of(hypothesis.candidate)
    assert alignment is not None
    if isinstance(alignment, ViewAlignment):
        fit = _measure_views(known, alignment)
    else:
        fit = _measure_scans(known, alignment, *hypothesis.scans)
    position_std_m, heading_std_deg = nominal_deviations(alignment.information)
    return replace(
        fit,
        position_std_m=position_std_m,
        heading_std_deg=heading_std_deg,
        agreement_cloud=cloud_agreement(query, match, pose),
        prior_sigmas=prior_sigmas(query, match, pose, drift),
        support=memory.support(query, match, pose),
    )


def measure_ambiguity(hypothesis: Hypothesis) -> Measurement:
    """Return the measurement with the fit of the scans at poses beside this one, the slowest test but one."""
    if not hypothesis.scans or not isinstance(hypothesis.alignment, Alignment):
        return hypothesis.measurement
    match, query = hypothesis.scans
    near_by, far = scan_ambiguity(match, query, hypothesis.pose, hypothesis.alignment.information)
    return replace(hypothesis.measurement, rival_near=near_by, rival_far=far)


def measure_passage(hypothesis: Hypothesis) -> Measurement:
    """Return the measurement with the fit of the surfaces elsewhere along a passage, the slowest test."""
    if not hypothesis.scans:
        return hypothesis.measurement
    match, query = hypothesis.scans
    return replace(hypothesis.measurement, passage_rival=passage_rival(match, query, hypothesis.pose))


def compare_poses(measurement: Measurement, pose: Array, others: Sequence[tuple[Array, Measurement]]) -> Measurement:
    """Return the measurement with its lead over other poses `match_T_query` for the same candidate."""
    distinct = [other.missing for there, other in others if not near(pose, there, const.DISTINCT_M, const.DISTINCT_RAD)]
    if measurement.kind == IMAGE or not distinct:
        return measurement
    room = const.RUNNER_UP_ROOM
    return replace(measurement, runner_up=math.log((min(distinct) + room) / (measurement.missing + room)))


def closure_covariance(hypothesis: Hypothesis, model: CovarianceModel) -> Array:
    """Covariance (6, 6) of the pose in ROS order, match axes, m^2 and rad^2."""
    query, match = hypothesis.keyframes
    if isinstance(hypothesis.alignment, Alignment):
        return scan_covariance(match, query, hypothesis.alignment, model)
    assert hypothesis.alignment is not None
    return covariance_of(hypothesis.alignment.information, model)


def image_agreement(query: Keyframe, match: Keyframe, pose: Array) -> float:
    """Whether the query's image features reappear where the pose says, in standard deviations of chance.

    Each lifted feature of the query is projected into the match's image. Of the match's features at about the same
    row, is the one at that place among the most similar? Ranks mean the same for any weights. NaN without any.
    """
    ours, theirs = query.embedding.image, match.embedding.image
    if ours is None or theirs is None:
        return float("nan")
    ours, theirs = strongest(ours, const.AGREEMENT_COMPARED), strongest(theirs, const.AGREEMENT_COMPARED)
    camera = match.camera
    pixels, depth = camera.project(transform(pose, ours.points.astype(float)), match.body_T_camera)
    ahead = depth > 0  # False for what has no depth
    offset = pixels[ahead, None].astype(np.float32) - theirs.positions[None]
    squared = np.einsum("ijk,ijk->ij", offset, offset)
    peers = np.abs(offset[..., 1]) < const.AGREEMENT_ROWS * camera.height
    return _rank_agreement(
        ours.descriptors[ahead], theirs.descriptors, squared, const.AGREEMENT_PIXELS * camera.width, peers
    )


def cloud_agreement(query: Keyframe, match: Keyframe, pose: Array) -> float:
    """The same for the scan's features: peers are those at about the same distance from the match."""
    ours, theirs = query.embedding.cloud, match.embedding.cloud
    if ours is None or theirs is None:
        return float("nan")
    ours, theirs = strongest(ours, const.AGREEMENT_COMPARED), strongest(theirs, const.AGREEMENT_COMPARED)
    moved = transform(pose, ours.positions.astype(float))
    offset = moved[:, None].astype(np.float32) - theirs.positions[None]
    squared = np.einsum("ijk,ijk->ij", offset, offset)
    range_ours = np.linalg.norm(moved, axis=1)[:, None]
    range_theirs = np.linalg.norm(theirs.positions, axis=1)[None]
    peers = np.abs(range_ours - range_theirs) < const.AGREEMENT_RANGE * range_theirs + const.AGREEMENT_RANGE_M
    return _rank_agreement(ours.descriptors, theirs.descriptors, squared, const.AGREEMENT_M, peers)


def _measure_scans(known: Measurement, alignment: Alignment, match: PreparedScan, query: PreparedScan) -> Measurement:
    """Tests of how two scans fit."""
    pose = alignment.pose
    level = levelled(match, query, pose)
    fit = evaluate(match.elevation, query.elevation, level)
    ours, theirs = compare_scans(match, query, pose)
    narrow = match.narrow or query.narrow
    beside = [evaluate(match.elevation, query.elevation, move @ level).correlation for move in _BESIDE if narrow]
    size = np.abs(alignment.residuals) if len(alignment.points) else np.full(1, const.NO_FIT_M)
    return replace(
        known,
        kind=SUBMAP if narrow else SCAN,
        terrain_rival=max(beside, default=math.nan),
        residual_m=float(np.median(size)),
        residual_p90_m=float(np.percentile(size, 90)),
        noise_m=math.hypot(max(match.noise_m, const.MIN_NOISE_M), common_blur(match, query)),
        overlap=alignment.overlap,
        points=float(len(alignment.points)),
        relief_m=shared_relief(match.elevation, query.elevation, level),
        terrain_correlation=fit.correlation,
        terrain_score=fit.score,
        common=min(ours.common, theirs.common),
        contradiction=max(ours.contradiction, theirs.contradiction),
        counterparts=min(ours.counterparts, theirs.counterparts),
        upright_counterparts=float(np.fmin(ours.upright_counterparts, theirs.upright_counterparts)),
        unexplained=float(np.fmax(ours.unexplained, theirs.unexplained)),
    )


_BESIDE = [
    make_pose(np.eye(3), [metres * math.cos(angle), metres * math.sin(angle), 0])
    for metres in const.RIVAL_TERRAIN_M
    for angle in np.arange(0, 2 * np.pi, np.pi / 4)
]


def _measure_views(known: Measurement, alignment: ViewAlignment) -> Measurement:
    """Tests of how two views fit, where there are no two scans."""
    return replace(
        known,
        kind=IMAGE,
        residual_m=alignment.distance_m,
        residual_sigmas=alignment.spread_sigmas,
        overlap=alignment.share,
        pose_inliers=float(len(alignment.residuals)),
        spread=alignment.spread,
        disparity_bias_px=alignment.bias_px,
        two_way_m=alignment.two_way_m,
    )


def _rank_agreement(
    ours: NDArray[Any], theirs: NDArray[Any], squared: NDArray[Any], reach: float, peers: NDArray[np.bool_]
) -> float:
    """Mean rank of the similarity of the nearest counterpart among its peers, as a z-score.

    Args:
        ours: (N, D) descriptors.
        theirs: (M, D) descriptors.
        squared: (N, M) distances.
        reach: how far away a counterpart may be, in the unit of the distances before they were squared.
        peers: (N, M) descriptors of `theirs` that each of `ours` is compared with.
    """
    if 0 in squared.shape:
        return float("nan")
    nearest = squared.argmin(axis=1)
    rows = np.arange(len(squared))
    usable = np.flatnonzero((squared[rows, nearest] < reach**2) & (peers.sum(axis=1) >= const.AGREEMENT_PEERS))
    if not len(usable):
        return float("nan")
    similarity, among = similarities(ours[usable], theirs), peers[usable]
    own = similarity[np.arange(len(usable)), nearest[usable]]
    below = ((similarity < own[:, None]) & among).sum(axis=1)
    rank = below / np.maximum(among.sum(axis=1) - 1, 1)
    return float((np.minimum(rank, 1).mean() - 0.5) * np.sqrt(12 * len(usable)))
