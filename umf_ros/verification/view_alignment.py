"""Two camera views of one place: the pose between them from features that both see, and its information.

Each feature of an image is measured as column, row and disparity, in which a camera's noise is even: half a pixel of
disparity is a centimetre near by and metres at the horizon. The view in which more depths are known is the source: its
points are carried over to the other view, the target, and compared there in pixels, weighted by the noise of both
measurements. Where a depth came from a LiDAR, it is taken as if stereo had measured it, which is the careful side. A
bias of all disparities, as of an imprecise rectification, is estimated along with the pose; as far as the features
leave it open, it widens the covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Keyframe, LocalFeatures, Points, StereoCamera
from umf_ros.core.geometry import Array, invert, make_pose, relative, skew, transform
from umf_ros.verification import constants as const
from umf_ros.verification.rerank import mutual_neighbours, similarities

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CameraView:
    """Features of one image, row by row those of the other view.

    Attributes:
        camera: intrinsics.
        noise: (3,) standard deviations of a measurement, pixels.
        body_T_camera: pose of the camera.
        points: (N, 3) m, body frame, NaN where the depth is unknown.
        measured: (N, 3) column, row and disparity in pixels; likewise.
    """

    camera: StereoCamera
    noise: Array
    body_T_camera: Array
    points: Array
    measured: Array

    @classmethod
    def of(cls, keyframe: Keyframe, features: LocalFeatures, rows: NDArray[np.intp], noise: float) -> CameraView:
        """The view of a keyframe with some of its features, whose places are known to `noise` of the width."""
        points = features.points[rows].astype(float)
        disparity = _disparity(keyframe.camera, keyframe.camera.project(points, keyframe.body_T_camera)[1])
        measured = np.column_stack([features.positions[rows].astype(float), disparity])
        sides = keyframe.camera.width * np.array([noise, noise, noise / 3])
        return cls(keyframe.camera, sides, keyframe.body_T_camera, points, measured)

    @cached_property
    def lifted(self) -> Mask:
        """(N,) whose depths are known."""
        return np.asarray(np.isfinite(self.points).all(axis=1))

    def predict(self, points: Array) -> tuple[Array, Array, Mask]:
        """Where this view should measure points (N, 3) of its body frame.

        Returns:
            (N, 3) column, row and disparity; their derivatives (N, 3, 3) by the points; (N,) what lies in front.
        """
        camera, rotation = self.camera, invert(self.body_T_camera)[:3, :3]
        optical = transform(invert(self.body_T_camera), points)
        front = optical[:, 2] > const.SIGHT_FROM_M  # False for NaN
        x, y, z = np.where(front[:, None], optical, 1.0).T
        zero = np.zeros_like(z)
        disparity = _disparity(camera, z)
        predicted = np.column_stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, disparity])
        across = np.stack([camera.fx / z, zero, -camera.fx * x / z**2], axis=1)
        down = np.stack([zero, camera.fy / z, -camera.fy * y / z**2], axis=1)
        deep = np.stack([zero, zero, -disparity / z], axis=1)
        return predicted, np.stack([across, down, deep], axis=1) @ rotation, front

    @cached_property
    def scatter(self) -> Array:
        """(N, 3, 3) m: roots of the covariances of the points, body frame; zero where the depth is unknown."""
        _, derivative, front = self.predict(self.points)
        return np.where(front[:, None, None], np.linalg.inv(derivative) * self.noise, 0.0)

    def locate(self, other: CameraView) -> Array | None:
        """`other_T_self` of the bodies from the points of this view in the other's image (P3P in RANSAC), or None."""
        if self.lifted.sum() < const.MIN_PIXELS:
            return None
        camera = other.camera
        options = cv2.UsacParams()
        options.threshold = float(np.sqrt(const.VIEW_GATE) * other.noise[0])
        options.maxIterations = const.VIEW_SAMPLES
        options.confidence = 0.999
        options.isParallel = False  # the same on every machine
        options.score = cv2.SCORE_METHOD_MSAC
        options.loMethod = cv2.LOCAL_OPTIM_INNER_LO
        found, _, rotation, translation, _ = cv2.solvePnPRansac(
            self.points[self.lifted],
            np.ascontiguousarray(other.measured[self.lifted, :2]),
            np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]]),
            None,
            params=options,
        )
        if not found:
            return None
        pose = other.body_T_camera @ make_pose(cv2.Rodrigues(rotation)[0], translation.ravel())
        # P3P on a degenerate view can succeed with numbers that are none
        return pose if np.isfinite(pose).all() else None


