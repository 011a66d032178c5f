"""Closures held against the solved map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array, invert, logmap
from umf_ros.pose_graph.closures import ClosureArrays, Endpoints, PoseSamples
from umf_ros.pose_graph.consistency import false_alarm_probability, likelihood_ratio, squared_mahalanobis
from umf_ros.pose_graph.gate_cache import GateCache, MapComparisons, Rows
from umf_ros.pose_graph.noise_scale import NoiseScale
from umf_ros.pose_graph.relative_poses import Bounds, RelativePoses
from umf_ros.pose_graph.sessions import Sessions


class MapComparer:
    """Says what the map makes of closures, and of which it would say something else than before.

    Args:
        arrays: the closures; a row is a number in them.
        sessions: whose paths are the map.
        settings: of the gates.
    """

    def __init__(self, arrays: ClosureArrays, sessions: Sessions, settings: PoseGraphSettings) -> None:
        self._arrays, self._sessions, self._settings = arrays, sessions, settings
        self._map: RelativePoses | None = None
        self._scale = NoiseScale()
        self._looks = GateCache()

    @property
    def has_map(self) -> bool:
        """Whether the sessions have been solved yet."""
        return self._map is not None

    def retune(self, settings: PoseGraphSettings) -> None:
        """Compare by other gates from now on."""
        self._settings = settings
        self.forget()

    def append(self) -> None:
        """One more closure, that nobody has looked at."""
        self._looks.append()

    def note(self, rows: Rows, found: MapComparisons) -> None:
        """Keep what the map says about some closures."""
        self._looks.note(rows, found)

    def forget(self, rows: Rows | slice = slice(None)) -> None:
        """What the map said about some closures, or all, does not count any more."""
        self._looks.forget(rows)

    def take_map(self, scale: NoiseScale, grown: NDArray[np.int64] | None, waiting: NDArray[np.int64]) -> None:
        """The sessions have been solved.

        Args:
            scale: of the stated noise, with which they were.
            grown: (N,) rows of the closures that came in; None where others went.
            waiting: (M,) rows of the closures that are not in the map.
        """
        self._map, self._scale = RelativePoses(self._sessions, scale), scale
        if grown is None:
            self._looks.forget()
            return
        rows = waiting[~self._looks["outdated"][waiting]]
        self._looks.shorten(rows, self._map.lengths_through(*self._stops(rows), *self._stops(grown)))

    def compare(self, rows: Sequence[int]) -> MapComparisons:
        """Hold closures against the map; what it says nothing about agrees with it, and so does anything."""
        chosen = np.array(rows, np.int64)
        misfits = self._misfits(chosen)
        covariances, lengths = self._bounds(chosen, self._looks.unbounded(chosen, misfits))
        known = np.isfinite(lengths)
        distances, metres = np.zeros(len(chosen)), np.zeros(len(chosen))
        false_alarms, ratios = np.ones(len(chosen)), np.ones(len(chosen))
        if known.any():
            distances[known] = squared_mahalanobis(logmap(misfits[known]), covariances[known])
            metres[known] = np.linalg.norm(misfits[known, :3, 3], axis=1)
            false_alarms[known] = false_alarm_probability(covariances[known], self._settings)
            ratios[known] = likelihood_ratio(false_alarms[known], distances[known], self._settings)
        return MapComparisons(distances, metres, false_alarms, ratios, known, misfits, covariances, lengths)

    def outdated(self, rows: NDArray[np.int64], within_m: float = np.inf) -> list[int]:
        """Those closures that the map misses by less, and about which it may say something else than before."""
        misfits = self._misfits(rows)
        close = np.linalg.norm(misfits[:, :3, 3], axis=1) < within_m
        rows = rows[close]
        return rows[self._looks.outdated(rows, misfits[close])].tolist()

    def poses(self, endpoints: Endpoints, rows: slice | NDArray[np.int64]) -> Array:
        """(N, 4, 4) `map_T_body` at one endpoint of closures."""
        sessions, stamps, points = endpoints.stops(rows)
        poses = np.zeros((len(sessions), 4, 4))
        for session in np.unique(sessions):
            mine = sessions == session
            poses[mine] = self._sessions.at(int(session), stamps[mine], points.of(mine))
        return poses

    def _misfits(self, rows: NDArray[np.int64]) -> Array:
        """(N, 4, 4) the map's poses of the queries of closures, seen from where the closures put them."""
        ways = invert(self.poses(self._arrays.match, rows)) @ self.poses(self._arrays.query, rows)
        return invert(self._arrays["pose"][rows]) @ ways

    def _bounds(self, rows: NDArray[np.int64], new: NDArray[np.bool_]) -> Bounds:
        """Bounds on the covariances of misfits; those that are not new are known."""
        assert self._map is not None
        found = Bounds(*(self._looks[name][rows] for name in ("covariance", "length")))
        if new.any():
            bounds = self._map.bounds(*self._stops(rows[new]))
            own = self._scale.closures**2 * self._arrays["covariance"][rows[new]]
            found.covariances[new] = bounds.covariances + own
            found.lengths[new] = bounds.lengths
        return found

    def _stops(self, rows: NDArray[np.int64]) -> tuple[PoseSamples, PoseSamples]:
        """Where the matches and the queries of closures are."""
        return self._arrays.match.stops(rows), self._arrays.query.stops(rows)
