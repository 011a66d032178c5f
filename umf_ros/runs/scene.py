"""Data of the report: trajectories, closures and pairs."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from umf_ros.core.frames import LoopClosure, Points
from umf_ros.core.geometry import Array, align, relative, rotation_angle
from umf_ros.core.trajectory import Trajectory
from umf_ros.pose_graph.closures import State
from umf_ros.runs.diagnosis import ClosureDiagnosis
from umf_ros.runs.findings import ExaminedRun
from umf_ros.runs.gallery import SCAN_UNIT_M, Gallery, Photograph
from umf_ros.runs.reader import FinishedRun
from umf_ros.runs.tables import Endpoints
from umf_ros.runs.truth import JudgedClosure, endpoints, positions_in_truth
from umf_ros.verification.hypothesis import Hypothesis

Kind = Literal["accepted", "pending", "rejected", "false", "missed", "tested"]
ORDER: tuple[Kind, ...] = ("false", "missed", "rejected", "pending", "tested", "accepted")
"""Of whose pictures come first where not all find room."""
MOST = {"missed": 60, "tested": 20, "accepted": 400}
"""Pairs of a kind that are explained in full."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two keyframes, and what became of them.

    Attributes:
        kind: how it is drawn.
        number: of the closure, from 1; 0 for what is none.
        pose: (4, 4) `match_T_query`, or None where no source knows it.
        pose_source: of the pose.
        closure, judged, candidate, why: what is known.
    """

    kind: Kind
    endpoints: Endpoints
    number: int
    pose: Array | None
    pose_source: str
    closure: LoopClosure | None = None
    judged: JudgedClosure | None = None
    candidate: Hypothesis | None = None
    why: ClosureDiagnosis | None = None


def pairs_of(about: ExaminedRun) -> list[Pair]:
    """Every closure, the missed revisits, and the most promising of what was rejected before it became one."""
    run, judged = about.run, about.judged.by_endpoints()
    tested = {one.endpoints: one for one in run.candidates}
    pairs = []
    for number, closure in enumerate(run.closures, 1):
        key = endpoints(closure)
        known = closure, judged.get(key), tested.get(key)
        pairs.append(
            Pair(_kind(about, key, judged.get(key)), key, number, closure.match_T_query, "the closure", *known)
        )
    pairs += _missed(about, tested)
    return pairs + _nearly(about, {pair.endpoints for pair in pairs}, {one.query_stamp_ns for one in run.closures})


def by_need(pairs: Sequence[Pair]) -> list[Pair]:
    """The pairs whose details are worth their room, the most telling first, spread over the run."""
    chosen: list[Pair] = []
    for kind in ORDER:
        mine = [pair for pair in pairs if pair.kind == kind]
        most = MOST.get(kind, len(mine))
        chosen += [mine[i] for i in _spread(len(mine), most)]
    return chosen


def _spread(count: int, most: int) -> Iterable[int]:
    """Up to `most` of `count`, coarse before fine: the first ones cover the whole run."""
    kept = np.linspace(0, count - 1, min(count, most)).astype(int).tolist() if count else []
    strides = [1 << power for power in range(len(kept).bit_length(), -1, -1)]
    return list(dict.fromkeys(kept[i] for stride in strides for i in range(0, len(kept), stride)))


def _kind(about: ExaminedRun, key: Endpoints, judged: JudgedClosure | None) -> Kind:
    if judged is not None and not judged.is_true:
        return "false"
    verdict = about.run.verdicts.get(key)
    if verdict is None or verdict.state == State.ACCEPTED:
        return "accepted"
    return "pending" if verdict.state == State.PENDING else "rejected"


def _missed(about: ExaminedRun, tested: dict[Endpoints, Hypothesis]) -> list[Pair]:
    found = [(why, (why.stamp_ns, why.match_stamp_ns)) for why in about.missed() if why.match_stamp_ns is not None]
    return [Pair("missed", key, 0, *_pose(about, key), candidate=tested.get(key), why=why) for why, key in found]


def _nearly(about: ExaminedRun, shown: set[Endpoints], found: set[int]) -> list[Pair]:
    """The most probable candidates of keyframes without a closure."""
    best: dict[int, Hypothesis] = {}
    for one in sorted(about.run.candidates, key=lambda one: -(one.probability or 0)):
        if one.query_stamp_ns not in found and one.endpoints not in shown and one.probability is not None:
            best.setdefault(one.query_stamp_ns, one)
    pairs = []
    for one in list(best.values())[: MOST["tested"]]:
        row = about.places.row(one.query_stamp_ns)
        why = about.gates.explain(row) if row is not None else None
        pairs.append(Pair("tested", one.endpoints, 0, *_pose(about, one.endpoints), candidate=one, why=why))
    return pairs


def _pose(about: ExaminedRun, key: Endpoints) -> tuple[Array | None, str]:
    """Where the two stood by the truth, else by the optimised trajectory: the run keeps no pose of what it rejected."""
    run = about.run
    with_turns = run.truth if run.truth is not None and run.truth.has_orientation else None
    for source, trajectory in (("the truth", with_turns), ("the optimised trajectory", run.optimized)):
        if trajectory is None:
            continue
        poses, known = trajectory.at(np.array(key, np.int64))
        if known.all():
            return relative(poses[1], poses[0]), source
    return None, ""


def describe(about: ExaminedRun, pair: Pair, full: bool) -> dict[str, Any]:
    """Describe a pair for the page; the bars and the pose only in full."""
    query, match = (about.places.row(stamp) for stamp in pair.endpoints)
    known, verdict = pair.closure or pair.candidate, about.run.verdicts.get(pair.endpoints)
    told: dict[str, Any] = {
        "kind": pair.kind,
        "number": pair.number,
        "q": query,
        "m": match,
        "stamps": [str(stamp) for stamp in pair.endpoints],  # no number of a browser holds nanoseconds
        "p": _number(known.probability if known else None),
        "s": _number(pair.candidate.candidate.similarity if pair.candidate else None),
        "graph": f"{verdict.state}: {verdict.reason}{verdict.figures}" if verdict else "",
        "truth": _truth_words(pair),
    }
    if pair.why is not None:
        told["why"], told["parameter"] = pair.why.what, pair.why.parameter
    if not full:
        return told
    if pair.candidate is not None:
        given, missing = about.gates.contributions(pair.candidate), about.gates.missing(pair.candidate)
        names = sorted({*given, *missing} - {"bias"}, key=lambda name: -(given.get(name, 0) + missing.get(name, 0)))
        told["bars"] = [[name, round(given.get(name, 0), 2), round(missing.get(name, 0), 2)] for name in names]
        told["bias"] = round(given.get("bias", 0), 2)
    if pair.pose is not None:
        told["pose"] = [round(float(value), 4) for value in pair.pose[:3].ravel()]
        told["pose_source"] = pair.pose_source
        shift_m, turn_deg = size_of(pair.pose)
        told |= {"shift_m": round(shift_m, 2), "turn_deg": round(turn_deg, 1)}
    return told


def size_of(pose: Array) -> tuple[float, float]:
    """Metres and degrees of a pose (4, 4)."""
    return float(np.linalg.norm(pose[:3, 3])), float(np.degrees(rotation_angle(pose)))


def _truth_words(pair: Pair) -> str:
    judged = pair.judged
    if judged is None:
        return "" if pair.why is None or not np.isfinite(pair.why.distance_m) else f"{pair.why.distance_m:.1f} m apart"
    turned = f", {judged.rotation_error_deg:.2f} deg" if np.isfinite(judged.rotation_error_deg) else ""
    return f"{'true' if judged.is_true else 'FALSE'}: {judged.translation_error_m:.2f} m{turned} off"


def _number(value: float | None) -> float | None:
    """A number for the page; None where it is unknown."""
    return None if value is None or not np.isfinite(value) else round(float(value), 4)


MAX_POINTS = 3000
"""Of a curve."""
MAX_SIDE = 300
"""Rows and columns of the matrix of similarities."""
MEDIA_BYTES = 3_600_000
"""Of all photographs and scans: with the drawing library a page of less than 10 MB."""
MAX_INLIERS = 60


def drawn_trajectory(about: ExaminedRun) -> Trajectory | None:
    """The best trajectory that a run has, in the frame that everything is drawn in."""
    run = about.run
    best = run.optimized or run.odometry
    if best is None:
        return run.truth
    if len(best) < 3:
        return best
    # the positions are the trajectory's own, moved rigidly
    moved = align(best.poses[:, :3, 3], positions_in_truth(best, run.truth))[0]
    return Trajectory(best.stamps_ns, np.asarray(moved @ best.poses), best.has_orientation)


def build_scene(
    about: ExaminedRun, pairs: list[Pair], gallery: Gallery, inliers: dict[Endpoints, Array]
) -> dict[str, Any]:
    """The scene: curves, keyframes, pairs with their pictures, matrix, threshold, errors and map."""
    photographs, scans = _media(pairs, gallery)
    full = {pair.endpoints for pair in by_need(pairs)}
    told = [describe(about, pair, pair.endpoints in full) for pair in pairs]
    for one, pair in zip(told, pairs, strict=True):
        lines = inliers.get(pair.endpoints)
        if lines is not None and str(pair.endpoints[0]) in photographs:
            chosen = np.linspace(0, len(lines) - 1, min(len(lines), MAX_INLIERS)).astype(int)
            one["inliers"] = np.rint(lines[chosen]).astype(int).tolist() if len(lines) else []
            one["inlier_count"] = len(lines)
    return {
        "curves": _curves(about.run),
        "keyframes": _keyframes(about),
        "pairs": told,
        "photographs": photographs,
        "scans": scans,
        "scan_unit_m": SCAN_UNIT_M,
        "similarity": _similarity(about.run.descriptors),
        "threshold": about.run.settings.verification.min_probability,
        "sweep": _sweep(about),
        "errors": error_curves(about.run) or None,
        "map": gallery.map_picture(),
    }


def _media(pairs: list[Pair], gallery: Gallery) -> tuple[dict[str, Photograph], dict[str, str]]:
    """Photographs and scans by stamp, of the most telling pairs first, as many as find room."""
    room = MEDIA_BYTES
    photographs: dict[str, Photograph] = {}
    scans: dict[str, str] = {}
    for stamp in dict.fromkeys(stamp for pair in by_need(pairs) for stamp in pair.endpoints):
        photograph, scan = gallery.photographs.get(stamp), gallery.scans.get(stamp, "")
        size = (len(photograph.address) if photograph else 0) + len(scan)
        if size <= room:
            room -= size
            scans[str(stamp)] = scan
            if photograph is not None:
                photographs[str(stamp)] = photograph
    return photographs, scans


def named_curves(run: FinishedRun) -> dict[str, Array]:
    """Positions (N, 3) of truth, odometry and optimised trajectory, as far as there are, in the frame of the truth."""
    known = {"ground truth": run.truth, "odometry": run.odometry, "optimised": run.optimized}
    return {name: positions_in_truth(one, run.truth) for name, one in known.items() if one is not None}


def _curves(run: FinishedRun) -> list[dict[str, Any]]:
    return [{"name": name, "xyz": _thin(positions).T.tolist()} for name, positions in named_curves(run).items()]


def _keyframes(about: ExaminedRun) -> dict[str, Any]:
    run, places = about.run, about.places
    start = int(places.stamps[0]) if len(places.stamps) else 0
    best: dict[int, float] = {}
    for one in run.candidates:
        best[one.query_stamp_ns] = max(best.get(one.query_stamp_ns, -1.0), one.candidate.similarity)
    return {
        "t": [round((int(stamp) - start) * 1e-9, 3) for stamp in places.stamps],
        "xy": np.round(_positions(about), 3).tolist(),
        "way": [_number(row.path_length_m) for row in run.keyframes],
        "similarity": [_number(best.get(int(stamp))) for stamp in places.stamps],
        "latency": [_number(run.latencies_ms.get(int(stamp))) for stamp in places.stamps],
    }


def _positions(about: ExaminedRun) -> Array:
    """(N, 2) of the keyframes where they are drawn; on a circle where their poses are unknown."""
    stamps, drawn = about.places.stamps, drawn_trajectory(about)
    if drawn is not None:
        poses, known = drawn.at(stamps)
        if known.any():
            rows = np.flatnonzero(known)
            xy: Array = poses[:, :2, 3]
            for axis in range(2):  # what lies before the first known pose is drawn there
                xy[:, axis] = np.interp(np.arange(len(stamps)), rows, xy[rows, axis])
            return xy
    angle = np.linspace(0, 2 * np.pi, max(len(stamps), 1), endpoint=False)
    return 10 * np.column_stack([np.sin(angle), np.cos(angle)])[: len(stamps)]


def _similarity(descriptors: Points | None) -> dict[str, Any] | None:
    if descriptors is None or not len(descriptors):
        return None
    rows = np.unique(np.linspace(0, len(descriptors) - 1, MAX_SIDE).astype(int))
    matrix = np.clip(np.rint(100 * descriptors[rows] @ descriptors[rows].T), -100, 100).astype("<i1")
    return {"rows": rows.tolist(), "data": base64.b64encode(matrix.tobytes()).decode("ascii")}


def _sweep(about: ExaminedRun) -> list[list[float | int]]:
    """Per keyframe with candidates: best probability, 1 or 0 for the same place or not and -1 for unknown, revisit."""
    rows: list[list[float | int]] = []
    right = {one.closure.query_stamp_ns: one.is_true for one in about.judged.closures}
    for row, stamp in enumerate(map(int, about.places.stamps)):
        best, revisit = about.gates.most_probable(stamp), int(len(about.places.same_places(row)) > 0)
        if best is None:
            if revisit:
                rows.append([0, 0, 1])
            continue
        same = about.places.is_same_place(stamp, best.match_stamp_ns)
        if best.accepted and stamp in right:
            same = right[stamp]
        rows.append([round(best.probability or 0, 4), -1 if same is None else int(same), revisit])
    return rows


def error_curves(run: FinishedRun) -> dict[str, list[list[float]]]:
    """Path length in m and distance from the truth in m, of odometry and optimised trajectory as far as there are."""
    told: dict[str, list[list[float]]] = {}
    for name, trajectory in (("odometry", run.odometry), ("optimised", run.optimized)):
        if trajectory is None or run.truth is None:
            continue
        poses, known = run.truth.at(trajectory.stamps_ns)
        if np.count_nonzero(known) < 3:
            continue
        true = poses[known, :3, 3]
        path_m = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
        error_m = np.linalg.norm(positions_in_truth(trajectory, run.truth)[known] - true, axis=1)
        told[name] = _thin(np.column_stack([path_m, error_m])).T.tolist()
    return told


def _thin(rows: Array) -> Array:
    """Some of the rows (N, C), to a millimetre."""
    kept = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_POINTS)).astype(int))]
    return np.asarray(np.round(kept, 3))
