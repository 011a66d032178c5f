"""Routes of the rover over a world, and passes over one route."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.camera import Sun
from umf_ros.lab.simulation.relief import Relief, smooth_step

WHEELBASE_M, TRACK_M = 1.2, 0.9


def stand(relief: Relief, x: ArrayLike, y: ArrayLike, yaw: ArrayLike, tilt: Array | None = None) -> Array:
    """Poses of base_link on its four wheels.

    Args:
        relief: the ground.
        x: (N,) m, world frame.
        y: (N,) m.
        yaw: (N,) heading, rad from the x axis.
        tilt: (N, 2) roll and pitch added to the ground's (springs, stones), rad.

    Returns:
        (N, 4, 4) `world_T_body`.
    """
    x, y, yaw = (np.atleast_1d(np.asarray(value, float)) for value in (x, y, yaw))
    forward = np.stack([np.cos(yaw), np.sin(yaw)], -1) * WHEELBASE_M / 2
    left = np.stack([-np.sin(yaw), np.cos(yaw)], -1) * TRACK_M / 2
    centre = np.stack([x, y], -1)
    wheels = np.stack([centre + a * forward + b * left for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))])
    fl, fr, rl, rr = relief.height(wheels[..., 0], wheels[..., 1])
    pitch = -np.arctan2(fl + fr - rl - rr, 2 * WHEELBASE_M)
    roll = np.arctan2(fl + rl - fr - rr, 2 * TRACK_M)
    if tilt is not None:
        roll, pitch = roll + tilt[:, 0], pitch + tilt[:, 1]
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], -1)).as_matrix()
    poses[:, :3, 3] = np.stack([x, y, (fl + fr + rl + rr) / 4], -1)
    return poses


STEP_M = 0.25
NIGHT = "night"
"""Label of a way that is driven after sunset."""
_EASE_M = 6.0


@dataclass(frozen=True, slots=True)
class Route:
    """A path with a heading.

    Attributes:
        path: (N, 2) places, m.
        yaw: (N,) heading of the rover, rad; near the direction of the path.
        travelled: (N,) metres along the path.
        labels: (N,) what makes each place a revisit: first, offset, opposite or crossing; or what is special there.
    """

    path: Array
    yaw: Array
    path_length: Array
    labels: list[str]

    @property
    def length_m(self) -> float:
        """Length of the path."""
        return float(self.path_length[-1])

    def at(self, metres: Array) -> tuple[Array, Array]:
        """(N, 2) places and (N,) headings, rad, at metres along the route."""
        path = np.stack([np.interp(metres, self.path_length, values) for values in self.path.T], 1)
        return path, np.interp(metres, self.path_length, np.unwrap(self.yaw))

    def legs(self) -> list[tuple[str, float, float]]:
        """Label, first and last metre of each part."""
        legs: list[tuple[str, float, float]] = []
        for label, metre in zip(self.labels, self.path_length, strict=True):
            start = legs.pop()[1] if legs and legs[-1][0] == label else float(metre)
            legs.append((label, start, float(metre)))
        return legs


class Walker:
    """Lays a route along a closed trail, move by move."""

    def __init__(self, trail: Array, rng: np.random.Generator) -> None:
        self._points, self._heading = resample(trail, STEP_M)
        self._rng = rng
        self._at, self._direction, self._offset = 0, 1, 0.0
        self._path: list[Array] = []
        self._labels: list[str] = []
        self._visited = np.zeros(len(self._points), bool)

    def forward(self, length_m: float, lateral_m: float = 0.0, label: str = "") -> Walker:
        """Follow the trail, up to `lateral_m` beside it; without a label, it is told by whether the place is new."""
        count = round(length_m / STEP_M)
        ease = smooth_step(np.arange(count) * STEP_M, 0, _EASE_M)
        waves = np.arange(count) * STEP_M / 45 * 2 * np.pi
        wobble = sum(np.sin(k * waves + self._rng.uniform(0, 2 * np.pi)) for k in (1, 2.3)) / 2
        offset = self._offset * (1 - ease) + lateral_m * wobble * ease
        index = (self._at + self._direction * np.arange(count)) % len(self._points)
        normal = np.stack([-np.sin(self._heading[index]), np.cos(self._heading[index])], 1)
        again = "offset" if self._direction > 0 else "opposite"
        self._append(self._points[index] + offset[:, None] * normal)
        fresh = ~self._visited[index]
        fresh &= np.isin(np.arange(count), np.unique(index, return_index=True)[1])  # a move may be longer than a lap
        self._labels += [label or ("first" if new else again) for new in fresh]
        self._visited[index] = True
        self._at, self._offset = int(index[-1] + self._direction) % len(self._points), float(offset[-1])
        return self

    def turn_back(self, radius_m: float = 2.5) -> Walker:
        """A narrow turn towards the trail; what follows is driven in the opposite direction."""
        place, ahead = self._pose()
        side = np.array([-ahead[1], ahead[0]])
        left = 1.0 if self._offset * self._direction <= 0 else -1.0
        angle = np.linspace(0, np.pi, max(round(np.pi * radius_m / STEP_M), 2))[1:, None]
        self._append(place + radius_m * (np.sin(angle) * ahead + left * (1 - np.cos(angle)) * side))
        self._labels += ["opposite"] * len(angle)
        self._offset += 2 * radius_m * left * self._direction
        self._direction *= -1
        self._at = int(self._at + self._direction) % len(self._points)
        return self

    def cross(self, distance_m: float) -> Walker:
        """Leave the trail to the inside, cross it `distance_m` further on and come back to it from outside."""
        place, ahead = self._pose()
        crossing = int(self._at + self._direction * distance_m / STEP_M) % len(self._points)
        joining = int(crossing + self._direction * 24 / STEP_M) % len(self._points)
        outward = np.array([np.sin(self._heading[crossing]), -np.cos(self._heading[crossing])])
        onward = self._direction * self._along(crossing)
        middle = 0.5 * (place + 6 * ahead + self._points[crossing] - 10 * outward)
        corners = [
            place,
            place + 6 * ahead,
            middle,
            self._points[crossing],
            self._points[crossing] + 9 * outward + 9 * onward,
            self._points[joining],
        ]
        lengths = metres_along(np.array(corners))
        end = self._direction * self._along(joining)
        curve = CubicSpline(lengths, np.array(corners), bc_type=((1, ahead), (1, end)))
        points = curve(np.arange(STEP_M, lengths[-1], STEP_M))
        self._append(points)
        self._labels += ["crossing"] * len(points)
        self._at, self._offset = joining, 0.0
        return self

    def over(self, trail: Array) -> Walker:
        """Leave the trail for another one, and join it where that takes the least turning."""
        place, ahead = self._pose()
        points, heading = resample(trail, STEP_M)
        along = np.stack([np.cos(heading), np.sin(heading)], 1)
        way = points - place
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        joining = int((along * way).sum(axis=1).argmax())
        corners = np.array([place, place + 4 * ahead, points[joining] - 4 * along[joining], points[joining]])
        lengths = metres_along(corners)
        curve = CubicSpline(lengths, corners, bc_type=((1, ahead), (1, along[joining])))
        between = curve(np.arange(STEP_M, lengths[-1], STEP_M))
        self._append(between)
        self._labels += ["first"] * len(between)
        self._points, self._heading = points, heading
        self._visited = np.zeros(len(points), bool)
        self._at, self._direction, self._offset = joining, 1, 0.0
        return self

    def route(self, swing_deg: float, length_m: float | None = None) -> Route:
        """The route so far, its heading swinging to both sides of the path.

        Args:
            swing_deg: how far, deg.
            length_m: cut here; None keeps all.
        """
        path = gaussian_filter1d(np.concatenate(self._path), 4, axis=0, mode="nearest")
        path_length = metres_along(path)
        keep = slice(0, int(np.searchsorted(path_length, length_m or np.inf)) + 1)
        yaw = np.unwrap(direction(path))
        swing = np.sin(path_length * 2 * np.pi / 37 + self._rng.uniform(0, 2 * np.pi))
        swing += 0.5 * np.sin(path_length * 2 * np.pi / 13 + self._rng.uniform(0, 2 * np.pi))
        yaw += np.radians(swing_deg) * swing / 1.5
        return Route(path[keep], yaw[keep], path_length[keep], self._labels[keep])

    def _append(self, points: Array) -> None:
        self._path.append(points)

    def _along(self, index: int) -> Array:
        return np.array([np.cos(self._heading[index]), np.sin(self._heading[index])])

    def _pose(self) -> tuple[Array, Array]:
        """Where the route ends, and the unit vector in which it goes on."""
        last = self._path[-1]
        step = last[-1] - last[-2]
        return last[-1], step / np.linalg.norm(step)


@dataclass(frozen=True, slots=True)
class Setting:
    """How much a revisit differs from the first visit.

    Attributes:
        lateral_m: largest sideways offset of the path.
        yaw_deg: how far the heading swings to either side.
        sun_deg: how far the sun moves between passes.
        tilt_deg: standard deviation of roll and pitch on top of the ground's.
        aliasing: how much the world repeats itself.
    """

    lateral_m: float
    yaw_deg: float
    sun_deg: float
    tilt_deg: float
    aliasing: float


SETTINGS = {
    "easy": Setting(lateral_m=2.0, yaw_deg=6.0, sun_deg=20.0, tilt_deg=1.0, aliasing=0.0),
    "hard": Setting(lateral_m=4.5, yaw_deg=16.0, sun_deg=70.0, tilt_deg=3.0, aliasing=0.6),
}


@dataclass(frozen=True, slots=True)
class Pass:
    """One drive along a path.

    Attributes:
        label: what makes it a revisit: first, offset, opposite or crossing.
        path: (N, 2) places in order, m.
        yaw: (N,) heading of the rover, rad.
        tilt: (N, 2) roll and pitch on top of the ground's, rad.
        sun: light during the pass.
        exposure: brightness relative to what the automatic exposure would choose.
    """

    label: str
    path: Array
    yaw: Array
    tilt: Array
    sun: Sun
    exposure: float


def thinned(drive: Pass, every: int) -> Pass:
    """Every n-th sample of a pass."""
    return replace(drive, path=drive.path[::every], yaw=drive.yaw[::every], tilt=drive.tilt[::every])


def plan_passes(trail: Array, labels: tuple[str, ...], setting: Setting, step_m: float, seed: int) -> list[Pass]:
    """Passes along a closed trail.

    Args:
        trail: (N, 2) dense closed curve.
        labels: one of first, offset, opposite and crossing for each pass.
        setting: how much revisits differ.
        step_m: distance between poses.
        seed: source of offsets, swings and light.
    """
    rng = np.random.default_rng([seed, 3])
    sun = Sun.drawn(15, 45, rng)
    passes = []
    for index, label in enumerate(labels):
        path, heading = resample(trail if label != "crossing" else _across(trail, rng), step_m)
        first = label == "first"
        path = path if first else path + _sideways(heading, setting.lateral_m, rng)
        if label == "opposite":
            path = path[::-1]
        swing = 0.0 if first else np.radians(setting.yaw_deg) * _wave(len(path), 7, rng)
        tilt = np.radians(setting.tilt_deg) * rng.standard_normal((len(path), 2))
        exposure = float(np.exp(0.12 * rng.standard_normal()))
        passes.append(Pass(label, path, direction(path) + swing, tilt, sun.moved(index * setting.sun_deg), exposure))
    return passes


def resample(curve: Array, step_m: float) -> tuple[Array, Array]:
    """Places every `step_m` along a closed (N, 2) curve, and the direction there, rad."""
    closed = np.vstack([curve, curve[:1]])
    path_length = metres_along(closed)
    wanted = np.arange(0, path_length[-1] - step_m / 2, step_m)
    path = np.stack([np.interp(wanted, path_length, closed[:, axis]) for axis in range(2)], 1)
    return path, direction(path)


def metres_along(points: Array) -> Array:
    """(N,) metres along a polyline of (N, 2) or (N, 3) points."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def direction(path: Array) -> Array:
    """(N,) where a (N, 2) path leads at each of its points, rad from the x axis."""
    along = np.gradient(path, axis=0)
    return np.arctan2(along[:, 1], along[:, 0])


def _sideways(heading: Array, most_m: float, rng: np.random.Generator) -> Array:
    """A smooth offset to the left and right of the path, at most `most_m`."""
    offset = sum(_wave(len(heading), waves, rng) for waves in (1, 2, 4)) / 1.8
    offset = most_m * np.clip(offset, -1, 1)
    return offset[:, None] * np.stack([-np.sin(heading), np.cos(heading)], 1)


def _wave(count: int, waves: int, rng: np.random.Generator) -> Array:
    return np.sin(2 * np.pi * np.arange(count) / count * waves + rng.uniform(0, 2 * np.pi))


def _across(trail: Array, rng: np.random.Generator) -> Array:
    """A figure of eight through the middle that crosses the trail several times."""
    turn, t = rng.uniform(0, 2 * np.pi), np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    reach = 1.15 * np.abs(trail).max(initial=0)
    eight = np.stack([reach * np.sin(t), 0.6 * reach * np.sin(2 * t)], 1)
    return eight @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
