"""Every test of a hypothesis, and the typed numbers that the tests give.

A new test is three steps: a function of what an `AlignedHypothesis` holds, a field of `Measurement` that `measure`
fills with it, and a `Criterion` in `acceptance` that says which values speak for a closure. Its weight is 0 until
`umf_ros/lab/fit/scan_acceptance.py` has fitted one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Candidate, Keyframe, Points
from umf_ros.core.geometry import Array, transform
from umf_ros.verification import constants as const
from umf_ros.verification.ambiguity import passage_rival
from umf_ros.verification.elevation_map import evaluate, shared_relief
from umf_ros.verification.hypotheses import Hypothesis, TemporalMemory, near, prior_sigmas
from umf_ros.verification.prepared_scan import PreparedScan, joint_blur, levelled
from umf_ros.verification.rerank import RankedCandidate, similarities, strongest
from umf_ros.verification.scan_alignment import (
    Alignment,
    CovarianceModel,
    closure_covariance,
    covariance_of,
    nominal_deviations,
)
from umf_ros.verification.scan_consistency import meet, rivalry
from umf_ros.verification.view_alignment import ViewAlignment

SCAN, IMAGE, SUBMAP = "scan", "image", "submap"


def measured(*kinds: str) -> Any:
    """A field for hypotheses of these kinds; NaN for others, and where nothing can be said."""
    return field(default=math.nan, metadata={"kinds": kinds})


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """What was measured about one hypothesis, or, without a kind, about a candidate that got none.

    The name of a field is its name in `candidates.csv` and on `~/candidates`.

    Attributes:
        kind: "scan" when two scans were aligned, "image" when only local features could be, "submap" when what was
            seen along the way was aligned.
        similarity: cosine similarity of the global descriptors.
        inliers_image: pairs of image features that one homography explains.
        inliers_cloud: pairs of the scan's features that one rigid motion explains.
        superfeatures: eligible pairs of super-features, where the reranking goes by them.
        residual_m: median point-to-plane distance of the scans; median distance of the pairs' points without scans.
        residual_sigmas: size of the errors of reprojection in standard deviations of the features' noise.
        residual_p90_m: nine of ten points are nearer than this to their counterpart's plane.
        noise_m: how far the match's points scatter about their own planes, and may be off for the scans' motion.
        overlap: share of the points seen by both that have a counterpart (of the feature pairs: that agree).
        points: points that have one.
        relief_m: standard deviation of the relief on the ground that both scans saw.
        terrain_correlation: of both elevation maps' relief, -1 to 1.
        terrain_score: the same in standard deviations of chance.
        terrain_rival: correlation at the best of some poses beside this one.
        common: share of a scan's points that the other should see, the smaller of both ways, as all that follow.
        contradiction: share of these that the other's rays passed by, the larger of both.
        counterparts: share of these that have a counterpart, as near as both scans' points let one expect.
        upright_counterparts: the same of walls, trunks and rocks alone; NaN where next to nothing stands.
        unexplained: share of what stands and should be seen that is far from everything, the larger of both.
        rival_near: logarithm of how much worse the fit is half a metre on, along the way that is known least; NaN
            where a hypothesis could not have become probable any more.
        rival_far: the same of the best fit 1 to 6 m on: 0 when another place fits as well.
        passage_rival: how much worse the surfaces of two scans fit at the best other pose along a passage: 0 when
            another fits as well, 1 when a closure can be accepted; NaN outside passages and for improbable hypotheses.
        pose_inliers: feature pairs that agree with the pose.
        spread: of those pairs across the image: smaller deviation of column and row, of its width and height.
        two_way_m: distance of the poses that the query's depths and the match's give by themselves.
        position_std_m: standard deviation of the position along its least known direction, from the residuals.
        heading_std_deg: of the heading.
        agreement_image: whether image features reappear where the pose says, standard deviations of chance; a word
            for people about the best hypothesis of a candidate, no part of the decision.
        agreement_cloud: the same of the scan's features.
        prior_sigmas: distance from what odometry predicts, in standard deviations of its drift.
        support: earlier keyframes, of the last few, that found a pose which odometry carries over to this one.
        runner_up: logarithm of how much more is missing at the next best hypothesis about the pair; NaN without one.
    """

    kind: str = ""
    similarity: float
    inliers_image: float = 0.0
    inliers_cloud: float = 0.0
    superfeatures: float = 0.0
    residual_m: float = measured(SCAN, IMAGE, SUBMAP)
    residual_sigmas: float = measured(IMAGE)
    residual_p90_m: float = measured(SCAN)
    noise_m: float = measured(SCAN)
    overlap: float = measured(SCAN, IMAGE, SUBMAP)
    points: float = measured(SCAN, SUBMAP)
    relief_m: float = measured(SCAN, SUBMAP)
    terrain_correlation: float = measured(SCAN, SUBMAP)
    terrain_score: float = measured(SCAN, SUBMAP)
    terrain_rival: float = measured(SUBMAP)
    common: float = measured(SCAN)
    contradiction: float = measured(SCAN)
    counterparts: float = measured(SCAN)
    upright_counterparts: float = measured(SCAN)
    unexplained: float = measured(SCAN)
    rival_near: float = measured(SCAN)
    rival_far: float = measured(SCAN)
    passage_rival: float = measured(SCAN)
    pose_inliers: float = measured(IMAGE)
    spread: float = measured(IMAGE)
    two_way_m: float = measured(IMAGE)
    position_std_m: float = measured(SCAN, IMAGE, SUBMAP)
    heading_std_deg: float = measured(SCAN, IMAGE, SUBMAP)
    agreement_image: float = measured(SCAN, IMAGE)
    agreement_cloud: float = measured(SCAN, IMAGE)
    prior_sigmas: float = measured(SCAN, IMAGE, SUBMAP)
    support: float = measured(SCAN, IMAGE, SUBMAP)
    runner_up: float = measured(SCAN)

    @property
    def misfit(self) -> float:
        """How many times their noise the surfaces of two scans are apart in the median; NaN without scans."""
        return self.residual_m / self.noise_m

    @property
    def missing(self) -> float:
        """Share of what stands, or where nothing does of all, that should have a counterpart and has none."""
        known = self.upright_counterparts
        return 1.0 - (known if math.isfinite(known) else self.counterparts)

    @property
    def discord(self) -> str:
        """What to say where one modality supports a pose that the other contradicts; else nothing."""
        if self.agreement_image < const.IMAGE_CONTRADICTS and self.contradiction < const.SCANS_SUPPORT:
            return "the scans support it, the image contradicts it"
        if self.agreement_image > const.IMAGE_SUPPORTS and self.contradiction > const.SCANS_CONTRADICT:
            return "the image supports it, the scans contradict it"
        return ""

    @property
    def numbers(self) -> dict[str, float]:
        """What was measured for this kind, by name: for tables, messages and people."""
        return {
            one.name: getattr(self, one.name)
            for one in fields(self)
            if one.name != "kind" and self.kind in one.metadata.get("kinds", [self.kind])
        }


@dataclass(frozen=True, slots=True)
class AlignedHypothesis:
    """A hypothesis after its alignment: everything that a test may look at.

    Attributes:
        query: the query keyframe.
        hypothesis: as it was found, with its candidate.
        alignment: the refined pose, its residuals and what they were measured on.
        scans: of the match and of the query; None when only their views were aligned.
    """

    query: Keyframe
    hypothesis: Hypothesis
    alignment: Alignment | ViewAlignment
    scans: tuple[PreparedScan, PreparedScan] | None

    @property
    def match(self) -> Keyframe:
        """The matched keyframe."""
        return self.hypothesis.ranked.keyframe

    @property
    def pose(self) -> Array:
        """(4, 4) `match_T_query`."""
        return self.alignment.pose

    def covariance(self, model: CovarianceModel) -> Array:
        """Covariance (6, 6) of the pose in ROS order, match axes, m^2 and rad^2."""
        if isinstance(self.alignment, ViewAlignment):
            return covariance_of(self.alignment.information, model)
        return closure_covariance(self.match, self.query, self.alignment, model)

    @property
    def consistent_pixels(self) -> Points:
        """Pixels (K, 4) of the image features that obey the pose: u, v of the query and u, v of the match."""
        views = self.hypothesis.views
        return views.consistent_pixels(self.pose) if views else np.empty((0, 4), np.float32)


def measure_candidate(ranked: RankedCandidate) -> Measurement:
    """What is known of a candidate before any hypothesis about it."""
    return Measurement(
        similarity=ranked.candidate.similarity,
        inliers_image=float(ranked.inliers_image),
        inliers_cloud=float(ranked.inliers_cloud),
        superfeatures=float(ranked.superfeatures),
    )


def uncompared(candidate: Candidate) -> Measurement:
    """What is known of a candidate whose local features nobody looked at."""
    unknown = math.nan
    return Measurement(
        similarity=candidate.similarity, inliers_image=unknown, inliers_cloud=unknown, superfeatures=unknown
    )


def measure(aligned: AlignedHypothesis, memory: TemporalMemory, drift: float) -> Measurement:
    """Every test of one hypothesis but those of `against_rivals`.

    Args:
        aligned: the hypothesis.
        memory: what earlier keyframes found.
        drift: odometry error per distance driven.
    """
    query, match, pose, alignment = aligned.query, aligned.match, aligned.pose, aligned.alignment
    known = measure_candidate(aligned.hypothesis.ranked)
    if isinstance(alignment, ViewAlignment):
        fit = _measure_views(known, alignment)
    else:
        assert aligned.scans is not None
        fit = _measure_scans(known, alignment, *aligned.scans)
    position_std_m, heading_std_deg = nominal_deviations(alignment.information)
    return replace(
        fit,
        position_std_m=position_std_m,
        heading_std_deg=heading_std_deg,
        agreement_cloud=cloud_agreement(query, match, pose),
        prior_sigmas=prior_sigmas(query, match, pose, drift),
        support=memory.support(query, match, pose),
    )


def against_rivals(measurement: Measurement, aligned: AlignedHypothesis) -> Measurement:
    """The same, knowing how much worse the scans fit at poses beside this one: what takes longest to find out."""
    if aligned.scans is None or isinstance(aligned.alignment, ViewAlignment):
        return measurement
    near_by, far = rivalry(*aligned.scans, aligned.pose, aligned.alignment.information)
    return replace(measurement, rival_near=near_by, rival_far=far)


def against_passage(measurement: Measurement, aligned: AlignedHypothesis) -> Measurement:
    """The same, knowing how much worse the surfaces fit elsewhere along a passage."""
    if aligned.scans is None or isinstance(aligned.alignment, ViewAlignment):
        return measurement
    return replace(measurement, passage_rival=passage_rival(*aligned.scans, aligned.pose))


def beside(measurement: Measurement, pose: Array, others: Sequence[tuple[Array, Measurement]]) -> Measurement:
    """The same, knowing the other hypotheses about the pair: poses `match_T_query` and what was measured there."""
    distinct = [other.missing for there, other in others if not near(pose, there, const.DISTINCT_M, const.DISTINCT_RAD)]
    if measurement.kind != SCAN or not distinct:
        return measurement
    room = const.RUNNER_UP_ROOM
    return replace(measurement, runner_up=math.log((min(distinct) + room) / (measurement.missing + room)))


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
    ours, theirs = meet(match, query, pose)
    size = np.abs(alignment.residuals) if len(alignment.points) else np.full(1, const.NO_FIT_M)
    return replace(
        known,
        kind=SCAN,
        residual_m=float(np.median(size)),
        residual_p90_m=float(np.percentile(size, 90)),
        noise_m=math.hypot(max(match.noise_m, const.MIN_SURFACE_NOISE_M), joint_blur(match, query)),
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
        peers: (N, M) which of theirs each of ours is compared with.
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
