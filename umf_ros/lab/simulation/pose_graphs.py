"""Pose graphs made on purpose: known truth, drifting odometry, right closures and wrong ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from umf_ros.absolute.measurement import AbsoluteMeasurement, Aid
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, expmap, from_enu, gtsam_to_ros_covariance, invert, orthonormal, relative
from umf_ros.lab.simulation.motion_sensors import Drift, drifted

Kind = Literal["random", "groups", "near"]
PERIOD_NS = 1_000_000_000
_ODOMETRY_SIGMAS = np.array([*np.deg2rad([0.2] * 3), 0.02, 0.02, 0.02])
_LEAST_WRONG_M = 3.0
_CLOSURE_SIGMAS = np.array([*np.deg2rad([0.5] * 3), 0.05, 0.05, 0.05])


class WorldClosure(NamedTuple):
    """A closure between poses `first` < `second`; covariance (6, 6) in GTSAM's order; whether it is right."""

    first: int
    second: int
    pose: Array
    covariance: Array
    right: bool


@dataclass(frozen=True)
class GraphWorld:
    """A graph with its truth.

    Attributes:
        truth: (N, 4, 4) true poses.
        odometry: (N, 4, 4) drifting poses; pose 0 is the true one.
        step_covariances: (N, 6, 6) in GTSAM's order of the step that ends at each pose; row 0 is unused.
        closures: sorted by their second pose.
        chains: first pose of every odometry chain.
    """

    truth: Array
    odometry: Array
    step_covariances: Array
    closures: list[WorldClosure]
    chains: tuple[int, ...] = (0,)

    def message(self, row: int) -> LoopClosure:
        """Closure `row` as it comes over the wire; the stamp of pose k is k seconds."""
        closure = self.closures[row]
        covariance = gtsam_to_ros_covariance(closure.covariance, closure.pose)
        return LoopClosure(closure.second * PERIOD_NS, closure.first * PERIOD_NS, closure.pose, covariance)

    def step_covariance(self, row: int) -> Array | None:
        """Covariance of odometry step `row` in ROS order, None where a chain begins."""
        if row in self.chains:
            return None
        step = relative(self.odometry[row - 1], self.odometry[row])
        return gtsam_to_ros_covariance(self.step_covariances[row], step)


def rover_loops(size: int, seed: int) -> GraphWorld:
    """A rover that drives circuits of 80 to 250 m about its lander, each twice, a pose per metre."""
    rng = np.random.default_rng(seed)
    points: list[Array] = []
    while sum(map(len, points)) < size:
        points.append(_circuit(rng))
    return _drive(np.concatenate(points)[:size], rng, spacing=8)


def sphere(size: int, seed: int) -> GraphWorld:
    """Rings of 60 poses about a ball, 4 m apart or nearer, with closures to the ring before."""
    rng = np.random.default_rng(seed)
    height = np.pi * (0.05 + 0.9 * np.arange(size) / size)
    around = 2 * np.pi * np.arange(size) / 60
    radius = min(25.0, size / 42)
    ring = np.stack([np.sin(height) * np.cos(around), np.sin(height) * np.sin(around), np.cos(height)], axis=1)
    return _drive(radius * ring, rng, spacing=5, reach_m=6.0)


def garage(size: int, seed: int) -> GraphWorld:
    """Five floors of 40 x 25 m, 3 m apart, driven round, up, and down again."""
    rng = np.random.default_rng(seed)
    corners = np.array([[0, 0], [40, 0], [40, 25], [0, 25], [0, 0]], float)
    lap = _resample(corners, 1.0)
    laps = int(np.ceil(size / len(lap)))
    floors = np.abs((np.arange(laps * len(lap)) / len(lap) / 2 + 4.999) % 10 - 5)
    level = 3.0 * (np.floor(floors) + np.clip((floors % 1 - 0.75) * 4, 0, 1))
    plan = np.tile(lap, (laps, 1)) + np.repeat(rng.normal(0, 0.4, (laps, 2)), len(lap), axis=0)
    return _drive(np.column_stack([plan, level])[:size], rng, spacing=6)


