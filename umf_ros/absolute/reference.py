"""Absolute measurements of a pose graph, and its solution with those that are accepted.

`Track` decides about GNSS and gravity by their consistency over time. An elevation model is tested as a whole: the
graph is solved with its heights, and the model is rejected if they cost more than their errors explain, or if they fit
as well at another place.

The graph is solved in the world frame (east, north, up of the origin) and transformed back, so that the map frame stays
at the start of the odometry; `worlds` has its pose.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.absolute.consistency import STRETCH_M, MeasuredPath, Rows, Track, apply, turned
from umf_ros.absolute.elevation import ElevationModel, load_elevation
from umf_ros.absolute.measurement import AbsoluteMeasurement, AbsoluteReason, AbsoluteVerdict, Aid, parse_numbers
from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError
from umf_ros.core.frames import State
from umf_ros.core.geometry import Array, heading, invert, make_pose, orthonormal, to_enu
from umf_ros.core.odometry_noise import OdometryNoise

if TYPE_CHECKING:  # the pose graph lies above
    from umf_ros.pose_graph.odometry import OdometryChain
    from umf_ros.pose_graph.sessions import Sessions
    from umf_ros.pose_graph.solver import Graph

# standard deviations (m, rad) of the first pose in the world: free, fixed, of a start pose
_FREE, _FIXED, _START_M, _START_RAD = 1e3, 1e-6, 5.0, np.deg2rad(5.0)
_FEW_HEIGHTS, _HEIGHT_GATE = 15, 3.5
# by hand: largest additional cost per height of a right elevation model; evidence against other places, nats; least
# share of heights within the gate
_MOST_COST, _EVIDENCE, _LEAST_FITTING = 1.0, 12.0, 0.8
# by hand: shifts of a model in the test, m; growth of the path until the next test
_ELSEWHERE_M = 50.0 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [0.7, 0.7], [-0.7, -0.7]])
_RETEST = 1.3
_ROUNDS, _TEST_ROUNDS = 1, 5
_FIRST_FIXES = 5

Factors = Sequence[tuple[int, Callable[[int], gtsam.NonlinearFactor]]]


@dataclass
class _Heights:
    """The elevation model under one component of the map.

    Attributes:
        fits: whether it is accepted; None while it is pending.
        tested: number of stretches at the last test.
        misfits: sigmas and metres of the ground under each stretch, by session and stamp.
    """

    fits: bool | None = None
    tested: int = 0
    misfits: dict[tuple[int, int], tuple[float, float]] = field(default_factory=dict)

    def verdict(self, stamp_ns: int, sigmas: float, misfit_m: float) -> AbsoluteVerdict:
        """Return the verdict on one height."""
        if not self.fits:
            unsure, misfit = (State.PENDING, AbsoluteReason.UNSURE), (State.REJECTED, AbsoluteReason.MISFIT)
            known = unsure if self.fits is None else misfit
        elif np.isnan(sigmas):
            known = State.REJECTED, AbsoluteReason.OUTSIDE
        elif sigmas > _HEIGHT_GATE:
            known = State.REJECTED, AbsoluteReason.CONTRADICTS
        else:
            known = State.ACCEPTED, AbsoluteReason.AGREES
        return AbsoluteVerdict(Aid.ELEVATION, stamp_ns, *known, sigmas, misfit_m)


class AbsoluteReference:
    """Absolute measurements of a pose graph.

    Attributes:
        origin: (3,) of the world frame on WGS 84; None before the first good fixes.
        worlds: `world_T_map` (4, 4) of components of the map, by their earliest session.

    Raises:
        ConfigError: a parameter is wrong, or the elevation model cannot be read.
    """

    def __init__(self, settings: PoseGraphSettings) -> None:
        self._settings, self._noise = settings, OdometryNoise.stated(settings)
        self.origin = parse_numbers(settings.origin, 3, "pose_graph.origin")
        self._start = parse_numbers(settings.elevation_start, 3, "pose_graph.elevation_start")
        self._model: ElevationModel | None = None
        if self.origin is not None or self._start is not None:
            self._load_model()
        self.worlds: dict[int, Array] = {}
        self._waiting: list[AbsoluteMeasurement] = []
        self._known: set[tuple[Aid, int]] = set()
        self._refused: list[AbsoluteVerdict] = []
        self._tracks: dict[tuple[int, Aid], Track] = {}
        self._heights: dict[int, _Heights] = {}
        self._seen: object = None
        self._rounds = _ROUNDS

    def add(self, measurement: AbsoluteMeasurement) -> None:
        """Add one measurement, in any order; a second one of a stamp is dropped."""
        key = measurement.source, measurement.stamp_ns
        if key in self._known:
            return
        self._known.add(key)
        if measurement.is_usable:
            self._waiting.append(measurement)
        else:
            self._refused.append(AbsoluteVerdict(*key, State.REFUSED, AbsoluteReason.UNUSABLE))

    @property
    def is_used(self) -> bool:
        """Whether there are measurements, or an elevation model."""
        return bool(self._known) or self._model is not None

    def decide(self, paths: Sessions, solve: Callable[[], None], at_last: bool = False) -> None:
        """Decide about all measurements, and `solve` the graph if the accepted ones have changed.

        Raises:
            GraphError: it cannot be solved.
        """
        if not self.is_used:
            return
        late = self._place(paths)
        seen = tuple(_finished(paths.chains[session])[0] for session in paths.begun), tuple(paths.components)
        if seen == self._seen and not late and not at_last:
            return
        self._seen = seen
        if at_last:
            solve()
        if self._judge(paths, at_last):
            solve()
        if self._model is not None:
            for component in sorted(set(paths.components)):
                self._judge_heights(self._model, component, paths, solve, at_last)

    def world_of(self, component: int, paths: Sessions) -> tuple[Array, Array] | None:
        """Return `world_T_map` of a component and the origin; None where neither GNSS nor an elevation model fits."""
        heights = self._heights.get(component)
        is_placed = self._has_gnss(component, paths) or (heights is not None and heights.fits)
        return (self.worlds[component], self.origin) if is_placed and self.origin is not None else None

    def verdicts(self) -> list[AbsoluteVerdict]:
        """The latest verdict of every measurement."""
        waiting = State.PENDING, AbsoluteReason.NO_ODOMETRY_YET
        found = [AbsoluteVerdict(one.source, one.stamp_ns, *waiting) for one in self._waiting]
        found += [verdict for track in self._tracks.values() for verdict in track.verdicts()]
        for heights in self._heights.values():
            found += [heights.verdict(stamp, *misfit) for (_, stamp), misfit in heights.misfits.items()]
        return found + self._refused

    def report(self) -> dict[str, object]:
        """Return the number of measurements by source and state, and why a source is rejected as a whole."""
        counts = Counter(f"{one.source.value} {one.state.value}" for one in self.verdicts())
        found: dict[str, object] = dict(sorted(counts.items()))
        for (_, source), track in self._tracks.items():
            if track.mounting is not None:
                ahead, left = track.mounting
                text = f"antenna off by {ahead:.2f} m ahead, {left:.2f} m left"
                if source is Aid.GRAVITY:
                    text = f"IMU off by {np.degrees(-left):.1f} deg about x, {np.degrees(ahead):.1f} deg about y"
                found[f"{source.value} rejected as a whole"] = f"{text}: see the calibration"
        if any(heights.fits is False for heights in self._heights.values()):
            found["elevation rejected as a whole"] = AbsoluteReason.MISFIT.value
        return found

    def stamps(self, session: int, travel: Array) -> Rows:
        """Return (K,) stamps of further vertices that accepted measurements need, beside those at (N,) `travel`."""
        held = set((travel // STRETCH_M).astype(int).tolist())
        stamps = [
            one.stamp_ns
            for (own, _), track in self._tracks.items()
            if own == session
            for cell, one in track.factors.items()
            if cell not in held
        ]
        stamps += [
            stamp
            for heights in self._heights.values()
            if heights.fits
            for own, stamp in heights.misfits
            if own == session
        ]
        return np.unique(np.array(stamps, np.int64))

    def solve(
        self, points: NDArray[np.void], graph: Graph, components: list[int], optimum: Callable[[Graph], Array]
    ) -> Array:
        """Return (N, 4, 4) poses of a graph's vertices with all accepted measurements, in the frames of its components.

        Args:
            points: (N,) odometry at the vertices.
            graph: its anchors are the first vertices of the components.
            components: the earliest session of each session's component.
            optimum: solves a graph.

        Raises:
            GraphError: it cannot be solved.
        """
        of, poses = np.array(components, np.int64)[points["session"]], graph.poses
        rows = {vertex: row for row, vertex in enumerate(graph.vertices)}
        firsts = {int(of[row]): row for row in graph.anchors if int(of[row]) in self.worlds}
        held, factors, planes, loose = poses.copy(), list[Any](), list[tuple[list[int], bool]](), dict[int, Any]()
        for component, first in firsts.items():
            tracks = [one for one in self._tracks.items() if components[one[0][0]] == component and one[1].factors]
            factors += [one for (session, _), track in tracks for one in _attached(track, session, points)]
            sources = {source for (_, source), _ in tracks}
            heights = self._heights.get(component)
            if heights is not None and heights.fits:
                planes.append(([rows[key] for key in heights.misfits], Aid.GNSS in sources))
                sources.add(Aid.ELEVATION)
            if sources:
                held[of == component] = self.worlds[component] @ held[of == component]
                loose[first] = _first_pose_noise(held[first], sources)
        if not loose:
            return optimum(graph)
        for _ in range(self._rounds if planes else 1):
            ground = [one for under, is_free in planes for one in self._planes(held, under, is_free)]
            held = optimum(replace(graph, poses=held, absolute=factors + ground, loose=loose))
        for component, first in firsts.items():
            if first in loose:
                # products of many rotations lose their orthonormality
                self.worlds[component] = orthonormal((held[first] @ invert(poses[first]))[None])[0]
                held[of == component] = orthonormal(invert(self.worlds[component]) @ held[of == component])
        return held

    def _place(self, paths: Sessions) -> bool:
        """Add measurements whose odometry has arrived to their tracks; return whether one is of a finished stretch."""
        waiting, placed, late = [], dict[tuple[int, Aid], list[AbsoluteMeasurement]](), False
        sessions = paths.find(np.array([one.stamp_ns for one in self._waiting], np.int64))
        for one, session in zip(self._waiting, sessions.tolist(), strict=True):
            if session < 0:
                waiting.append(one)
                continue
            placed.setdefault((session, one.source), []).append(one)
            late = late or one.stamp_ns < _finished(paths.chains[session])[1]
        self._waiting = waiting
        for key, new in placed.items():
            self._tracks.setdefault(key, Track(key[1], self._noise)).add(new)
        return late

    def _judge(self, paths: Sessions, at_last: bool) -> bool:
        """Decide about the tracks; return whether the accepted factors have changed."""
        changed = False
        # gravity before GNSS: both determine the pose of the map in the world, GNSS more of it
        for (session, aid), track in sorted(self._tracks.items(), key=lambda one: (one[0][1] is Aid.GNSS, one[0][0])):
            before = {cell: factor.numbers for cell, factor in track.factors.items()}
            component, measured = paths.components[session], self._measured(aid, track)
            path = self._path(track, session, paths, at_last)
            if aid is Aid.GNSS and track.mounting is None and not self._has_gnss(component, paths):
                world = track.align(measured, path)
                if world is None:
                    continue
                self.worlds[component] = world
            known = component in self.worlds
            if known:
                path = replace(path, poses=self.worlds[component] @ path.poses)
            track.judge(measured, path, known)
            if track.factors and not known:
                # upright, along the shortest arc
                turn, _ = Rotation.align_vectors([0.0, 0.0, 1.0], apply(path.poses, measured).mean(axis=0))
                self.worlds[component] = make_pose(turn.as_matrix(), np.zeros(3))
            changed = changed or before != {cell: factor.numbers for cell, factor in track.factors.items()}
        return changed

    def _path(self, track: Track, session: int, paths: Sessions, at_last: bool) -> MeasuredPath:
        chain = paths.chains[session]
        points = chain.at(track.stamps)

        def middle(cell: int) -> tuple[int, Array]:
            point = chain.at(_middle(chain, cell))
            return int(point["stamp"][0]), point["pose"][0]

        return MeasuredPath(points["pose"], paths.at(points), points["travel"], _finished(chain)[0] + at_last, middle)

    def _measured(self, source: Aid, track: Track) -> Array:
        """Return (N, 3) positions in the world, or upward directions in the body."""
        if source is not Aid.GNSS:
            return track.values
        if self.origin is None:
            self.origin = np.median(track.values[:_FIRST_FIXES], axis=0)
            self._load_model()
        return to_enu(track.values, self.origin)

    def _load_model(self) -> None:
        settings = self._settings
        if settings.elevation_model and self._model is None:
            self._model = load_elevation(Path(settings.elevation_model), settings.elevation_sigma_m, self.origin)

    def _has_gnss(self, component: int, paths: Sessions) -> bool:
        """Return whether a component has accepted fixes."""
        tracks = ((session, track) for (session, source), track in self._tracks.items() if source is Aid.GNSS)
        return any(bool(track.factors) and paths.components[session] == component for session, track in tracks)

    def _judge_heights(
        self, model: ElevationModel, component: int, paths: Sessions, solve: Callable[[], None], at_last: bool
    ) -> None:
        """Test an elevation model as the path grows, and use its heights if it fits."""
        if component not in self._heights and not self._has_gnss(component, paths):
            if self._start is None or component not in paths.begun:
                return
            self._begin_at(self._start, model, component, paths)
        heights = self._heights.setdefault(component, _Heights())
        known = len(heights.misfits)
        for session in paths.members(component):
            chain = paths.chains[session]
            for cell in range(_finished(chain)[0]):
                heights.misfits.setdefault((session, int(_middle(chain, cell)[0])), (np.nan, np.nan))
        count = len(heights.misfits)
        due = count > heights.tested if at_last else count >= _RETEST * heights.tested
        if count >= _FEW_HEIGHTS and due:
            self._test(model, component, paths, solve)
        elif heights.fits and count > known:
            solve()
            self._fitting(model, component, paths)

    def _test(self, model: ElevationModel, component: int, paths: Sessions, solve: Callable[[], None]) -> None:
        """Solve with the heights; restore the graph if they do not fit, or fit as well at another place.

        The first time, the model is also tested with shifts: heights that fit there are no evidence.
        """
        heights = self._heights[component]
        believed, heights.fits, heights.tested = heights.fits, False, len(heights.misfits)
        solve()
        before, cost, elsewhere = (dict(paths.solved), self.worlds[component]), paths.cost, np.inf
        for shift in _ELSEWHERE_M if not believed else ():
            added, fitting = self._try(model.shifted(shift), component, paths, solve, cost)
            elsewhere = min(elsewhere, added if fitting > 0 else np.inf)
            paths.solved, self.worlds[component] = dict(before[0]), before[1]
        added, fitting = self._try(model, component, paths, solve, cost)
        is_right = added <= _MOST_COST and fitting >= _LEAST_FITTING
        is_sure = believed or 0.5 * heights.tested * (elsewhere - added) >= _EVIDENCE
        heights.fits = is_sure or None if is_right else False
        if not heights.fits:
            paths.solved, self.worlds[component] = dict(before[0]), before[1]
            solve()

    def _try(
        self, model: ElevationModel, component: int, paths: Sessions, solve: Callable[[], None], cost: float
    ) -> tuple[float, float]:
        """Solve with the heights of a model; return the cost per height, and the share that fits."""
        heights, given = self._heights[component], self._model
        heights.fits, self._rounds, self._model = True, _TEST_ROUNDS, model
        try:
            solve()
            return 2 * (paths.cost - cost) / len(heights.misfits), self._fitting(model, component, paths)
        except GraphError:
            return np.inf, 0.0
        finally:
            heights.fits, self._rounds, self._model = False, _ROUNDS, given

    def _fitting(self, model: ElevationModel, component: int, paths: Sessions) -> float:
        """Compare all heights with the map; return the share that fits, 0 if the model covers less than half."""
        heights, poses = self._heights[component], list[Array]()
        keys = sorted(heights.misfits)
        for session in sorted({session for session, _ in keys}):
            stamps = np.array([stamp for own, stamp in keys if own == session], np.int64)
            poses.append(self.worlds[component] @ paths.at(paths.chains[session].at(stamps)))
        missed, sigmas, known = model.misfits(np.concatenate(poses), self._has_gnss(component, paths))
        ratios = np.where(known, np.abs(missed) / sigmas, np.nan)
        heights.misfits.update(zip(keys, zip(ratios.tolist(), np.abs(missed).tolist(), strict=True), strict=True))
        return float((ratios[known] <= _HEIGHT_GATE).mean()) if 2 * known.sum() >= len(known) else 0.0

    def _planes(self, poses: Array, rows: list[int], is_free: bool) -> Factors:
        """Return the factors of the ground under rows of world poses (N, 4, 4)."""
        assert self._model is not None
        gate = np.inf if self._rounds == _TEST_ROUNDS else _HEIGHT_GATE  # in a test the ground may be far away
        planes = self._model.planes(poses[rows], is_free, gate)
        return [(row, make) for row, make in zip(rows, planes, strict=True) if make is not None]

    def _begin_at(self, start: Array, model: ElevationModel, component: int, paths: Sessions) -> None:
        """Set the pose of a component in the world by x, y and heading of its first pose, and by gravity if known."""
        chain = paths.chains[component]
        first = paths.at(chain.at(chain.stamps[:1]))[0]
        level = self.worlds.get(component, np.eye(4))
        turn = turned(np.eye(3), np.deg2rad(start[2]) - float(heading(level @ first))).T @ level[:3, :3]
        height = np.nan_to_num(model.at(start[None, :2])[0][0])
        self.worlds[component] = make_pose(turn, np.array([*start[:2], height]) - turn @ first[:3, 3])


def _attached(track: Track, session: int, points: NDArray[np.void]) -> Factors:
    """Return the factors of a track, each at the vertex nearest to its middle, connected by the odometry between."""
    own, factors = np.flatnonzero(points["session"] == session), track.factors
    travel, middles = points["travel"][own], (np.array(list(factors)) + 0.5) * STRETCH_M
    after = np.searchsorted(travel, middles).clip(1, max(1, len(own) - 1))
    before = middles - travel[after - 1] < travel[after.clip(max=len(own) - 1)] - middles
    rows = own[np.where(before, after - 1, after.clip(max=len(own) - 1))]
    poses = invert(points["pose"][rows]) @ np.array([one.middle for one in factors.values()]).reshape(-1, 4, 4)
    placed = zip(rows.tolist(), poses, factors.values(), strict=True)
    return [(row, partial(one.make, pose)) for row, pose, one in placed]


def _finished(chain: OdometryChain) -> tuple[int, int]:
    """Return the number of finished stretches of a session, and the stamp at the end of the last."""
    cell = int(chain.travel[-1] // STRETCH_M)
    return cell, int(chain.stamps[np.searchsorted(chain.travel, cell * STRETCH_M)])


def _middle(chain: OdometryChain, cell: int) -> Rows:
    """Return the stamp (1,) of the keyframe in the middle of a stretch."""
    row = min(int(np.searchsorted(chain.travel, (cell + 0.5) * STRETCH_M)), len(chain.travel) - 1)
    return chain.stamps[row : row + 1]


def _first_pose_noise(pose: Array, sources: set[Aid]) -> gtsam.noiseModel.Base:
    """Return the noise of the first pose of a component, by the sources that determine it."""
    tilt, turn, across, up = _START_RAD, _FIXED, _FIXED, _FIXED
    if Aid.ELEVATION in sources:
        turn, across, up = _START_RAD, _START_M, _FREE
    if Aid.GNSS in sources:
        turn, across, up = 10 * _START_RAD, _FREE, _FREE
    if sources & {Aid.GNSS, Aid.GRAVITY}:
        tilt = 10 * _START_RAD
    axes = np.kron(np.eye(2), pose[:3, :3].T)  # from world axes to body axes
    covariance = axes @ np.diag(np.square([tilt, tilt, turn, across, across, up])) @ axes.T
    return gtsam.noiseModel.Gaussian.Covariance(0.5 * (covariance + covariance.T))
