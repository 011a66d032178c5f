"""Decide about absolute measurements, and solve pose graphs with those that are accepted.

Measurements are decided about by stretches of the path, over which they are averaged. A stretch is accepted when it is
consistent with its neighbours over the odometry between, see `consistency`; single measurements have to agree with
their stretch, and with the map as it was solved. A source whose sensor is mounted differently from the calibration,
and an elevation model that does not fit the path, are rejected as a whole.

The graph is solved in the world frame (east, north, up of the origin) and moved back, so that the map frame stays where
the odometry began: `worlds` says where that is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from umf_ros.absolute.consistency import (
    GATE,
    attitude_drift,
    body_offset,
    find_heading,
    longest_chain,
    position_drift,
    supported,
    turned,
)
from umf_ros.absolute.elevation import ElevationModel, load_elevation
from umf_ros.absolute.measurement import (
    AbsoluteMeasurement,
    AbsoluteReason,
    AbsoluteVerdict,
    Source,
    parse_numbers,
    to_enu,
)
from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError
from umf_ros.core.frames import State
from umf_ros.core.geometry import Array, heading, invert, make_pose, orthonormal
from umf_ros.core.odometry_noise import OdometryNoise

if TYPE_CHECKING:
    from umf_ros.pose_graph.sessions import Sessions
    from umf_ros.pose_graph.solver import Graph, GraphSolver

STRETCH_M = 10.0
"""Measurements are averaged over so much of the path (*by hand*: multipath jumps further than odometry drifts)."""
# by hand: errors of measurements beside each other are alike, so that a stretch counts as so many at most
_MOST_COUNTED = 4
_MOST_DRIFT_M = 2000
_ALIGNED_STRETCHES = 40
# by hand: mounting errors that matter, and how well they must be known: m for an antenna, rad for an IMU
_MOUNTING = {Source.GNSS: (0.5, 0.25), Source.GRAVITY: (np.deg2rad(1.5), np.deg2rad(1.0))}
_FEW_STRETCHES = 15
# standard deviations (m, rad) of the first pose in the world, per axis: free, as a start pose says, and fixed
_FREE, _FIXED = 1e3, 1e-6
_START_M, _START_RAD = 5.0, np.deg2rad(5.0)
# by hand: largest cost per height that a right elevation model adds, its own noise and the odometry's strain together;
# least share of the heights within three sigmas
_MOST_COST, _LEAST_FITTING = 1.0, 0.8
# by hand: nats that the model fits better than it does anywhere else
_EVIDENCE = 12.0
# by hand: where else a model is tried, m; by which factor the path grows until the next test
_ELSEWHERE_M = 50.0 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [0.7, 0.7], [-0.7, -0.7]])
_RETEST = 1.3
_HEIGHT_GATE, _HUBER = 3.5, 1.345
_TANGENT_M = 100.0
_ROUNDS, _TRIAL_ROUNDS = 1, 5


class _Factor(NamedTuple):
    """An averaged measurement: its session, the stamp of its pose, and what makes it with the number of a vertex."""

    session: int
    stamp_ns: int
    source: Source
    make: Callable[[int], gtsam.NonlinearFactor]


@dataclass
class _Track:
    """Measurements of one source in one session, by their stamps, and the decisions about them.

    Attributes:
        measurements: sorted.
        states, reasons: the decisions.
        residuals, misfits: (N,) distances to the map.
        solved: stretches that were in the map once: what they measure has to agree with it.
        mounting: the error of the mounting (3,) for which the source is rejected.
        factors: by stretch, with the numbers that tell whether it has changed.
    """

    measurements: list[AbsoluteMeasurement] = field(default_factory=list)
    states: list[State] = field(default_factory=list)
    reasons: list[AbsoluteReason] = field(default_factory=list)
    residuals: Array = field(default_factory=lambda: np.empty(0))
    misfits: Array = field(default_factory=lambda: np.empty(0))
    solved: set[int] = field(default_factory=set)
    mounting: Array | None = None
    factors: dict[int, tuple[tuple[float, ...], _Factor]] = field(default_factory=dict)


@dataclass
class _Heights:
    """The elevation model under one component of the map, and whether it is believed.

    Attributes:
        fits: None while it is not known.
        tested: stretches at the last test.
        residuals: normalised misfit of each stretch, by session and stamp.
    """

    fits: bool | None = None
    tested: int = 0
    residuals: dict[tuple[int, int], tuple[float, float]] = field(default_factory=dict)


class AbsoluteReference:
    """Absolute measurements of a pose graph.

    Attributes:
        origin: (3,) of the world frame on WGS 84; None before the first good fix.
        worlds: `world_T_map` (4, 4) of components of the map, by their earliest session.

    Raises:
        ConfigError: a parameter is not what it should be, or the elevation model cannot be read.
    """

    def __init__(self, settings: PoseGraphSettings) -> None:
        self._settings, self._noise = settings, OdometryNoise.stated(settings)
        self.origin = parse_numbers(settings.origin, 3, "pose_graph.origin")
        self._start = parse_numbers(settings.elevation_start, 3, "pose_graph.elevation_start")
        self._model: ElevationModel | None = None
        if settings.elevation_model and (self.origin is not None or self._start is not None):
            self._load_model()
        self.worlds: dict[int, Array] = {}
        self._waiting: list[AbsoluteMeasurement] = []
        self._known: set[tuple[Source, int]] = set()
        self._refused: list[AbsoluteVerdict] = []
        self._tracks: dict[tuple[int, Source], _Track] = {}
        self._heights: dict[int, _Heights] = {}
        self._seen: object = None
        self._rounds = _ROUNDS
        metres = np.arange(_MOST_DRIFT_M, dtype=float)
        self._drift = {Source.GNSS: position_drift(self._noise, metres), Source.GRAVITY: attitude_drift(self._noise, metres)}

    def add(self, measurement: AbsoluteMeasurement) -> None:
        """Take one measurement, in any order; the same again is dropped."""
        key = measurement.source, measurement.stamp_ns
        if key in self._known:
            return
        self._known.add(key)
        if not measurement.is_usable:
            self._refused.append(AbsoluteVerdict(*key, State.REFUSED, AbsoluteReason.UNUSABLE))
            return
        self._waiting.append(measurement)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to decide about."""
        return not self._known and self._model is None

    def decide(self, sessions: Sessions, solve: Callable[[], None], at_last: bool = False) -> None:
        """Decide about all measurements, and `solve` the graph again where the accepted ones have changed.

        Raises:
            GraphError: it cannot be solved.
        """
        if self.is_empty:
            return
        late = self._place(sessions)
        seen = tuple(self._finished(sessions, session)[0] for session in sessions.begun), tuple(sessions.components)
        if seen == self._seen and not late and not at_last:
            return
        self._seen = seen
        if self._judge_all(sessions, at_last) or at_last:
            solve()
        for component in sorted(set(sessions.components)):
            if self._model is not None:
                self._judge_heights(self._model, component, sessions, solve, at_last)

    def verdicts(self) -> list[AbsoluteVerdict]:
        """The latest verdict of every measurement."""
        found = [
            AbsoluteVerdict(one.source, one.stamp_ns, State.PENDING, AbsoluteReason.NO_ODOMETRY_YET)
            for one in self._waiting
        ]
        for track in self._tracks.values():
            columns = track.states, track.reasons, track.residuals.tolist(), track.misfits.tolist()
            found += [
                AbsoluteVerdict(one.source, one.stamp_ns, *rest)
                for one, *rest in zip(track.measurements, *columns, strict=True)
            ]
        for heights in self._heights.values():
            found += [self._height_verdict(heights, stamp, *fit) for (_, stamp), fit in heights.residuals.items()]
        return found + self._refused

    def counts(self) -> dict[str, object]:
        """How many measurements have which state, by source, and what speaks against a source as a whole."""
        found = Counter(f"{one.source.value} {one.state.value}" for one in self.verdicts())
        notes = {
            f"{source.value} mounting": f"off by {' '.join(f'{number:.2f}' for number in self._told(source, track.mounting))}"
            f" {'m' if source is Source.GNSS else 'deg'} in the body frame: rejected"
            for (_, source), track in self._tracks.items()
            if track.mounting is not None
        }
        if any(one.fits is False for one in self._heights.values()):
            notes["elevation model"] = AbsoluteReason.MISFIT.value
        return {**dict(sorted(found.items())), **notes}

    @staticmethod
    def _told(source: Source, mounting: Array) -> Array:
        return mounting if source is Source.GNSS else np.degrees([-mounting[1], mounting[0]])

    def stamps(self, session: int) -> NDArray[np.int64]:
        """(K,) stamps of the poses of a session that accepted measurements are about."""
        return np.unique([factor.stamp_ns for factor in self._factors() if factor.session == session]).astype(np.int64)

    def solve(self, solver: GraphSolver, points: NDArray[np.void], graph: Graph, components: list[int]) -> Array:
        """(N, 4, 4) poses of a graph's vertices with all accepted measurements, in its own frames.

        Args:
            solver: of the graph.
            points: (N,) odometry at the vertices.
            graph: without absolute measurements.
            components: the earliest session of each session's component.

        Raises:
            GraphError: it cannot be solved.
        """
        of = np.array(components, np.int64)[points["session"]]
        factors = list(self._factors())
        sources: dict[int, set[Source]] = {}
        for one in factors:
            sources.setdefault(components[one.session], set()).add(one.source)
        sources = {component: kinds for component, kinds in sources.items() if component in self.worlds}
        if not sources:
            return solver.solve(graph)
        rows = {(int(session), int(stamp)): row for row, (session, stamp) in enumerate(graph.vertices)}
        poses, loose = graph.poses.copy(), {}
        for component, kinds in sources.items():
            poses[of == component] = self.worlds[component] @ poses[of == component]
            anchor = next(row for row in graph.anchors if points["session"][row] == component)
            loose[anchor] = self._first_pose_noise(poses[anchor], kinds)
        given = [
            (rows[one.session, one.stamp_ns], one.make)
            for one in factors
            if components[one.session] in sources and one.source is not Source.ELEVATION
        ]
        heights = [
            (rows[one.session, one.stamp_ns], components[one.session])
            for one in factors
            if components[one.session] in sources and one.source is Source.ELEVATION
        ]
        for _ in range(self._rounds if heights else 1):
            made = given + self._height_factors(poses, heights, sources)
            poses = solver.solve(replace(graph, poses=poses, absolute=made, loose=loose))
        for component in sources:
            anchor = next(row for row in graph.anchors if points["session"][row] == component)
            # a rotation that is multiplied at every solution drifts off without
            self.worlds[component] = orthonormal((poses[anchor] @ invert(graph.poses[anchor]))[None])[0]
            poses[of == component] = orthonormal(invert(self.worlds[component]) @ poses[of == component])
        return poses

    @staticmethod
    def _finished(sessions: Sessions, session: int) -> tuple[int, int]:
        """Number of the finished stretches of a session, and the stamp at the end of the last."""
        chain = sessions.chains[session]
        cell = int(chain.travel[-1] // STRETCH_M)
        return cell, int(chain.stamps[np.searchsorted(chain.travel, cell * STRETCH_M)])

    def _place(self, sessions: Sessions) -> bool:
        """Give every measurement whose odometry has arrived to its session; True where one is of a finished stretch."""
        waiting, changed, late = [], set(), False
        for one in self._waiting:
            session = sessions.find(one.stamp_ns)
            if session is None:
                waiting.append(one)
                continue
            track = self._tracks.setdefault((session, one.source), _Track())
            track.measurements.append(one)
            changed.add((session, one.source))
            late = late or one.stamp_ns < self._finished(sessions, session)[1]
        self._waiting = waiting
        for key in changed:
            self._tracks[key].measurements.sort(key=lambda one: one.stamp_ns)
        return late

    def _judge_all(self, sessions: Sessions, at_last: bool) -> bool:
        """Decide about the tracks; returns whether other measurements than before are accepted, or others averages."""
        before = {key: {cell: numbers for cell, (numbers, _) in track.factors.items()} for key, track in self._tracks.items()}
        # gravity before GNSS: both may say how the map lies in the world, and GNSS says more
        for (session, source), track in sorted(self._tracks.items(), key=lambda item: (item[0][1] != Source.GRAVITY, item[0][0])):
            self._judge(session, source, track, sessions, at_last)
        after = {key: {cell: numbers for cell, (numbers, _) in track.factors.items()} for key, track in self._tracks.items()}
        return before != after

    def _judge(self, session: int, source: Source, track: _Track, sessions: Sessions, at_last: bool) -> None:
        """Decide about the measurements of one source in one session."""
        chain = sessions.chains[session]
        stamps = np.array([one.stamp_ns for one in track.measurements], np.int64)
        points = chain.at(stamps)
        cells = (points["travel"] // STRETCH_M).astype(int)
        ends = int(chain.travel[-1] // STRETCH_M) + at_last
        measured = self._measured(source, track)
        variances = np.array([np.diag(one.covariance) for one in track.measurements])
        levers = np.array([one.lever for one in track.measurements])
        rotations = points["pose"][:, :3, :3]
        poses = sessions.at(points)
        component = sessions.components[session]
        count = len(stamps)
        track.states = [State.PENDING] * count
        track.reasons = [AbsoluteReason.INCOMPLETE] * count
        track.residuals, track.misfits = np.full((2, count), np.nan)
        done = cells < ends
        if source is Source.GNSS:
            if component not in self.worlds or not self._has_gnss(component, sessions):
                world = self._align(measured[done], poses[done], levers[done], variances[done], points["travel"][done], cells[done])
                if world is None:
                    track.reasons = [AbsoluteReason.NOT_ALIGNED] * count
                    track.factors = {}
                    return
                self.worlds[component] = world
            world = self.worlds[component]
            rotations = world[:3, :3] @ poses[:, :3, :3]
            steps = invert(points["pose"][:-1]) @ points["pose"][1:]
            walked = np.cumsum(np.concatenate([np.zeros((1, 3)), _apply(rotations[:-1], steps[:, :3, 3])]), axis=0)
            values = measured - walked - _apply(rotations, levers)
        else:
            values = _apply(rotations, measured)
        names, of_cell = np.unique(cells[done], return_inverse=True)
        rows_done = np.flatnonzero(done)
        groups = [rows_done[of_cell == number] for number in range(len(names))]
        middles = np.array([np.median(values[rows], axis=0) for rows in groups]).reshape(-1, 3)
        scale = _scatter(values, variances, middles, groups)
        variances = variances * scale**2
        spreads = np.array([variances[rows].mean(axis=0) / min(len(rows), _MOST_COUNTED) for rows in groups]).reshape(-1, 3)
        travel = np.array([points["travel"][rows].mean() for rows in groups])
        members = longest_chain(middles, spreads, travel, self._drift[source])
        firm = supported(members, spreads, travel, self._drift[source])
        state, reason = self._mounting(source, track, middles[members], rotations, groups, members, travel)
        misfits, distances = self._to_map(source, component, measured, poses, levers, variances)
        track.residuals, track.misfits = np.sqrt(distances), misfits
        track.factors = {}
        for number, rows in enumerate(groups):
            cell = int(names[number])
            if not (members[number] and firm[number]) or state is not State.ACCEPTED:
                known = (State.REJECTED, AbsoluteReason.JUMPED) if not members[number] else (State.PENDING, AbsoluteReason.UNSURE)
                _assign(track, rows, *(known if not (members[number] and firm[number]) else (state, reason)))
                continue
            near = ((values[rows] - middles[number]) ** 2 / variances[rows]).sum(axis=1) <= GATE
            agrees = near & ((distances[rows] <= GATE) if cell in track.solved else True)
            _assign(track, rows[~near], State.REJECTED, AbsoluteReason.JUMPED)
            _assign(track, rows[near & ~agrees], State.REJECTED, AbsoluteReason.CONTRADICTS)
            if 2 * agrees.sum() < len(rows):  # of a stretch whose measurements are mostly wrong the others are not believed
                _assign(track, rows[agrees], State.REJECTED, AbsoluteReason.CONTRADICTS)
                continue
            kept = rows[agrees]
            _assign(track, kept, State.ACCEPTED, AbsoluteReason.AGREES)
            track.solved.add(cell)
            reference = chain.at(chain.stamps[_reference(chain.travel, cell)][None])
            there = invert(reference["pose"]) @ points["pose"][kept]
            counted = min(len(kept), _MOST_COUNTED)
            covariance = np.mean([track.measurements[row].covariance for row in kept], axis=0) * scale**2 / counted
            stamp = int(reference["stamp"][0])
            track.factors[cell] = self._averaged(source, session, stamp, measured[kept], levers[kept], there, covariance)
        if source is Source.GRAVITY and track.factors and component not in self.worlds:
            up = np.mean(_apply(poses[:, :3, :3], measured)[[s is State.ACCEPTED for s in track.states]], axis=0)
            self.worlds[component] = _upright(up)

    def _measured(self, source: Source, track: _Track) -> Array:
        """(N, 3) positions in the world, or upward directions in the body."""
        values = np.array([one.value for one in track.measurements])
        if source is not Source.GNSS:
            return values
        if self.origin is None:
            self.origin = np.median(values[:5], axis=0)
            if self._settings.elevation_model and self._model is None:
                self._load_model()
        return to_enu(values, self.origin)

    def _load_model(self) -> None:
        settings = self._settings
        self._model = load_elevation(Path(settings.elevation_model), settings.elevation_sigma_m, self.origin)

    def _has_gnss(self, component: int, sessions: Sessions) -> bool:
        """Whether accepted fixes hold a component in the world."""
        return any(
            track.factors and sessions.components[session] == component
            for (session, source), track in self._tracks.items()
            if source is Source.GNSS
        )

    def _align(
        self, measured: Array, poses: Array, levers: Array, variances: Array, travel: Array, cells: NDArray[np.int64]
    ) -> Array | None:
        """`world_T_map` by the newest stretches; None where they do not tell."""
        names = np.unique(cells)[-_ALIGNED_STRETCHES:]
        if not len(names):
            return None
        mapped = poses[:, :3, 3] + _apply(poses[:, :3, :3], levers)
        groups = [cells == name for name in names]
        world, here = (np.array([np.median(one[rows], axis=0) for rows in groups]) for one in (measured, mapped))
        spreads = np.array([variances[rows].mean(axis=0) / min(rows.sum(), _MOST_COUNTED) for rows in groups])
        path = np.array([travel[rows].mean() for rows in groups])
        direction = find_heading(world, here, spreads, path, self._drift[Source.GNSS])
        if direction is None:
            return None
        rotation = turned(np.eye(3), direction).T
        return make_pose(rotation, np.median(world - here @ rotation.T, axis=0))

    def _mounting(
        self,
        source: Source,
        track: _Track,
        values: Array,
        rotations: Array,
        groups: list[NDArray[np.int64]],
        members: NDArray[np.bool_],
        travel: Array,
    ) -> tuple[State, AbsoluteReason]:
        """Whether a source may be accepted, by what its error does when the rover turns."""
        large, well_known = _MOUNTING[source]
        if track.mounting is not None:
            return State.REJECTED, AbsoluteReason.MOUNTING
        if len(values) < _FEW_STRETCHES:
            known = source is Source.GNSS  # an antenna that is off does little before the rover has turned
            return (State.ACCEPTED, AbsoluteReason.AGREES) if known else (State.PENDING, AbsoluteReason.NOT_TURNED)
        turns = np.array([rotations[rows[len(rows) // 2]] for rows, member in zip(groups, members, strict=True) if member])
        offset, covariance = body_offset(values, turns, travel[members])
        offset, covariance = offset[:2], covariance[:2, :2]  # along the vertical, the rover does not turn
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance).max()))
        significant = float(offset @ np.linalg.solve(covariance, offset)) > GATE
        if significant and sigma < well_known and np.linalg.norm(offset) > large:
            track.mounting = offset
            return State.REJECTED, AbsoluteReason.MOUNTING
        if source is Source.GRAVITY and sigma > well_known:
            return State.PENDING, AbsoluteReason.NOT_TURNED
        return State.ACCEPTED, AbsoluteReason.AGREES

    def _to_map(
        self, source: Source, component: int, measured: Array, poses: Array, levers: Array, variances: Array
    ) -> tuple[Array, Array]:
        """(N,) misfits of measurements to the solved map, and (N,) squared Mahalanobis distances; NaN without a world."""
        if component not in self.worlds:
            return np.full(len(measured), np.nan), np.full(len(measured), np.nan)
        there = self.worlds[component] @ poses
        if source is Source.GNSS:
            missed = measured - there[:, :3, 3] - _apply(there[:, :3, :3], levers)
        else:
            missed = _apply(there[:, :3, :3], measured) - [0.0, 0.0, 1.0]
        return np.linalg.norm(missed, axis=1), (missed**2 / variances).sum(axis=1)

    def _averaged(
        self, source: Source, session: int, stamp: int, measured: Array, levers: Array, there: Array, covariance: Array
    ) -> tuple[tuple[float, ...], _Factor]:
        """The factor of a stretch: of a rigid path, the mean of positions is that of a lever that is the mean of theirs.

        `there` (N, 4, 4) are the poses of the body at the measurements, in the body frame of the factor's pose.
        """
        if source is Source.GNSS:
            mean = measured.mean(axis=0)
            lever = (there[:, :3, 3] + _apply(there[:, :3, :3], levers)).mean(axis=0)
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance + 0.05**2 * np.eye(3))

            def make(vertex: int) -> gtsam.NonlinearFactor:
                return gtsam.GPSFactorArm(vertex, mean, lever, noise)

            numbers = (*mean, *lever, *np.diag(covariance))
        else:
            up = _apply(there[:, :3, :3], measured).mean(axis=0)
            tilt = gtsam.noiseModel.Isotropic.Sigma(2, float(np.sqrt(covariance.trace() / 3)))

            def make(vertex: int) -> gtsam.NonlinearFactor:
                return gtsam.AttitudeFactorPose3(vertex, gtsam.Unit3([0, 0, 1]), tilt, gtsam.Unit3(up))

            numbers = (*up, covariance.trace())
        return tuple(round(float(number), 6) for number in (stamp, *numbers)), _Factor(session, stamp, source, make)

    def _factors(self) -> Iterator[_Factor]:
        """Everything that is accepted."""
        for track in self._tracks.values():
            yield from (factor for _, factor in track.factors.values())
        for heights in self._heights.values():
            if heights.fits:
                for session, stamp in heights.residuals:
                    yield _Factor(session, stamp, Source.ELEVATION, lambda _: None)

    def _first_pose_noise(self, pose: Array, kinds: set[Source]) -> gtsam.noiseModel.Base:
        """Noise of the first pose of a component, which some sources leave where it is and others find out."""
        tilt, turn, across, up = _START_RAD, _FIXED, _FIXED, _FIXED
        if Source.ELEVATION in kinds:
            turn, across, up = _START_RAD, _START_M, _FREE
        if Source.GNSS in kinds:
            tilt = turn = 10 * _START_RAD
            across = up = _FREE
        if Source.GRAVITY in kinds:
            tilt = 10 * _START_RAD
        covariance = np.diag(np.square([tilt, tilt, turn, across, across, up]))
        axes = np.kron(np.eye(2), pose[:3, :3].T)  # from the axes of the world to those of the body
        return gtsam.noiseModel.Gaussian.Covariance(axes @ covariance @ axes.T)

    def _judge_heights(
        self, model: ElevationModel, component: int, sessions: Sessions, solve: Callable[[], None], at_last: bool
    ) -> None:
        """Test whether an elevation model fits the path, solve with it where it does, and judge its heights."""
        if component not in self.worlds or (self._start is not None and not self._has_gnss(component, sessions)):
            if self._start is None or (component in self._heights and component in self.worlds):
                if component not in self._heights:
                    return
            else:
                self._begin_at_start(model, component, sessions)
        heights = self._heights.setdefault(component, _Heights())
        known = len(heights.residuals)
        for session in sessions.members(component):
            chain = sessions.chains[session]
            for cell in range(int(chain.travel[-1] // STRETCH_M)):
                stamp = int(chain.stamps[_reference(chain.travel, cell)])
                heights.residuals.setdefault((session, stamp), (np.nan, np.nan))
        count = len(heights.residuals)
        due = count > heights.tested if at_last else count >= _RETEST * heights.tested
        if count < _FEW_STRETCHES or not due:
            if heights.fits and count > known:
                solve()
            return
        self._test(model, component, sessions, solve)

    def _test(self, model: ElevationModel, component: int, sessions: Sessions, solve: Callable[[], None]) -> None:
        """Solve with the heights, and take that back where they do not fit, or fit elsewhere as well.

        The first time, the model is tried at other places too: heights that fit there say nothing.
        """
        heights = self._heights[component]
        known, count = heights.fits, len(heights.residuals)
        heights.tested, heights.fits = count, False
        solve()
        before = sessions.snapshot(), self.worlds[component].copy(), sessions.cost
        elsewhere = np.inf
        for shift in _ELSEWHERE_M if not known else ():
            added, inside = self._cost_of(model.shifted(shift), component, sessions, solve, before[2])
            elsewhere = min(elsewhere, added if inside else np.inf)
            self._take_back(component, sessions, before)
        added, inside = self._cost_of(model, component, sessions, solve, before[2])
        evidence = 0.5 * count * (elsewhere - added)
        right = inside and added <= _MOST_COST and self._fitting(model, component, sessions) >= _LEAST_FITTING
        heights.fits = True if right and (known or evidence >= _EVIDENCE) else None if right else False
        if not heights.fits:
            self._take_back(component, sessions, before)
            solve()

    def _cost_of(
        self, model: ElevationModel, component: int, sessions: Sessions, solve: Callable[[], None], cost: float
    ) -> tuple[float, bool]:
        """Cost per height that a model adds to a cost without, and whether it covers the path."""
        heights, given = self._heights[component], self._model
        heights.fits, self._rounds, self._model = True, _TRIAL_ROUNDS, model
        try:
            solve()
            inside = self._fitting(model, component, sessions) > 0
            return 2 * (sessions.cost - cost) / len(heights.residuals), inside
        except GraphError:
            return np.inf, False
        finally:
            heights.fits, self._rounds, self._model = False, _ROUNDS, given

    def _take_back(self, component: int, sessions: Sessions, before: tuple[Any, Array, float]) -> None:
        sessions.restore(before[0])
        self.worlds[component] = before[1].copy()

    def _begin_at_start(self, model: ElevationModel, component: int, sessions: Sessions) -> None:
        """Say how a component lies in the world by the start pose of the parameters."""
        assert self._start is not None
        chain = sessions.chains[component]
        first = sessions.at(chain.at(chain.stamps[:1]))[0]
        tilt = self.worlds.get(component, np.eye(4))[:3, :3]
        x, y, degrees = self._start
        turn = turned(np.eye(3), np.deg2rad(degrees) - float(heading(make_pose(tilt, np.zeros(3)) @ first))).T @ tilt
        height = model.at(np.array([[x, y]]))[0][0]
        position = np.array([x, y, height if np.isfinite(height) else 0.0])
        self.worlds[component] = make_pose(turn, position - turn @ first[:3, 3])

    def _fitting(self, model: ElevationModel, component: int, sessions: Sessions, newest: int = 0) -> float:
        """Measure all heights against the map; returns the share that fit, of all or of the newest."""
        heights = self._heights[component]
        keys = list(heights.residuals)
        poses = []
        for session in dict.fromkeys(session for session, _ in keys):
            stamps = np.array([stamp for one, stamp in keys if one == session], np.int64)
            poses.append(self.worlds[component] @ sessions.at(sessions.chains[session].at(stamps)))
        missed, sigmas, known = self._compare(model, np.concatenate(poses), self._datum_free(component, sessions))
        residuals = np.where(known, missed / sigmas, np.nan)
        for key, residual, miss in zip(keys, residuals.tolist(), missed.tolist(), strict=True):
            heights.residuals[key] = abs(residual), abs(miss)
        chosen = residuals[-newest:]
        inside = np.isfinite(chosen)
        return float((np.abs(chosen[inside]) <= _HEIGHT_GATE).mean()) if 2 * inside.sum() >= len(chosen) else 0.0

    def _datum_free(self, component: int, sessions: Sessions) -> bool:
        """Whether heights of the model count from elsewhere: GNSS counts from the ellipsoid, maps from the geoid."""
        return self._has_gnss(component, sessions)

    @staticmethod
    def _compare(model: ElevationModel, poses: Array, datum_free: bool) -> tuple[Array, Array, NDArray[np.bool_]]:
        """(N,) m by which world poses (N, 4, 4) are above the model, their sigmas, and whether they are inside."""
        ground, slopes, known = model.at(poses[:, :2, 3])
        missed = np.where(known, poses[:, 2, 3] - ground, 0.0)
        if datum_free and known.any():
            missed = missed - np.median(missed[known])
        # between the middles of cells a slope is known to a quarter of a cell (*by hand*)
        sigmas = np.hypot(model.sigma_m, 0.25 * model.cell_m * np.where(known, np.linalg.norm(slopes, axis=1), 0.0) ** 1)
        return missed, sigmas, known

    def _height_factors(
        self, poses: Array, heights: list[tuple[int, int]], sources: dict[int, set[Source]]
    ) -> list[tuple[int, Callable[[int], gtsam.NonlinearFactor]]]:
        """The ground as planes, one at each pose: tightly known across, hardly along."""
        made: list[tuple[int, Callable[[int], gtsam.NonlinearFactor]]] = []
        for component in {component for _, component in heights} if self._model is not None else ():
            rows = np.array([row for row, one in heights if one == component])
            missed, sigmas, known = self._compare(self._model, poses[rows], Source.GNSS in sources[component])
            slopes = self._model.at(poses[rows, :2, 3])[1]
            for row, miss, sigma, slope in zip(rows[known].tolist(), missed[known], sigmas[known], slopes[known], strict=True):
                point = poses[row, :3, 3] - [0.0, 0.0, miss]
                normal = np.array([-slope[0], -slope[1], 1.0])
                size = float(np.linalg.norm(normal))
                across = np.outer(normal, normal) / size**2
                spread = (sigma / size) ** 2 * across + _TANGENT_M**2 * (np.eye(3) - across)
                noise = gtsam.noiseModel.Robust.Create(
                    gtsam.noiseModel.mEstimator.Huber.Create(_HUBER), gtsam.noiseModel.Gaussian.Covariance(spread)
                )
                made.append((row, lambda vertex, point=point, noise=noise: gtsam.GPSFactorArm(vertex, point, np.zeros(3), noise)))
        return made

    @staticmethod
    def _height_verdict(heights: _Heights, stamp: int, residual: float, miss: float) -> AbsoluteVerdict:
        if heights.fits is None:
            state, reason = State.PENDING, AbsoluteReason.UNSURE
        elif not heights.fits:
            state, reason = State.REJECTED, AbsoluteReason.MISFIT
        elif np.isnan(residual):
            state, reason = State.REJECTED, AbsoluteReason.OUTSIDE
        else:
            fits = residual <= _HEIGHT_GATE
            state = State.ACCEPTED if fits else State.REJECTED
            reason = AbsoluteReason.AGREES if fits else AbsoluteReason.CONTRADICTS
        return AbsoluteVerdict(Source.ELEVATION, stamp, state, reason, residual, miss)


def _apply(rotations: Array, vectors: Array) -> Array:
    """(N, 3) vectors turned by (N, 3, 3)."""
    return (rotations @ vectors[..., None])[..., 0]


def _reference(travel: Array, cell: int) -> int:
    """Row of the keyframe in the middle of a stretch."""
    return min(int(np.searchsorted(travel, (cell + 0.5) * STRETCH_M)), len(travel) - 1)


def _scatter(values: Array, variances: Array, middles: Array, groups: list[NDArray[np.int64]]) -> float:
    """By how much measurements scatter more than they state: one at least."""
    ratios = [
        np.abs(values[rows] - middles[number]) / np.sqrt(variances[rows])
        for number, rows in enumerate(groups)
        if len(rows) > 2
    ]
    scale = max(1.0, 1.4826 * float(np.median(np.concatenate(ratios)))) if ratios else 1.0
    return float(1.2 ** np.ceil(np.log(scale) / np.log(1.2)))  # in steps, so that averages stay as they are


def _assign(track: _Track, rows: NDArray[np.int64], state: State, reason: AbsoluteReason) -> None:
    for row in rows.tolist():
        track.states[row], track.reasons[row] = state, reason


def _upright(up: Array) -> Array:
    """(4, 4) rotation, without a heading of its own, that turns a direction to the vertical."""
    up = up / np.linalg.norm(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    return make_pose(gtsam.Rot3.Expmap(axis / max(float(np.linalg.norm(axis)), 1e-12) * np.arccos(np.clip(up[2], -1, 1))).matrix(), np.zeros(3))
