"""The record of one hypothesis: a candidate, a pose for it, its measurement and the decision."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from umf_ros.core.frames import Candidate, Keyframe, LoopClosure, Points
from umf_ros.core.geometry import Array
from umf_ros.verification import constants as const

if TYPE_CHECKING:
    from umf_ros.verification.prepared_scan import PreparedScan
    from umf_ros.verification.scan_alignment import Alignment
    from umf_ros.verification.view_alignment import PairedViews, ViewAlignment

ACCEPTED = "accepted"


class RejectReason(Enum):
    """Why a candidate became no loop closure, as a sentence; `Hypothesis.detail` has the figures."""

    NOT_COMPARED = "not compared: a closure was found"
    NOT_SELECTED = "less promising than others"
    NO_DEPTH = "no depth: neither a scan nor a stereo pair"
    NO_POSE = "no pose fits"
    IMPROBABLE = "probability below verification.min_probability"
    MISFIT = "surfaces are several times their noise apart"
    PASSAGE = "surfaces fit as well elsewhere along the passage"
    AMBIGUOUS = "another pose fits as well"
    TERRAIN = "the terrain of the submaps does not fit"
    OUT_OF_RANGE = "a measurement outside the range of the fitted examples"
    TURNED = "turned by more than verification.max_turn_deg"
    LITTLE_SHARED_VIEW = "the views share too little"
    TOO_FAR = "farther apart than verification.max_shift_m"
    LESS_PROBABLE = "a more probable closure of this keyframe is published"
    UNCONFIRMED = "pending: no closure of another place agrees yet"
    UNKNOWN = "rejected by another version"


SCAN, SUBMAP, IMAGE = "scan", "submap", "image"
_MARKS = {SUBMAP: "terrain_rival", SCAN: "noise_m", IMAGE: "pose_inliers"}  # a number that tells the kind


def measured(*kinds: str) -> Any:
    """A field for hypotheses of these kinds, for submaps as for scans; NaN for others and where it is unknown."""
    return field(default=math.nan, metadata={"kinds": (*kinds, SUBMAP) if SCAN in kinds else kinds})


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """Results of the tests of one hypothesis, or, without a kind, of a candidate without a pose.

    The name of a field is its name in `candidates.csv` and on `~/candidates`.

    Attributes:
        kind: "scan" when two scans were aligned, "submap" when one was merged from scans of a narrow sensor, "image"
            when only local features could be.
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
        disparity_bias_px: estimated bias of all disparities; positive where stereo measures too little.
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
    residual_m: float = measured(SCAN, IMAGE)
    residual_sigmas: float = measured(IMAGE)
    residual_p90_m: float = measured(SCAN)
    noise_m: float = measured(SCAN)
    overlap: float = measured(SCAN, IMAGE)
    points: float = measured(SCAN)
    relief_m: float = measured(SCAN)
    terrain_correlation: float = measured(SCAN)
    terrain_score: float = measured(SCAN)
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
    disparity_bias_px: float = measured(IMAGE)
    two_way_m: float = measured(IMAGE)
    position_std_m: float = measured(SCAN, IMAGE)
    heading_std_deg: float = measured(SCAN, IMAGE)
    agreement_image: float = measured(SCAN, IMAGE)
    agreement_cloud: float = measured(SCAN, IMAGE)
    prior_sigmas: float = measured(SCAN, IMAGE)
    support: float = measured(SCAN, IMAGE)
    runner_up: float = measured(SCAN)

    @classmethod
    def of(cls, candidate: Candidate) -> Measurement:
        """The measurement of a candidate before any pose."""
        return cls(
            similarity=candidate.similarity,
            inliers_image=candidate.inliers_image,
            inliers_cloud=candidate.inliers_cloud,
            superfeatures=candidate.superfeatures,
        )

    @classmethod
    def read(cls, similarity: float, numbers: dict[str, float]) -> Measurement:
        """The measurement that `numbers` were written from; names of other versions are left out."""
        kind = next((kind for kind, name in _MARKS.items() if name in numbers), "")
        known = {one.name for one in fields(cls)} - {"kind"}
        return cls(kind=kind, **({"similarity": similarity} | {k: v for k, v in numbers.items() if k in known}))

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
    def modality_conflict(self) -> str:
        """A phrase where one modality supports a pose that the other contradicts; empty otherwise."""
        if self.agreement_image < const.IMAGE_CONTRADICTS and self.contradiction < const.SCANS_SUPPORT:
            return "the scans support it, the image contradicts it"
        if self.agreement_image > const.IMAGE_SUPPORTS and self.contradiction > const.SCANS_CONTRADICT:
            return "the image supports it, the scans contradict it"
        return ""

    @property
    def numbers(self) -> dict[str, float]:
        """Results for this kind by name, for tables, messages and people."""
        return {
            one.name: getattr(self, one.name)
            for one in fields(self)
            if one.name != "kind" and self.kind in one.metadata.get("kinds", [self.kind])
        }