def short_revisit(seed: int, step_m: float = 0.5) -> GraphWorld:
    """One loop of 30 to 60 m and 5 to 14 m of it again, with the demo's kind of drift and stated noise of 5 cm, .5 deg.

    The errors of scale (.5 to 4 %) and of heading (.05 to .35 deg/m) are constant; neither is stated.
    """
    rng = np.random.default_rng([seed, 3])
    length, again = rng.uniform(30, 60), rng.uniform(5, 14)
    angles = np.linspace(0, 2 * np.pi, 400)
    radius = 1 + sum(rng.uniform(-0.2, 0.2) * np.cos(k * angles + rng.uniform(0, 6.3)) for k in (2, 3))
    loop = np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)
    loop *= length / np.linalg.norm(np.diff(loop, axis=0), axis=1).sum()
    lap = _resample(loop, step_m)
    beside = lap[: int(again / step_m)] * (1 + rng.uniform(-0.7, 0.7) / np.linalg.norm(lap, axis=1).mean())
    points = np.column_stack([np.concatenate([lap, beside]), np.zeros(len(lap) + len(beside))])
    truth = _upright(points)
    drift = Drift(rng.uniform(0.005, 0.04), rng.uniform(0.05, 0.35), rng.uniform(0.2, 0.6), 0.01)
    odometry = drifted(truth, drift, rng)[0]
    covariances = np.zeros((len(truth), 6, 6))
    covariances[1:] = step_m * np.diag(np.array([*np.deg2rad([0.5] * 3), 0.05, 0.05, 0.05]) ** 2)
    world = GraphWorld(truth, truth[0] @ invert(odometry[0]) @ odometry, covariances, [])
    closures = []
    for j in range(len(lap) + 2, len(truth)):
        i = int(np.argmin(np.linalg.norm(points[: len(lap) // 3] - points[j], axis=1)))
        noise = expmap((rng.normal(size=6) * _CLOSURE_SIGMAS)[None])[0]
        pose = relative(truth[i], truth[j]) @ noise
        closures.append(WorldClosure(i, j, pose, np.diag(_CLOSURE_SIGMAS**2), True))
    return replace(world, closures=closures)


WORLDS: dict[str, Callable[[int, int], GraphWorld]] = {"rover": rover_loops, "sphere": sphere, "garage": garage}


def with_wrong_closures(world: GraphWorld, share: float, kind: Kind, seed: int) -> GraphWorld:
    """The world with as many wrong closures that they are `share` of all.

    `random`: between places far apart. `groups`: five to eight in a row that agree with each other.
    `near`: such groups between places 3 to 15 m apart that are passed in the same direction.
    """
    rng = np.random.default_rng(seed)
    wanted = round(share / (1 - share) * len(world.closures))
    wrong: list[WorldClosure] = []
    taken = {(closure.first, closure.second) for closure in world.closures}
    pairs = _near_pairs(world, 3.0, 15.0) if kind == "near" else None
    while len(wrong) < wanted:
        length = 1 if kind == "random" else int(rng.integers(5, 9))
        i, j = _far_pair(world, rng) if pairs is None else pairs[rng.integers(len(pairs))]
        for closure in _alias(world, int(i), int(j), length, rng):
            # two poses have one closure: a second one would only be a duplicate
            if (closure.first, closure.second) not in taken and len(wrong) < wanted:
                taken.add((closure.first, closure.second))
                wrong.append(closure)
    order = sorted(world.closures + wrong, key=lambda closure: (closure.second, closure.first))
    return replace(world, closures=order)


def with_bias(world: GraphWorld, twist: Array) -> GraphWorld:
    """The world with every metre of its odometry wrong by the same (6,) twist, which its covariances do not state."""
    steps = invert(world.odometry[:-1]) @ world.odometry[1:]
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
    return replace(world, odometry=_chained(world.odometry[0], steps @ expmap(lengths[:, None] * twist)))


def with_lone_end(world: GraphWorld) -> GraphWorld:
    """The world with the closures of its first half and, after a long way without any, its last one alone."""
    early = [closure for closure in world.closures if closure.second < len(world.truth) // 2]
    return replace(world, closures=[*early, world.closures[-1]])


def _alias(world: GraphWorld, i: int, j: int, length: int, rng: np.random.Generator) -> list[WorldClosure]:
    """Closures that all say place j is place i: one wrong shift of the world for the whole group."""
    claimed = expmap(rng.normal(0, [0, 0, 0.05, 0.7, 0.7, 0.1])[None])[0]
    wrong_by = np.linalg.norm((world.truth[i] @ claimed)[:3, 3] - world.truth[j][:3, 3])
    if wrong_by < _LEAST_WRONG_M:
        return []
    shift = world.truth[i] @ claimed @ invert(world.truth[j])
    covariance = world.closures[int(rng.integers(len(world.closures)))].covariance
    lower = np.linalg.cholesky(covariance)
    group = []
    for k in range(length):
        if i + k < j and j + k < len(world.truth):
            noise = expmap((lower @ rng.normal(size=6))[None])[0]
            pose = invert(world.truth[i + k]) @ shift @ world.truth[j + k] @ noise
            group.append(WorldClosure(i + k, j + k, pose, covariance, False))
    return group


def _far_pair(world: GraphWorld, rng: np.random.Generator) -> tuple[int, int]:
    # a small world has no places 20 m apart: half its extent is far there
    far_m = min(20.0, 0.5 * float(np.linalg.norm(np.ptp(world.truth[:, :3, 3], axis=0))))
    while True:
        i, j = sorted(rng.integers(len(world.truth), size=2))
        if j - i > 40 and np.linalg.norm(world.truth[i][:3, 3] - world.truth[j][:3, 3]) > far_m:
            return i, j


def _near_pairs(world: GraphWorld, closest_m: float, farthest_m: float) -> NDArray[np.int64]:
    """(M, 2) pairs of poses passed in the same direction within 30 deg, at least 40 poses apart."""
    positions = world.truth[:, :3, 3]
    pairs = cKDTree(positions).query_pairs(farthest_m, output_type="ndarray")
    pairs = pairs[np.diff(pairs, axis=1)[:, 0] > 40]
    apart = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    pairs = pairs[apart >= closest_m]
    turns = np.swapaxes(world.truth[pairs[:, 0], :3, :3], 1, 2) @ world.truth[pairs[:, 1], :3, :3]
    return pairs[Rotation.from_matrix(turns).magnitude() < np.deg2rad(30)]


def _circuit(rng: np.random.Generator) -> Array:
    """(N, 3) points a metre apart: two laps of a bent closed loop from the origin, a little beside each other."""
    length = rng.uniform(80, 250)
    angles = np.linspace(0, 2 * np.pi, 400)
    radius = 1 + sum(rng.uniform(-0.25, 0.25) * np.cos(k * angles + rng.uniform(0, 6.3)) for k in (2, 3, 4))
    loop = np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)
    loop = (loop - loop[0]) @ Rotation.from_euler("z", rng.uniform(0, 6.3)).as_matrix()[:2, :2]
    loop *= length / np.linalg.norm(np.diff(loop, axis=0), axis=1).sum()
    lap = _resample(loop, 1.0)[:-1]
    second = lap + rng.normal(0, 0.5, 2)
    plan = np.concatenate([lap, second])
    hills = 2 * np.sin(plan[:, 0] / 40) + 1.5 * np.cos(plan[:, 1] / 30) - 1.5
    return np.column_stack([plan, hills])


def _resample(corners: Array, step: float) -> Array:
    """Points every `step` along a polyline."""
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(0, way[-1], step)
    return np.stack([np.interp(at, way, corners[:, k]) for k in range(corners.shape[1])], axis=1)


def _drive(points: Array, rng: np.random.Generator, spacing: int, reach_m: float = 2.5) -> GraphWorld:
    """Look along the way, drift, and close a loop about every `spacing` poses where a place is passed again."""
    truth = _upright(points)
    odometry, covariances = _drift(truth, rng)
    world = GraphWorld(truth, odometry, covariances, [])
    return replace(world, closures=_true_closures(world, rng, spacing, reach_m))


def _upright(points: Array) -> Array:
    """(N, 4, 4) poses at points (N, 3) that look along the way."""
    forward = np.gradient(points, axis=0)
    yaw = np.arctan2(forward[:, 1], forward[:, 0])
    pitch = -np.arctan2(forward[:, 2], np.linalg.norm(forward[:, :2], axis=1))
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZY", np.stack([yaw, pitch], axis=1)).as_matrix()
    poses[:, :3, 3] = points
    return poses


def _chained(start: Array, steps: Array) -> Array:
    """(N + 1, 4, 4) poses from the first one and N steps."""
    return np.array([*accumulate(steps, np.matmul, initial=start)])


def _drift(truth: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    steps = invert(truth[:-1]) @ truth[1:]
    lengths = np.maximum(np.linalg.norm(steps[:, :3, 3], axis=1), 0.05)
    sigmas = np.sqrt(lengths)[:, None] * _ODOMETRY_SIGMAS
    steps = steps @ expmap(rng.normal(size=sigmas.shape) * sigmas)
    covariances = np.zeros((len(truth), 6, 6))
    covariances[1:] = sigmas[:, :, None] ** 2 * np.eye(6)
    return _chained(truth[0], steps), covariances


def _true_closures(world: GraphWorld, rng: np.random.Generator, spacing: int, reach_m: float) -> list[WorldClosure]:
    pairs = _near_pairs(world, 0.0, reach_m)
    covariance = np.diag(_CLOSURE_SIGMAS**2)
    closures = []
    for j in np.unique(pairs[:, 1]):
        if rng.random() < 1 / spacing:
            i = int(rng.choice(pairs[pairs[:, 1] == j, 0]))
            noise = expmap((rng.normal(size=6) * _CLOSURE_SIGMAS)[None])[0]
            pose = relative(world.truth[i], world.truth[j]) @ noise
            closures.append(WorldClosure(i, int(j), pose, covariance, True))
    return closures


@dataclass(frozen=True)
class AbsoluteWorld:
    """A drive over open ground with everything that says where it is on the planet.

    Attributes:
        graph: truth, odometry and closures; the true poses are in metres east, north and up of `origin`.
        origin: (3,) latitude, longitude, height.
        measurements: GNSS fixes and upward directions, in order of their stamps.
        lies: (K,) which of them are wrong by far more than they state.
        heights: (H, W) m, the elevation model: of cells of `cell_m`, the first one at `corner` (x, y), with errors.
    """

    graph: GraphWorld
    origin: Array
    measurements: list[AbsoluteMeasurement]
    lies: NDArray[np.bool_]
    heights: Array
    corner: tuple[float, float]
    cell_m: float

    def write_heights(self, path: Path) -> None:
        """Write the elevation model as an ESRI ASCII grid, .asc."""
        (height, width), (x, y) = self.heights.shape, self.corner
        head = f"ncols {width}\nnrows {height}\nxllcenter {x}\nyllcenter {y}\ncellsize {self.cell_m}"
        np.savetxt(path, self.heights[::-1], header=f"{head}\nnodata_value -9999", comments="")


ANTENNA = np.array([-0.3, 0.25, 1.1])
_ORIGIN = np.array([37.72, 15.0, 2550.0])
_FIX_SIGMAS = np.array([0.8, 0.8, 1.6])
_UP_SIGMA = np.deg2rad(0.5)


def open_ground(seed: int, length_m: float = 1500.0, lying: float = 0.2, cell_m: float = 5.0) -> AbsoluteWorld:
    """One round over hills, a pose per metre and second, that ends where it began.

    Odometry is off by 1 to 2 % of the way at the end. GNSS has two outages of a minute, and `lying` of its fixes are
    off by 5 to 50 m for 5 to 30 s, at once or over some seconds, with a covariance that does not say so. Upward
    directions come twice per 3 m; one of ten is of an accelerating rover. The model's heights are wrong by 0.3 m.
    """
    rng = np.random.default_rng(seed)
    ground = _hills(rng)
    plan = _round_trip(rng, length_m)
    truth = _upon(ground, plan)
    graph = replace(_drift_by(truth, rng, rng.uniform(0.01, 0.02)), closures=[])
    ends = [closure for closure in _true_closures(graph, rng, 8, 2.5) if closure.first < 40]
    graph = replace(graph, closures=ends)
    fixes, lies = _fixes(truth, rng, lying)
    both = sorted([*zip(fixes, lies, strict=True), *_upward(truth, rng)], key=lambda one: one[0].stamp_ns)
    x, y = (np.arange(plan[:, axis].min() - 150, plan[:, axis].max() + 150, cell_m) for axis in (0, 1))
    heights = ground(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(len(y), len(x))
    error = gaussian_filter(rng.normal(size=heights.shape), 15 / cell_m)
    heights = heights + 0.25 * error / error.std() + rng.normal(0, 0.15, heights.shape)
    measurements, wrong = [one for one, _ in both], np.array([lie for _, lie in both])
    return AbsoluteWorld(graph, _ORIGIN, measurements, wrong, heights, (float(x[0]), float(y[0])), cell_m)


def _hills(rng: np.random.Generator) -> Callable[[Array], Array]:
    """Heights (N,) of the ground at (N, 2): waves of 40 to 300 m with slopes of some per cent each, and craters."""
    lengths = np.geomspace(40, 300, 14)
    angles, phases = rng.uniform(0, 2 * np.pi, (2, 14))
    waves = 2 * np.pi / lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    tall = 0.055 * lengths / (2 * np.pi) * rng.uniform(0.6, 1.4, 14)
    craters, radii = rng.uniform(-350, 350, (12, 2)), rng.uniform(15, 60, 12)

    def ground(points: Array) -> Array:
        heights = (tall * np.sin(points @ waves.T + phases)).sum(axis=1)
        for centre, radius in zip(craters, radii, strict=True):
            away = np.square(points - centre).sum(axis=1) / radius**2
            heights = heights - 0.12 * radius * (1 - away) * np.exp(-away)
        return heights

    return ground


def _round_trip(rng: np.random.Generator, length_m: float) -> Array:
    """(N, 2) points a metre apart: a bent round with detours, and 30 m of it again."""
    angles = np.linspace(0, 2 * np.pi, 4000)
    radius = 1 + sum(rng.uniform(-0.2, 0.2) * np.cos(k * angles + rng.uniform(0, 6.3)) for k in (2, 3, 4))
    radius += sum(rng.uniform(0.2, 0.6) / k * np.cos(k * angles + rng.uniform(0, 6.3)) / 3 for k in (9, 13, 21))
    loop = np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)
    loop *= (length_m - 30) / np.linalg.norm(np.diff(loop, axis=0), axis=1).sum()
    points = _resample(loop, 1.0)
    return np.concatenate([points, points[:30] + rng.normal(0, 0.5, 2)])


def _upon(ground: Callable[[Array], Array], plan: Array) -> Array:
    """(N, 4, 4) poses along the way, upright on the slope."""
    slope = np.stack([ground(plan + axis) - ground(plan - axis) for axis in 0.5 * np.eye(2)])
    normal = np.column_stack([-slope.T, np.ones(len(plan))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    ahead = np.column_stack([np.gradient(plan, axis=0), np.zeros(len(plan))])
    left = np.cross(normal, ahead)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(plan), 1, 1))
    poses[:, :3, :3] = np.stack([np.cross(left, normal), left, normal], axis=2)
    poses[:, :3, 3] = np.column_stack([plan, ground(plan)])
    return poses


def _drift_by(truth: Array, rng: np.random.Generator, share: float) -> GraphWorld:
    """Odometry that random errors, and others that change with the ground, bring off by a share of the way."""
    steps = invert(truth[:-1]) @ truth[1:]
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
    bias = gaussian_filter1d(rng.normal(size=(len(steps), 6)), 60, axis=0)
    bias *= np.array([*np.deg2rad([0.02, 0.02, 0.06]), 0.02, 0.006, 0.006]) / bias.std(axis=0)
    noise = lengths[:, None] * bias + np.sqrt(lengths)[:, None] * rng.normal(size=(len(steps), 6)) * _ODOMETRY_SIGMAS

    def drifted(factor: float) -> Array:
        return orthonormal(_chained(np.eye(4), steps @ expmap(factor * noise)))  # a map begins where the rover is

    begun = invert(truth[0])

    def error(factor: float) -> float:
        return float(np.linalg.norm(drifted(factor)[-1, :3, 3] - (begun @ truth[-1])[:3, 3]))

    low, high = 0.0, 0.25
    while error(high) < share * lengths.sum():
        low, high = high, 2 * high
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if error(middle) < share * lengths.sum() else (low, middle)
    return GraphWorld(truth, drifted(high), np.zeros((len(truth), 6, 6)), [])


def _fixes(truth: Array, rng: np.random.Generator, lying: float) -> tuple[list[AbsoluteMeasurement], NDArray[np.bool_]]:
    """GNSS fixes, and which of them lie."""
    count = len(truth)
    offsets, heard = np.zeros((count, 3)), np.ones(count, bool)
    for start in rng.integers(200, count - 100, 2):
        heard[start : start + 60] = False
    while (np.abs(offsets).max(axis=1) > 0).mean() < lying:
        start, length = int(rng.integers(0, count)), int(rng.integers(5, 31))
        way = rng.normal(size=3) * [1, 1, 0.7]
        jump = way / np.linalg.norm(way) * rng.uniform(5, 50)
        ramp = np.clip(np.arange(length) / rng.choice([1, 3]), 0, 1)[: count - start, None]
        offsets[start : start + length] = (np.maximum(ramp, 0.4) * jump)[: count - start]
    slow = gaussian_filter1d(rng.normal(size=(count, 3)), 15, axis=0)
    slow *= 0.5 / slow.std(axis=0)
    errors = _FIX_SIGMAS * (slow + np.sqrt(1 - 0.25) * rng.normal(size=(count, 3))) + offsets
    antennas = (truth @ np.append(ANTENNA, 1.0))[:, :3]
    geodetic = from_enu(antennas + errors, _ORIGIN)
    found = [
        AbsoluteMeasurement(Aid.GNSS, k * PERIOD_NS, geodetic[k], np.diag(_FIX_SIGMAS**2), ANTENNA)
        for k in np.flatnonzero(heard).tolist()
    ]
    return found, (np.linalg.norm(errors / _FIX_SIGMAS, axis=1) > 5)[heard]


def _upward(truth: Array, rng: np.random.Generator) -> list[tuple[AbsoluteMeasurement, bool]]:
    """Upward directions, and whether each is wrong by more than five sigmas."""
    found = []
    for k in np.flatnonzero(np.arange(len(truth)) % 3 < 2).tolist():
        up = truth[k, 2, :3] + rng.normal(0, _UP_SIGMA, 3) + (rng.random() < 0.1) * rng.normal(0, 0.12, 3)
        up /= np.linalg.norm(up)
        spread, angle = _UP_SIGMA**2 * np.eye(3), np.arccos(np.clip(up @ truth[k, 2, :3], -1, 1))
        measurement = AbsoluteMeasurement(Aid.GRAVITY, k * PERIOD_NS, up, spread, np.zeros(3))
        found.append((measurement, bool(angle > 5 * _UP_SIGMA)))
    return found