@dataclass(frozen=True, slots=True)
class ViewAlignment:
    """How a query's view lies on a match's.

    Attributes:
        pose: (4, 4) `match_T_query`.
        residuals: (P, 3) of the features that agree: column, row and disparity in standard deviations of their noise.
        jacobian: (P, 3, 7) of the residuals by (x y z rx ry rz) about the match axes at the query's origin, and by the
            bias of all disparities in its prior standard deviations.
        bias_px: estimated bias of all disparities, pixels; positive where stereo measures too little.
        bias_prior_px: its standard deviation before the views are compared.
        spread: how wide the features lie across the match's image: the smaller deviation of both directions, as a
            share of its width and height.
        distance_m: median distance of the two points of a pair, where both depths are known; NaN without any.
        share: of the pairs with a depth, how many agree.
        two_way_m: distance of the poses that the query's depths and the match's give, each by themselves; NaN without.
    """

    pose: Array
    residuals: Array
    jacobian: Array
    bias_px: float
    bias_prior_px: float
    spread: float
    distance_m: float
    share: float
    two_way_m: float

    @property
    def information(self) -> Array:
        """Information (6, 6) of the residuals as if they were independent, whatever the bias of the disparities."""
        if not len(self.residuals):
            return np.zeros((6, 6))
        whole = self._normal / self.spread_sigmas**2
        return np.asarray(whole[:6, :6] - np.outer(whole[:6, 6], whole[6, :6]) / (whole[6, 6] + 1.0))

    @property
    def measured_bias_px(self) -> tuple[float, float]:
        """Bias of all disparities by these features alone, without its prior, and its standard deviation, pixels.

        From one place and direction a bias looks the same in both views, and its standard deviation is large. NaN where
        the features do not tell it.
        """
        whole = self._normal
        known = whole[6, 6] - whole[6, :6] @ np.linalg.lstsq(whole[:6, :6], whole[:6, 6], rcond=None)[0]
        if not known > 0:
            return math.nan, math.nan
        return self.bias_px * (1.0 + 1.0 / known), self.bias_prior_px * self.spread_sigmas / math.sqrt(known)

    @property
    def _normal(self) -> Array:
        """(7, 7) normal matrix of the residuals."""
        return np.asarray(np.einsum("n,nki,nkj->ij", _weight(self.residuals), self.jacobian, self.jacobian))

    @property
    def spread_sigmas(self) -> float:
        """Size of the residuals in standard deviations of the noise: 1 where the noise is as assumed."""
        return 1.4826 * float(np.median(np.abs(self.residuals[:, :2]))) if len(self.residuals) else float("inf")