@dataclass(slots=True, eq=False)
class Hypothesis:
    """One pose for one candidate, filled in as it is tested.

    A candidate that got no pose has a hypothesis without one, so that every candidate has a reason.

    Attributes:
        query_stamp_ns: key of the query keyframe.
        candidate: the candidate.
        measurement: results of the tests; of the candidate alone before there is a pose.
        reason: why it is no closure; None before the decision and when accepted.
        detail: figures for `reason`.
        probability: that the pose is right; None without a pose.
        closure: the loop closure when accepted.
        inlier_pixels: (K, 4) float32: u, v in the query image and u, v in the match image.
        keyframes: query and match; empty where the hypothesis was read from a run.
        pose: (4, 4) `match_T_query`.
        score: of the search that found the pose; larger is better.
        views: both images with their paired features, where there are any.
        scans: of match and query; empty when only their views were aligned.
        alignment: the refined pose, its residuals and their information.
    """

    query_stamp_ns: int
    candidate: Candidate
    measurement: Measurement
    reason: RejectReason | None = None
    detail: str = ""
    probability: float | None = None
    closure: LoopClosure | None = None
    inlier_pixels: Points = field(default_factory=lambda: np.empty((0, 4), np.float32))
    keyframes: tuple[Keyframe, ...] = ()
    pose: Array = field(default_factory=lambda: np.eye(4))
    score: float = 0.0
    views: PairedViews | None = None
    scans: tuple[PreparedScan, ...] = ()
    alignment: Alignment | ViewAlignment | None = None

    @classmethod
    def of(cls, query: Keyframe, candidate: Candidate, match: Keyframe, **known: Any) -> Hypothesis:
        """A hypothesis about a candidate whose keyframe is `match`."""
        return cls(query.stamp_ns, candidate, Measurement.of(candidate), keyframes=(query, match), **known)

    @property
    def match_stamp_ns(self) -> int:
        """Key of the matched keyframe."""
        return self.candidate.stamp_ns

    @property
    def endpoints(self) -> tuple[int, int]:
        """Stamps in ns of query and match."""
        return self.query_stamp_ns, self.candidate.stamp_ns

    @property
    def accepted(self) -> bool:
        """Whether it became a loop closure."""
        return self.reason is None

    @property
    def outcome(self) -> str:
        """A short phrase for a person: "accepted", or the reason with its figures."""
        if self.reason is None:
            return ACCEPTED
        return ": ".join(filter(None, (self.reason.value, self.detail)))

    @property
    def numbers(self) -> dict[str, float]:
        """The measurement and the probability, by name."""
        return self.measurement.numbers | ({} if self.probability is None else {"probability": self.probability})

    def reject(self, reason: RejectReason, detail: str = "") -> None:
        """Set the reason why this is no closure."""
        self.reason, self.detail, self.closure = reason, detail, None
