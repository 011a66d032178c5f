"""The record of one hypothesis: a candidate, a pose for it, its measurements and the decision."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from umf_ros.core.frames import Candidate, Keyframe, LoopClosure, Points
from umf_ros.core.geometry import Array, near
from umf_ros.verification import constants as const

if TYPE_CHECKING:
    from umf_ros.verification.prepared_scan import PreparedScan
    from umf_ros.verification.scan_alignment import Alignment
    from umf_ros.verification.view_alignment import PairedViews, ViewAlignment

ACCEPTED = "accepted"
SCAN, SUBMAP, IMAGE = "scan", "submap", "image"


class RejectReason(Enum):
    """Why a candidate became no loop closure, as a sentence; `Hypothesis.detail` has the figures."""

    NOT_COMPARED = "not compared: a closure was found"
    NOT_SELECTED = "less promising than others"
    NO_DEPTH = "no depth: neither a scan nor a stereo pair"
    NO_POSE = "no pose fits"
    IMPROBABLE = "probability below verification.min_probability"
    PASSAGE = "surfaces fit as well elsewhere along the passage"
    AMBIGUOUS = "another pose fits as well"
    WALLS_ALONE = "both scans show the same walls and nothing else, as many places do"
    REPEATED_IMAGE = "both images are the same to the last digit: the camera repeats its image"
    UNEXPLAINED = "too much of what stands in one submap is missing in the other"
    OUT_OF_RANGE = "a measurement outside the range of the fitted examples"
    TURNED = "turned by more than verification.max_turn_deg"
    TOO_FAR = "farther apart than verification.max_shift_m"
    LESS_PROBABLE = "a more probable closure of this keyframe is published"
    UNCONFIRMED = "pending: no closure of another place agrees yet"
    SENSORS = "withheld: the sensors contradict each other"
    UNKNOWN = "rejected by another version"


@dataclass(slots=True, eq=False)
class Hypothesis:
    """One pose for one candidate, filled in as it is tested.

    A candidate that got no pose has a hypothesis without one, so that every candidate has a reason.

    Attributes:
        query_stamp_ns: key of the query keyframe.
        candidate: the candidate.
        measurements: results of the tests by name (`MEASUREMENTS` in `measurement`); of the candidate alone without
            a pose.
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
    measurements: dict[str, float] = field(default_factory=dict)
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
        return cls(query.stamp_ns, candidate, measurements_of(candidate), keyframes=(query, match), **known)

    @property
    def kind(self) -> str:
        """How the pose was measured: `SCAN`, `SUBMAP`, `IMAGE`, or empty without a pose."""
        return kind_of(self.measurements)

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
    def doubtful(self) -> bool:
        """Whether it is a closure of single scans that submaps decide, where there are any."""
        return self.accepted and self.kind == SCAN and (self.probability or 0.0) < 1.0 - const.PROMISING

    @property
    def outcome(self) -> str:
        """A short phrase for a person: "accepted", or the reason with its figures."""
        if self.reason is None:
            return ACCEPTED
        return ": ".join(filter(None, (self.reason.value, self.detail)))

    @property
    def numbers(self) -> dict[str, float]:
        """The measurements and the probability, by name."""
        return self.measurements | ({} if self.probability is None else {"probability": self.probability})

    def reject(self, reason: RejectReason, detail: str = "") -> None:
        """Set the reason why this is no closure."""
        self.reason, self.detail, self.closure = reason, detail, None


def same_pose(a: Array, b: Array) -> bool:
    """Return whether an alignment that begins at either of two poses (4, 4) ends at the same."""
    return near(a, b, const.DISTINCT_M, const.DISTINCT_RAD)


def measurements_of(candidate: Candidate) -> dict[str, float]:
    """Return the measurements of a candidate, which no pose changes."""
    names = ("similarity", "inliers_image", "inliers_cloud")
    return known_only({name: float(getattr(candidate, name)) for name in names})


def known_only(measurements: dict[str, float]) -> dict[str, float]:
    """Return the measurements without those that are NaN."""
    return {name: value for name, value in measurements.items() if not math.isnan(value)}


def kind_of(measurements: dict[str, float]) -> str:
    """Return the kind of what was aligned: `SCAN`, `SUBMAP` or, without scans, `IMAGE`; empty without a pose."""
    if "noise_m" in measurements:
        return SUBMAP if measurements.get("merged", 1.0) > 1 else SCAN
    return IMAGE if "pose_inliers" in measurements else ""