@dataclass(frozen=True)
class PairedViews:
    """A query's and a match's view, row by row features that look alike."""

    query: CameraView
    match: CameraView

    @classmethod
    def of(cls, query: Keyframe, match: Keyframe, noise: float) -> PairedViews | None:
        """Mutual neighbours among all image features of both; None without images or with next to no pairs.

        Args:
            query: one keyframe.
            match: the other.
            noise: standard deviation of a feature's place, of the image's width.
        """
        ours, theirs = query.embedding.image, match.embedding.image
        if ours is None or theirs is None:
            return None
        pairs = mutual_neighbours(similarities(ours.descriptors, theirs.descriptors))
        if len(pairs) < const.MIN_PIXELS:
            return None
        return cls(CameraView.of(query, ours, pairs[:, 0], noise), CameraView.of(match, theirs, pairs[:, 1], noise))

    @cached_property
    def _from_query(self) -> bool:
        """Whether the query is the source."""
        return bool(self.query.lifted.sum() >= self.match.lifted.sum())

    @property
    def _bias_prior_px(self) -> float:
        """Standard deviation of the bias of the target's disparities before the views are compared, pixels."""
        return const.DISPARITY_BIAS * (self.match if self._from_query else self.query).camera.width

    @cached_property
    def forward(self) -> Array | None:
        """`match_T_query` from the query's points in the match's image."""
        return self.query.locate(self.match)

    @cached_property
    def backward(self) -> Array | None:
        """`match_T_query` from the match's points in the query's image."""
        found = self.match.locate(self.query)
        return None if found is None else invert(found)

    def best_pose(self) -> tuple[Array, int] | None:
        """The pose that more features agree with, and how many do; None where too few do."""
        poses = [pose for pose in (self.forward, self.backward) if pose is not None]
        counted = [(pose, int(self._compare(pose).agreeing.sum())) for pose in poses]
        best = max(counted, key=lambda one: one[1], default=None)
        return best if best is not None and best[1] >= const.MIN_PIXELS else None

    def consistent_pixels(self, pose: Array) -> Points:
        """Pixels (K, 4) float32 in the query's and in the match's image of the pairs that agree with a pose."""
        pixels = np.hstack([self.query.measured[:, :2], self.match.measured[:, :2]])
        return pixels[self._compare(pose).agreeing].astype(np.float32)

    def align(self, guess: Array) -> ViewAlignment:
        """Refine the pose `guess` by Gauss-Newton on reprojections, outliers weighted down."""
        pose = guess
        for _ in range(const.STEPS):
            step, _ = _solve(self._compare(pose))
            turn = Rotation.from_rotvec(step[3:]).as_matrix()
            pose = make_pose(turn @ pose[:3, :3], pose[:3, 3] + step[:3])
        fit = self._compare(pose)
        bias = _solve(fit)[1]
        fit = fit.without_bias(bias)
        agree = fit.agreeing
        both = agree & self.query.lifted & self.match.lifted
        gaps = transform(pose, self.query.points[both]) - self.match.points[both]
        return ViewAlignment(
            pose,
            fit.residuals[agree],
            fit.jacobian[agree],
            bias * self._bias_prior_px,
            self._bias_prior_px,
            self._spread(agree),
            float(np.median(np.linalg.norm(gaps, axis=1))) if len(gaps) else float("nan"),
            float(agree.sum()) / max(int((self.query.lifted | self.match.lifted).sum()), 1),
            self._two_way_m(),
        )

    def _two_way_m(self) -> float:
        if self.forward is None or self.backward is None:
            return float("nan")
        return float(np.linalg.norm(relative(self.forward, self.backward)[:3, 3]))

    def _spread(self, agree: Mask) -> float:
        size = self.match.camera.width, self.match.camera.height
        return float((self.match.measured[agree, :2].std(axis=0) / size).min()) if agree.sum() > 1 else 0.0

    def _compare(self, pose: Array) -> _Fit:
        """Residuals at `match_T_query` of all pairs whose depth is known to the source."""
        source, target = (self.query, self.match) if self._from_query else (self.match, self.query)
        target_T_source = pose if self._from_query else invert(pose)
        predicted, derivative, front = target.predict(transform(target_T_source, source.points))
        usable = front & source.lifted
        scatter = derivative @ target_T_source[:3, :3] @ source.scatter
        covariance = scatter @ scatter.transpose(0, 2, 1) + np.diag(target.noise**2)
        residual = np.where(usable[:, None], predicted - target.measured, 0.0)
        unmeasured = ~np.isfinite(residual[:, 2])
        residual[unmeasured, 2] = 0.0
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        whiten[unmeasured, 2] = 0.0  # a disparity that was not measured says nothing
        arms = np.where(usable[:, None], source.points, 0.0) @ target_T_source[:3, :3].T
        by_pose = derivative @ np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -skew(arms)], axis=2)
        if not self._from_query:  # errors of `match_T_query` as errors of its inverse
            back = pose[:3, :3].T
            by_pose = by_pose @ -np.block([[back, back @ skew(pose[:3, 3])], [np.zeros((3, 3)), back]])
        # more disparity brings the source's point nearer and is added to the target's measurement
        by_bias = scatter[:, :, 2] / source.noise[2] - np.array([0.0, 0.0, 1.0])
        by_bias = np.where(usable[:, None], by_bias, 0.0) * self._bias_prior_px
        jacobian = whiten @ np.concatenate([by_pose, by_bias[:, :, None]], axis=2)
        return _Fit(np.einsum("nij,nj->ni", whiten, residual), jacobian, usable)


@dataclass(frozen=True, slots=True)
class _Fit:
    """All pairs at a pose: residuals (N, 3) in standard deviations, Jacobian (N, 3, 7), and which can be used (N,)."""

    residuals: Array
    jacobian: Array
    usable: Mask

    def without_bias(self, bias: float) -> _Fit:
        """The fit were all disparities off by so many prior standard deviations."""
        return _Fit(self.residuals + bias * self.jacobian[..., 6], self.jacobian, self.usable)

    @property
    def agreeing(self) -> Mask:
        """(N,) nearer than 99 % of right ones are."""
        return self.usable & ((self.residuals**2).sum(axis=1) < const.VIEW_GATE)


def _solve(fit: _Fit) -> tuple[Array, float]:
    """Step (6,) of the pose and bias of the disparities, in prior standard deviations, with the least residuals."""
    bias = 0.0
    for _ in range(2):  # outliers are told by the residuals that the bias leaves
        weight = np.where(fit.usable, _weight(fit.without_bias(bias).residuals), 0.0)
        normal = np.einsum("n,nki,nkj->ij", weight, fit.jacobian, fit.jacobian)
        slope = np.einsum("n,nki,nk->i", weight, fit.jacobian, fit.residuals)
        solution = -np.linalg.solve(normal + np.diag([1e-6] * 6 + [1.0]), slope)
        bias = float(solution[6])
    return solution[:6], bias


def _weight(residuals: Array) -> Array:
    """(N,) weights: residuals of many standard deviations count next to nothing (Geman-McClure)."""
    return np.asarray(1.0 / (1.0 + (residuals**2).sum(axis=1) / const.VIEW_GATE) ** 2)


def _disparity(camera: StereoCamera, depth: Array) -> Array:
    return camera.fx * (camera.baseline or const.NOMINAL_BASELINE_M) / depth
