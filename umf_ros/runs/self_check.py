"""Judge the closures of a run from the run itself, where there is no ground truth.

Three kinds of evidence tell whether a closure is right, none of which it gives itself:

- loops through other closures and the odometry between them: their residuals fit the covariances, or those of a loop
  with a wrong closure. Closures of one place depend on each other, so that a place counts once, and its closures speak
  for each other a little only;
- overlap of the local maps at the pose of the closure, scans of the path around its keyframes placed by odometry;
- overlap at poses some metres beside: at the right pose it is larger.

All closures are judged together: what a closure says counts as far as it is believed itself. The weights are fitted on
simulated runs with planted wrong closures (`benchmarks/accuracy/self_check.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from umf_ros.absolute.reference import AbsoluteReference
from umf_ros.core.config import PoseGraphSettings, load_settings
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, cubes, evenly, first_of_cubes, invert, transform
from umf_ros.core.io import write_table
from umf_ros.pose_graph.closures import Closures, PlacedClosure, as_closures
from umf_ros.pose_graph.consistency import loops_between, paths_between, squared_mahalanobis
from umf_ros.pose_graph.sessions import Sessions
from umf_ros.runs.reader import read_trajectory
from umf_ros.runs.run_file import SCAN_UNIT_M, RunFile
from umf_ros.scan._kernels import KdTree
from umf_ros.sensors.sessions import OdometrySessionSplitter

TABLE = "self_check.csv"
COLUMNS = ("query_stamp_ns", "match_stamp_ns", "probability", "support", "overlap", "overlap_beside")
# loops, by hand: standard deviations of the residual with a wrong closure beyond its noise, rad and m; factor of the
# stated noise of closures; closures that one is compared with
_WRONG, _CLOSURE_NOISE, _MOST_COMPARED = np.diag([0.3] * 3 + [5.0] * 3) ** 2, 1.5, 60
# nats: of one place for and against a closure, of closures of its own place for it, of all places for and against it.
# Loops of tens of metres agree with poses that are off by a metre: overlap has to say more for a closure (*by hand*)
_PER_PLACE, _OF_OWN_PLACE, _MOST_FOR, _MOST_AGAINST = 4.0, 1.0, 2.0, 12.0
_ROUNDS, _DAMPING = 15, 0.7
# local maps, by hand: metres of path to each side, and scans there; sides of cubes that keep a point, and of columns in
# which both maps see something; points compared, at most and at least; distance of a matched point; poses beside, m
_REACH_M, _SCANS, _CUBE_M, _COLUMN_M, _COMPARED, _FEWEST, _NEAR_M = 8.0, 12, 0.2, 1.0, 600, 50, 0.2
_BESIDE = [(m * np.cos(a), m * np.sin(a), 0.0) for m in (1, 2, 3) for a in np.arange(8) * np.pi / 4]
_SHIFTS_M = np.array([(0.0, 0.0, 0.0), *_BESIDE])
# closures whose local maps are compared, evenly chosen, and local maps in memory: a minute and 20 MB
_MOST_OVERLAPS, _MAPS_KEPT = 2000, 64
# log-odds by overlap, of that which the best quarter of closures reach, and by overlap less that beside: fitted on the
# runs of seeds 10001 to 10004, whose right closures have .69 or more of it, and planted ones .55 or less; without scans
_OFFSET, _BY_OVERLAP, _BY_CONTRAST, _REACHED, _LEAST_REACHED = -6.0, 11.7, 4.6, 0.75, 0.5
_USUAL = np.log(9.0)
_Z = 1.96


@dataclass(frozen=True)
class SelfCheck:
    """Closures of a run, judged by the run.

    Attributes:
        closures: those with odometry at both keyframes.
        probabilities: (N,) that each is right.
        support: (N,) nats by which closures of other places agree with it; negative: they contradict it.
        overlaps: (N,) share of matched points of its local maps; NaN without scans, and where they show nothing in
            common, as those of a narrow sensor that looks the other way.
        beside: (N,) the largest at poses 1 to 3 m beside.
    """

    closures: list[LoopClosure]
    probabilities: Array
    support: Array
    overlaps: Array
    beside: Array

    @property
    def doubted(self) -> list[int]:
        """Rows of closures that are more likely wrong than right, the least likely first."""
        rows = np.argsort(self.probabilities, kind="stable")
        return [int(row) for row in rows if self.probabilities[row] < 0.5]

    @property
    def precision(self) -> tuple[float, float, float]:
        """Estimated share of right closures, and its 95 % interval (Wilson's); NaN without closures."""
        if not (count := len(self.closures)):
            return (float("nan"),) * 3
        share, spread = float(self.probabilities.mean()), _Z**2 / count
        middle, half = share + spread / 2, _Z * np.sqrt(share * (1 - share) / count + spread / (4 * count))
        return share, float((middle - half) / (1 + spread)), float((middle + half) / (1 + spread))

    @property
    def sentence(self) -> str:
        """The result in one line."""
        if not self.closures:
            return "not judged: no closures with odometry"
        share, low, high = self.precision
        counted = f"{len(self.doubted)} of {len(self.closures)} closures doubted"
        return f"precision {share:.2f} (95 %: {low:.2f} to {high:.2f}), {counted}; judged from the run itself"

    def describe(self, row: int) -> str:
        """Return one line about a closure."""
        closure = self.closures[row]
        seconds = (closure.query_stamp_ns - closure.match_stamp_ns) * 1e-9
        text = f"closure {closure.match_stamp_ns} {closure.query_stamp_ns}, {seconds:.1f} s back: "
        text += f"p = {self.probabilities[row]:.3f}, other places {self.support[row]:+.1f} nats"
        if np.isnan(self.overlaps[row]):
            return text
        return f"{text}, overlap {self.overlaps[row]:.0%}, beside {self.beside[row]:.0%}"

    def write(self, path: Path) -> None:
        """Write the table of all closures."""
        numbers = zip(self.probabilities, self.support, self.overlaps, self.beside, strict=True)
        figures = ([f"{number:.4f}" for number in row] for row in numbers)
        write_table(path, COLUMNS, ([*one.endpoints, *row] for one, row in zip(self.closures, figures, strict=True)))


def check_run(folder: Path) -> SelfCheck:
    """Judge the closures of a run.

    Raises:
        UmfError: the folder holds no run, or it is damaged.
    """
    settings = load_settings(folder / "config.yaml").pose_graph
    with closing(RunFile(folder, read_only=True)) as file:
        sessions = Sessions(settings, AbsoluteReference(settings))
        take: Any = lambda *sample: sessions.chains[-1].add(*sample)  # noqa: E731 - into the newest session
        splitter = OdometrySessionSplitter(cast(Any, SimpleNamespace(begin_session=sessions.begin, add_odometry=take)))
        samples = [(one.stamp_ns, one.odom_T_body) for one in file.odometry()]
        if not samples and (path := read_trajectory(folder / "trajectory_odometry.tum")):  # live, the back-end keeps it
            samples = list(zip(path.stamps_ns.tolist(), path.poses, strict=True))
        for stamp_ns, odom_T_body in samples:
            splitter.take(stamp_ns, odom_T_body)
        splitter.finish()
        scans = {one.stamp_ns: one.scan.astype(np.float32) * SCAN_UNIT_M for one in file.pictures()}
        return judge(sessions, file.closures(), scans, settings)


def judge(
    sessions: Sessions, closures: list[LoopClosure], scans: dict[int, Array], settings: PoseGraphSettings
) -> SelfCheck:
    """Judge closures by the odometry of sessions and by scans (N, 3) at keyframes, body frame."""
    sessions.update()
    stamps = np.array([closure.pair for closure in closures], np.int64).reshape(-1, 2)
    matches, queries = sessions.find_pairs(stamps)
    rows = np.flatnonzero(np.minimum(matches, queries) >= 0).tolist()
    placed = [PlacedClosure(int(matches[row]), int(queries[row]), closures[row]) for row in rows]
    known = [as_closures(one, number, sessions.chains) for number, one in enumerate(placed)]
    kept = [closures[row] for row in rows]
    overlaps = _overlaps(placed, scans, sessions)
    prior = _by_overlap(overlaps)
    support = np.zeros(len(kept))
    beliefs = expit(prior)
    if known:
        everything = np.concatenate(known)
        hear = [_listener(everything, row, settings) for row in range(len(everything))]
        for _ in range(_ROUNDS):
            support = np.array([one(beliefs) for one in hear])
            beliefs += _DAMPING * (expit(prior + support) - beliefs)
    return SelfCheck(kept, beliefs, support, overlaps[:, 0], overlaps[:, 1])


def _by_overlap(overlaps: Array) -> Array:
    """Return (N,) log-odds of closures by their overlap and that beside (N, 2); usual ones where no scans tell."""
    known = overlaps[np.isfinite(overlaps[:, 0])]
    # what a sensor can reach differs: most closures are taken for right
    usual = max(float(np.quantile(known[:, 0], _REACHED)), _LEAST_REACHED) if len(known) else 1.0
    odds = _OFFSET + _BY_OVERLAP * np.minimum(overlaps[:, 0] / usual, 1.0)
    unknown = 0.0 if len(known) else _USUAL
    return np.nan_to_num(odds + _BY_CONTRAST * (overlaps[:, 0] - overlaps[:, 1]), nan=unknown)


def _listener(closures: Closures, row: int, settings: PoseGraphSettings) -> Callable[[Array], float]:
    """Return the nats of support of a closure by the others, as a function of beliefs (N,) in these."""
    paths_m = paths_between(closures, closures[row : row + 1])
    others = np.flatnonzero(paths_m.max(axis=0) <= settings.support_range_m)
    others = others[others != row]
    others = others[evenly(len(others), _MOST_COMPARED)]
    nats = _evidence(closures[row : row + 1], closures[others])
    own = paths_m[:, others].min(axis=0) < settings.place_m
    starts = np.minimum(*(closures[end]["travel"][others] for end in ("match", "query")))
    places = np.where(own, -1, np.floor(starts / settings.place_m).astype(int))

    def hear(beliefs: Array) -> float:
        told, total = beliefs[others] * nats, 0.0
        for place in np.unique(places):
            of_place = told[places == place]
            most = _OF_OWN_PLACE if place < 0 else _PER_PLACE
            total += min(float(of_place.max(initial=0.0)), most) + max(float(of_place.min(initial=0.0)), -_PER_PLACE)
        return float(np.clip(total, -_MOST_AGAINST, _MOST_FOR))

    return hear


def _evidence(one: Closures, others: Closures) -> Array:
    """Return (N,) log-likelihood ratios of loops of a closure (1,) with others, both right over one of them wrong."""
    if not len(others):
        return np.empty(0)
    loops = loops_between(one, others)
    right = loops["odometry"] + _CLOSURE_NOISE**2 * loops["closures"] + loops["drift"]
    wrong = right + _WRONG
    gains = squared_mahalanobis(loops["residual"], wrong) - squared_mahalanobis(loops["residual"], right)
    return np.asarray(0.5 * (gains + np.linalg.slogdet(wrong)[1] - np.linalg.slogdet(right)[1]))


def _overlaps(placed: list[PlacedClosure], scans: dict[int, Array], sessions: Sessions) -> Array:
    """Return (N, 2) overlap of local maps at the poses of closures, and the largest beside; NaN without scans."""
    stamps, found = np.array(sorted(scans), np.int64), np.full((len(placed), 2), np.nan)

    @lru_cache(_MAPS_KEPT)
    def local_map(session: int, stamp_ns: int) -> NDArray[np.floating]:
        return _local_map(sessions, session, stamp_ns, stamps, scans)

    for row in evenly(len(placed), _MOST_OVERLAPS).tolist():
        match, query, closure = placed[row]
        theirs, ours = local_map(match, closure.match_stamp_ns), local_map(query, closure.query_stamp_ns)
        if min(len(theirs), len(ours)) >= _FEWEST:
            found[row] = _overlap(theirs, ours[evenly(len(ours), _COMPARED)], closure.match_T_query)
    return found


def _local_map(
    sessions: Sessions, session: int, stamp_ns: int, stamps: NDArray[np.int64], scans: dict[int, Array]
) -> NDArray[np.floating]:
    """Return points (N, 3) of scans on the path around a stamp, in its body frame."""
    chain = sessions.chains[session]
    known = stamps[chain.covers(stamps)]
    here, points = chain.at(np.array([stamp_ns])), chain.at(known)
    near = np.flatnonzero(np.abs(points["travel"] - here["travel"]) <= _REACH_M)
    near = near[evenly(len(near), _SCANS)]
    steps = invert(here["pose"]) @ points["pose"][near]
    merged = [np.empty((0, 3), np.float32)]
    merged += [transform(step, scans[stamp]) for step, stamp in zip(steps, known[near].tolist(), strict=True)]
    cloud = np.concatenate(merged)
    return cloud[first_of_cubes(cloud.astype(float), _CUBE_M)]


def _overlap(theirs: NDArray[np.floating], ours: NDArray[np.floating], match_T_query: Array) -> tuple[float, float]:
    """Return the share of our points with one of theirs near, where both see something, and the largest beside.

    NaN where both see next to nothing.
    """
    moved = (transform(match_T_query, ours) + _SHIFTS_M[:, None]).astype(np.float32)
    inside = np.isin(_columns(moved.reshape(-1, 3)), np.unique(_columns(theirs))).reshape(moved.shape[:2])
    near = np.zeros(inside.shape, bool)
    tree = KdTree(np.ascontiguousarray(theirs))
    near[inside] = tree.nearest(np.ascontiguousarray(moved[inside]), _NEAR_M)[1] < _NEAR_M**2
    counts = inside.sum(axis=1)
    shares = np.where(counts < _FEWEST, 0.0, near.sum(axis=1) / np.maximum(counts, 1))
    return (float(shares[0]), float(shares[1:].max())) if counts[0] >= _FEWEST else (np.nan, np.nan)


def _columns(points: NDArray[np.floating]) -> NDArray[np.int64]:
    return cubes(points * (1.0, 1.0, 0.0), _COLUMN_M)
