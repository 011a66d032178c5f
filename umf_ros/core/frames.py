"""Records of the pipeline, from sensor data to loop closures.

Stamps are integer nanoseconds since the epoch. The body frame is REP-103 (x forward, y left,
z up), the camera frame is optical (x right, y down, z forward). Poses follow `geometry`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, invert, relative, transform

Image = NDArray[np.uint8]
Points = NDArray[np.float32]
WORDS_WEIGHT = 0.54
"""Cosine similarity of the network that one unit of the similarity by words is worth (`umf_ros.lab.fit.words`)."""


def combine(similarity: Any, words: Any) -> Any:
    """Return similarities by the network and by words as one, in the unit of the network's."""
    return similarity + WORDS_WEIGHT * words


class State(StrEnum):
    """State of a closure or of an absolute measurement in the pose graph."""

    ACCEPTED = "accepted"
    PENDING = "pending"
    REJECTED = "rejected"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class StereoCamera:
    """A rectified pinhole pair: pixels, and metres for the baseline (0 when there is no right camera).

    Pixel (0, 0) is the centre of the upper left pixel, as in ROS and OpenCV.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float

    def project(self, points: Array, body_T_camera: Array) -> tuple[Array, Array]:
        """Return left pixels (N, 2) and depths (N,) m of points (N, 3), body frame; depths <= 0: behind the camera."""
        optical = transform(invert(body_T_camera), points)
        depth = optical[:, 2]
        safe = np.where(depth > 0, depth, 1.0)
        u = self.fx * optical[:, 0] / safe + self.cx
        v = self.fy * optical[:, 1] / safe + self.cy
        return np.column_stack([u, v]), depth


@dataclass(frozen=True, slots=True)
class ScanMotion:
    """The motion during a scan, which was removed from its points, and its uncertainty.

    Attributes:
        moments_s: (N,) float32, s after the frame's stamp, one for every point.
        rates: (6,) x y z rx ry rz, m/s and rad/s about the body's axes.
        noise: (6,) m^2/s and rad^2/s: the variance that the odometry's error gains in a second.
        removed: whether the motion during each scan was removed; else only that between merged scans was.
        body_T_lidars: (K, 4, 4) poses of the LiDAR at the scans that were merged into one, in order of time;
            empty for a single scan.
        scans: K times (N, 3) float32 m, all points of these scans, body frame.
    """

    moments_s: Points
    rates: Array
    noise: Array
    removed: bool = True
    body_T_lidars: Array = field(default_factory=lambda: np.empty((0, 4, 4)))
    scans: tuple[Points, ...] = ()

    @classmethod
    def none(cls, count: int) -> ScanMotion:
        """Return the motion of `count` points taken from one place, or whose motion is known exactly."""
        return cls(np.zeros(count, np.float32), np.zeros(6), np.zeros(6))


@dataclass(frozen=True, slots=True)
class Frame:
    """One synchronised set of measurements; either modality may be missing, never both.

    Attributes:
        stamp_ns: time of the LiDAR scan (of the image where there is no scan); the frame's key.
        body_T_camera: pose of the left camera at its exposure in the body frame at `stamp_ns`.
        left, right: (H, W) uint8, rectified.
        points: (N, 3) float32, metres, body frame at `stamp_ns` (motion removed), real returns only.
        intensity: (N,) float32, the sensor's unit.
        odom_T_body: odometry at `stamp_ns`.
        image_stamp_ns: exposure of the left image.
        session: counts the resets of the clock or the odometry.
        motion: during the scan; None where it was not removed, without odometry or times per point.
        offsets_s: (N,) float32, s from `stamp_ns` to each point where motion was not removed; None without times.
    """

    stamp_ns: int
    camera: StereoCamera
    body_T_camera: Array
    body_T_lidar: Array
    left: Image | None = None
    right: Image | None = None
    points: Points | None = None
    intensity: Points | None = None
    odom_T_body: Array | None = None
    image_stamp_ns: int | None = None
    session: int = 0
    motion: ScanMotion | None = None
    offsets_s: Points | None = None


@dataclass(frozen=True, slots=True)
class LocalFeatures:
    """K salient local features of one modality [UMF 4.4], strongest first.

    Attributes:
        positions: (K, 2) float32 pixels of the left image, or (K, 3) float32 metres in the body frame.
        descriptors: (K, D) float16, L2-normalised.
        saliency: (K,) float32, larger is more salient.
        points: (K, 3) float32 metres in the body frame, NaN where the depth is unknown.
    """

    positions: Points
    descriptors: NDArray[np.float16]
    saliency: Points
    points: Points


@dataclass(frozen=True, slots=True)
class SuperFeatures:
    """The ordered super-features of one modality [UMF 4.3]; the row is the feature's ID.

    Attributes:
        descriptors: (N, D) float16, L2-normalised.
        strength: (N,) float32, norm before the normalisation.
    """

    descriptors: NDArray[np.float16]
    strength: Points


@dataclass(frozen=True, slots=True)
class Embedding:
    """The network's description of one frame: a global descriptor and the features of each modality that it has.

    The descriptor is (D,) float32, L2-normalised; similarity is the dot product. The scene is (N, C) int8, the
    directions of the cells of the image trunk's deepest map, or without an image of the tokens of the scan, for
    `umf_ros.places.words`.
    """

    descriptor: NDArray[np.float32]
    image: LocalFeatures | None = None
    cloud: LocalFeatures | None = None
    super_image: SuperFeatures | None = None
    super_cloud: SuperFeatures | None = None
    scene: NDArray[np.int8] | None = None


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A stored place with the data that retrieval and verification need.

    Attributes:
        stamp_ns: the frame's key.
        embedding: descriptor and local features, lifted to 3-D where a depth is known.
        points: (M, 3) float32 metres in the body frame: the scan, thinned for registration; may be empty.
        odom_T_body: odometry at the stamp, or None.
        path_length_m: metres driven since the start of the session, NaN without odometry.
        motion: during the scan, one moment for every thinned point; None where it was not removed.
    """

    stamp_ns: int
    embedding: Embedding
    camera: StereoCamera
    body_T_camera: Array
    points: Points
    odom_T_body: Array | None = None
    path_length_m: float = float("nan")
    session: int = 0
    body_T_lidar: Array = field(default_factory=lambda: np.eye(4))
    motion: ScanMotion | None = None

    @property
    def has_depth(self) -> bool:
        """Whether a scan or a stereo pair measured depth; two keyframes without it give no metric pose."""
        image = self.embedding.image
        return len(self.points) > 0 or (image is not None and bool(np.isfinite(image.points).any()))

    def pose_of(self, other: Keyframe) -> Array | None:
        """Return the pose (4, 4) of another keyframe in this one by odometry; None without, and in another session."""
        if self.session != other.session or self.odom_T_body is None or other.odom_T_body is None:
            return None
        return relative(self.odom_T_body, other.odom_T_body)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A keyframe of the database that is similar to the query.

    Attributes:
        index: row in the database.
        stamp_ns: key of the candidate keyframe.
        similarity: cosine similarity of the global descriptors.
        words: similarity by the words of the database; 0 where it was not compared.
        inliers_image: pairs of image features that one homography explains; NaN before the reranking.
        inliers_cloud: pairs of the scan's features that one rigid motion explains; NaN before the reranking.
        score: of the reranking, larger is better.
    """

    index: int
    stamp_ns: int
    similarity: float
    inliers_image: float = math.nan
    inliers_cloud: float = math.nan
    score: float = 0.0
    words: float = 0.0

    @property
    def combined(self) -> float:
        """Both similarities as one, in the unit of the cosine similarity."""
        return combine(self.similarity, self.words)


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """A verified metric constraint between two keyframes: `x_query = x_match @ match_T_query`.

    Attributes:
        query_stamp_ns: key of the query keyframe, the later one.
        match_stamp_ns: key of the matched keyframe.
        match_T_query: pose of the query body in the match body frame.
        covariance: (6, 6) in ROS order (x y z rx ry rz, axes of the match body), m^2 and rad^2.
        probability: calibrated probability that the closure is right, NaN where it is unknown.
    """

    query_stamp_ns: int
    match_stamp_ns: int
    match_T_query: Array
    covariance: Array
    probability: float = float("nan")

    @property
    def endpoints(self) -> tuple[int, int]:
        """Stamps in ns of query and match, which identify a closure of a run."""
        return self.query_stamp_ns, self.match_stamp_ns

    @property
    def pair(self) -> tuple[int, int]:
        """Stamps in ns of match and query, as decisions by hand name a closure."""
        return self.match_stamp_ns, self.query_stamp_ns


@dataclass(frozen=True, slots=True)
class GraphState:
    """State of a pose graph at one moment.

    Attributes:
        map_T_odom: (4, 4) pose of the odometry's frame in the map; None while it is unknown.
        covariance: (6, 6) of the newest pose in ROS order, axes of the map.
        newest_ns: stamp of the newest odometry of the running session, -1 before its first.
        counts: of messages, and of closures and absolute measurements by state, with faults of their sources.
        unsettled: whether the graph was written before it was settled.
        probability: of the pose in a fixed map; None for a graph.
    """

    map_T_odom: Array | None
    covariance: Array
    newest_ns: int
    counts: Mapping[str, object]
    unsettled: bool
    probability: float | None
