"""Two camera views of one place: the pose between them from features that both see, and how well it is known.

Each feature of an image is measured as column, row and disparity, for that is where a camera's noise lives: half a
pixel of disparity is a centimetre near by and metres at the horizon. A feature of one view is carried over to the other
and compared there in pixels, weighed by what both measurements leave open. Where a depth came from elsewhere (LiDAR),
it is taken as if stereo had measured it, which is the careful side. A bias of all disparities, as of a rectification
that is not quite right, is estimated along with the pose; as far as the features leave it open, it widens the
covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Keyframe, LocalFeatures, Points, StereoCamera
from umf_ros.core.geometry import Array, invert, make_pose, rotation_angle, skew, transform
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
        sides = keyframe.camera.width * np.array([noise, noise, max(const.DISPARITY_NOISE, noise / 3)])
        return cls(keyframe.camera, sides, keyframe.body_T_camera, points, measured)

    @cached_property
    def lifted(self) -> Mask:
        """(N,) whose depths are known."""
        return np.asarray(np.isfinite(self.points).all(axis=1))

    def only(self, rows: Mask) -> CameraView:
        """The same with fewer features."""
        return CameraView(self.camera, self.noise, self.body_T_camera, self.points[rows], self.measured[rows])

    def predict(self, points: Array) -> tuple[Array, Array, Mask]:
        """Where this view should measure points (N, 3) of its body frame.

        Returns:
            (N, 3) column, row and disparity; their derivatives (N, 3, 3) by the points; (N,) what lies in front.
        """
        camera, rotation = self.camera, invert(self.body_T_camera)[:3, :3]
        optical = transform(invert(self.body_T_camera), points)
        front = optical[:, 2] > const.NEAREST_SEEN_M  # False for NaN
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
        """(N, 3, 3) m: roots of the covariances of the points, body frame, that the noise of their measurements makes.

        Zero where the depth is unknown.
        """
        _, derivative, front = self.predict(self.points)
        return np.where(front[:, None, None], np.linalg.inv(derivative) * self.noise, 0.0)


@dataclass(frozen=True, slots=True)
class ViewAlignment:
    """How a query's view lies on a match's.

    Attributes:
        pose: (4, 4) `match_T_query`.
        residuals: (P, 3) of the features that agree: column, row and disparity in standard deviations of their noise.
        jacobian: (P, 3, 7) of the residuals by (x y z rx ry rz) about the match axes at the query's origin, and by the
            bias of all disparities in its prior standard deviations.
        bias_px: estimated bias of all disparities, pixels; positive where stereo measures too little.
        pixels: (P, 4) of those features: column and row in the query's image and in the match's.
        size: (2,) width and height of the match's image.
        distance_m: median distance of the two points of a pair, where both depths are known; NaN without any.
        share: of the pairs with a depth, how many agree.
        two_way_m: distance of the poses that the query's depths and the match's give, each by themselves; inf without.
        two_way_rad: angle between them.
    """

    pose: Array
    residuals: Array
    jacobian: Array
    bias_px: float
    pixels: Array
    size: Array
    distance_m: float
    share: float
    two_way_m: float
    two_way_rad: float

    @property
    def information(self) -> Array:
        """Information (6, 6) of the residuals as if they were independent, whatever the bias of the disparities."""
        if not len(self.residuals):
            return np.zeros((6, 6))
        weight = _trust(self.residuals)
        whole = np.einsum("n,nki,nkj->ij", weight, self.jacobian, self.jacobian)
        whole = whole / max(self.spread_sigmas, const.MIN_VIEW_SIGMAS) ** 2
        found: Array = whole[:6, :6] - np.outer(whole[:6, 6], whole[6, :6]) / (whole[6, 6] + 1.0)
        return found

    @property
    def spread_sigmas(self) -> float:
        """Size of the residuals in standard deviations of the noise: 1 where the noise is as assumed."""
        return 1.4826 * float(np.median(np.abs(self.residuals[:, :2]))) if len(self.residuals) else float("inf")

    @property
    def spread(self) -> float:
        """How wide the features lie across the image: the smaller deviation of both directions, of its sides."""
        return float((self.pixels[:, 2:].std(axis=0) / self.size).min()) if len(self.pixels) > 1 else 0.0


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
    def forward(self) -> Array | None:
        """`match_T_query` from the query's points in the match's image."""
        return _locate(self.query, self.match)

    @cached_property
    def backward(self) -> Array | None:
        """`match_T_query` from the match's points in the query's image."""
        found = _locate(self.match, self.query)
        return None if found is None else invert(found)

    def any_pose(self) -> Array | None:
        """A pose that enough features agree with: a guess for what sees better than cameras."""
        # by the depths of whichever saw more of them; the other way round finds next to nothing more
        pose = self.forward if self.query.lifted.sum() >= self.match.lifted.sum() else self.backward
        return pose if self._agreeing(pose) >= const.MIN_PIXELS else None

    def best_pose(self) -> tuple[Array, int] | None:
        """The pose that more features agree with, and how many do; None where too few do."""
        counted = [(pose, self._agreeing(pose)) for pose in (self.forward, self.backward) if pose is not None]
        best = max(counted, key=lambda one: one[1], default=None)
        return best if best is not None and best[1] >= const.MIN_PIXELS else None

    def _agreeing(self, pose: Array | None) -> int:
        return 0 if pose is None else int(self._compare(pose).agreeing.sum())

    def align(self, guess: Array) -> ViewAlignment:
        """Refine the pose `guess` by what both views measured: Gauss-Newton on reprojections, outliers weighed down."""
        near = self._compare(guess).near
        nearby = PairedViews(self.query.only(near), self.match.only(near))
        pose = guess
        for _ in range(const.VIEW_STEPS):
            pose, moved = nearby._step(pose)
            if moved < const.VIEW_TOLERANCE:
                break
        fit = nearby._compare(pose)
        _, bias = _solve(fit)
        fit = fit.corrected(bias)
        agreeing = PairedViews(nearby.query.only(fit.agreeing), nearby.match.only(fit.agreeing))
        known = int((self.query.lifted | self.match.lifted).sum())
        return ViewAlignment(
            pose,
            fit.residuals[fit.agreeing],
            fit.jacobian[fit.agreeing],
            bias * const.DISPARITY_BIAS * self.match.camera.width,
            agreeing.pixels,
            np.array([self.match.camera.width, self.match.camera.height]),
            agreeing.distance(pose),
            float(fit.agreeing.sum()) / max(known, 1),
            *self._two_way(),
        )

    @property
    def pixels(self) -> Array:
        """(N, 4) column and row in the query's image and in the match's."""
        return np.hstack([self.query.measured[:, :2], self.match.measured[:, :2]])

    def consistent_pixels(self, pose: Array) -> Points:
        """Those (K, 4) float32 of the pairs that agree with a pose."""
        return self.pixels[self._compare(pose).agreeing].astype(np.float32)

    def distance(self, pose: Array) -> float:
        """Median distance (m) of the two points of a pair at a pose, where both depths are known; NaN without any."""
        both = self.query.lifted & self.match.lifted
        gaps = transform(pose, self.query.points[both]) - self.match.points[both]
        return float(np.median(np.linalg.norm(gaps, axis=1))) if len(gaps) else float("nan")

    def _two_way(self) -> tuple[float, float]:
        forward, backward = self.forward, self.backward
        if forward is None or backward is None:
            return float("inf"), float("inf")
        gap = invert(forward) @ backward
        return float(np.linalg.norm(gap[:3, 3])), rotation_angle(gap)

    def _step(self, pose: Array) -> tuple[Array, float]:
        """The pose one step on, and the largest part of the step."""
        step, _ = _solve(self._compare(pose))
        turn = Rotation.from_rotvec(step[3:]).as_matrix()
        return make_pose(turn @ pose[:3, :3], pose[:3, 3] + step[:3]), float(np.abs(step).max())

    def _compare(self, pose: Array) -> _Fit:
        """Residuals of all pairs at a pose: from the query's depth where it is known, else from the match's."""
        first = self.query.lifted
        arms = np.where(first[:, None], transform(pose, self.query.points), self.match.points) - pose[:3, 3]
        forth = _carry(self.query, self.match, pose, arms, first)
        back = _carry(self.match, self.query, invert(pose), arms, ~first, inverse=True)
        together = []
        for one, other in zip(forth, back, strict=True):
            both = np.empty((len(first), *one.shape[1:]), one.dtype)
            both[first], both[~first] = one, other
            together.append(both)
        return _Fit(*together)


@dataclass(frozen=True, slots=True)
class _Fit:
    """All pairs at a pose: residuals (N, 3) in standard deviations, Jacobian (N, 3, 7), and which can be used (N,)."""

    residuals: Array
    jacobian: Array
    usable: Mask

    def corrected(self, bias: float) -> _Fit:
        """The fit were all disparities off by so many prior standard deviations."""
        return _Fit(self.residuals + bias * self.jacobian[..., 6], self.jacobian, self.usable)

    @property
    def agreeing(self) -> Mask:
        """Nearer than what 99 % of right ones are."""
        return self.usable & ((self.residuals**2).sum(axis=1) < const.VIEW_GATE)

    @property
    def near(self) -> Mask:
        """Near enough to be drawn in."""
        return self.usable & ((self.residuals**2).sum(axis=1) < const.VIEW_NEAR)


def _solve(fit: _Fit) -> tuple[Array, float]:
    """Step (6,) of the pose and bias of the disparities, in prior standard deviations, with the least residuals."""
    bias = 0.0
    for _ in range(2):  # outliers are told by the residuals that the bias leaves
        weight = np.where(fit.usable, _trust(fit.corrected(bias).residuals), 0.0)
        normal = np.einsum("n,nki,nkj->ij", weight, fit.jacobian, fit.jacobian)
        slope = np.einsum("n,nki,nk->i", weight, fit.jacobian, fit.residuals)
        solution = -np.linalg.solve(normal + np.diag([1e-6] * 6 + [1.0]), slope)
        bias = float(solution[6])
    return solution[:6], bias


def _carry(
    source: CameraView, target: CameraView, pose: Array, arms: Array, rows: Mask, inverse: bool = False
) -> tuple[Array, Array, Mask]:
    """Residuals of some of the source's points in the target's measurements, `pose` being `target_T_source`.

    Args:
        source: view whose points are carried over.
        target: view they are compared with.
        pose: of the source's body in the target's.
        arms: (N, 3) from the query's origin to the points, match axes.
        rows: (N,) which points.
        inverse: whether the target is the query.
    """
    predicted, derivative, front = target.predict(transform(pose, source.points[rows]))
    usable = front & source.lifted[rows]
    scatter = derivative @ pose[:3, :3] @ source.scatter[rows]
    covariance = scatter @ scatter.transpose(0, 2, 1) + np.diag(target.noise**2)
    residual = predicted - target.measured[rows]
    unmeasured = ~np.isfinite(residual[:, 2])
    residual[unmeasured, 2] = 0.0
    covariance[unmeasured, 2, 2] += const.UNMEASURED
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    arms = np.where(usable[:, None], arms[rows], 0.0)
    motion = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -skew(arms)], axis=2)
    if inverse:
        motion = -pose[:3, :3] @ motion
    residual = np.where(usable[:, None], np.einsum("nij,nj->ni", whiten, residual), 0.0)
    # more disparity brings the source's point nearer and is added to the target's measurement
    shift = scatter[:, :, 2] / source.noise[2] - np.array([0.0, 0.0, 1.0])
    by_bias = np.einsum("nij,nj->ni", whiten, np.where(usable[:, None], shift, 0.0)) * const.DISPARITY_BIAS
    by_pose = whiten @ derivative @ motion
    return residual, np.concatenate([by_pose, by_bias[:, :, None] * target.camera.width], axis=2), usable


def _locate(source: CameraView, target: CameraView) -> Array | None:
    """`target_T_source` of the bodies from the source's points in the target's image (P3P in RANSAC), or None."""
    known = source.lifted
    if known.sum() < const.MIN_PIXELS:
        return None
    camera = target.camera
    options = cv2.UsacParams()
    options.threshold = const.VIEW_REACH * float(target.noise[0])
    options.maxIterations = const.VIEW_SAMPLES
    options.confidence = 0.999
    options.isParallel = False  # the same on every machine
    options.score = cv2.SCORE_METHOD_MSAC
    options.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    found, _, rotation, translation, _ = cv2.solvePnPRansac(
        source.points[known],
        np.ascontiguousarray(target.measured[known, :2]),
        np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]]),
        None,
        params=options,
    )
    if not found:
        return None
    pose = target.body_T_camera @ make_pose(cv2.Rodrigues(rotation)[0], translation.ravel())
    # P3P on a degenerate view can succeed with numbers that are none
    return pose if np.isfinite(pose).all() else None


def _trust(residuals: Array) -> Array:
    """(N,) weights: whatever is many standard deviations off counts next to nothing (Geman-McClure)."""
    found: Array = 1.0 / (1.0 + (residuals**2).sum(axis=1) / const.VIEW_KERNEL) ** 2
    return found


def _disparity(camera: StereoCamera, depth: Array) -> Array:
    return camera.fx * (camera.baseline or const.NOMINAL_BASELINE_M) / depth
