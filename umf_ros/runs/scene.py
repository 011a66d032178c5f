"""Data of the report: trajectories, closures and pairs."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, align, relative, rotation_angle
from umf_ros.core.trajectory import Trajectory
from umf_ros.pose_graph.closures import State
from umf_ros.runs.diagnosis import ClosureDiagnosis
from umf_ros.runs.findings import PENDING, ExaminedRun
from umf_ros.runs.gallery import SCAN_UNIT_M, Gallery, encode_scans
from umf_ros.runs.reader import FinishedRun
from umf_ros.runs.tables import Endpoints
from umf_ros.runs.truth import JudgedClosure, positions_in_truth
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
        pose_source: who says so.
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
        key = closure.query_stamp_ns, closure.match_stamp_ns
        kind = _kind(about, key, judged.get(key))
        found = tested.get(key)
        pairs.append(Pair(kind, key, number, closure.match_T_query, "the closure", closure, judged.get(key), found))
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
    """Up to `most` of `count`, coarse before fine, so that whoever stops early has seen the whole run."""
    kept = np.linspace(0, count - 1, min(count, most)).astype(int).tolist() if count else []
    strides = [1 << power for power in range(len(kept).bit_length(), -1, -1)]
    return list(dict.fromkeys(kept[i] for stride in strides for i in range(0, len(kept), stride)))


def _kind(about: ExaminedRun, key: Endpoints, judged: JudgedClosure | None) -> Kind:
    if judged is not None and not judged.is_true:
        return "false"
    verdict = about.run.verdicts.get(key)
    if verdict is None or verdict.state == State.ACCEPTED:
        return "accepted"
    return "pending" if verdict.state in PENDING else "rejected"


def _missed(about: ExaminedRun, tested: dict[Endpoints, Hypothesis]) -> list[Pair]:
    pairs = []
    for why in about.missed():
        if why.match_stamp_ns is None:
            continue
        key = why.stamp_ns, why.match_stamp_ns
        pose, source = _pose(about, key)
        pairs.append(Pair("missed", key, 0, pose, source, candidate=tested.get(key), why=why))
    return pairs


def _nearly(about: ExaminedRun, shown: set[Endpoints], found: set[int]) -> list[Pair]:
    """The most probable candidates of keyframes without a closure."""
    best: dict[int, Hypothesis] = {}
    for one in about.run.candidates:
        if one.query_stamp_ns in found or one.endpoints in shown or one.probability is None:
            continue
        known = best.get(one.query_stamp_ns)
        if known is None or one.probability > (known.probability or 0):
            best[one.query_stamp_ns] = one
    chosen = sorted(best.values(), key=lambda one: -(one.probability or 0))[: MOST["tested"]]
    pairs = []
    for one in chosen:
        row = about.places.row(one.query_stamp_ns)
        pose, source = _pose(about, one.endpoints)
        why = about.gates.explain(row) if row is not None else None
        pairs.append(Pair("tested", one.endpoints, 0, pose, source, candidate=one, why=why))
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
    return None, "no one"


def describe(about: ExaminedRun, pair: Pair, full: bool) -> dict[str, Any]:
    """What the page gets of a pair; the bars and the pose only in full."""
    rows = [about.places.row(stamp) for stamp in pair.endpoints]
    told: dict[str, Any] = {"kind": pair.kind, "number": pair.number, "q": rows[0], "m": rows[1]}
    told["stamps"] = [str(stamp) for stamp in pair.endpoints]  # no number of a browser holds nanoseconds
    told["p"] = _finite(_probability(pair))
    told["s"] = _finite(pair.candidate.candidate.similarity if pair.candidate else None)
    told["graph"] = _graph_words(about, pair)
    told["truth"] = _truth_words(pair)
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
        told["shift_m"] = round(float(np.linalg.norm(pair.pose[:3, 3])), 2)
        told["turn_deg"] = round(float(np.degrees(rotation_angle(pair.pose))), 1)
    return told


def _probability(pair: Pair) -> float | None:
    if pair.closure is not None:
        return pair.closure.probability
    return None if pair.candidate is None else pair.candidate.probability


def _graph_words(about: ExaminedRun, pair: Pair) -> str:
    verdict = about.run.verdicts.get(pair.endpoints)
    if verdict is None:
        return ""
    figures = f" ({verdict.sigma:.1f} sigma, {verdict.misfit_m:.2f} m)" if np.isfinite(verdict.sigma) else ""
    return f"{verdict.state}: {verdict.reason}{figures}"


def _truth_words(pair: Pair) -> str:
    judged = pair.judged
    if judged is None:
        return "" if pair.why is None or not np.isfinite(pair.why.distance_m) else f"{pair.why.distance_m:.1f} m apart"
    turned = f", {judged.rotation_error_deg:.2f} deg" if np.isfinite(judged.rotation_error_deg) else ""
    return f"{'true' if judged.is_true else 'FALSE'}: {judged.translation_error_m:.2f} m{turned} off"


def _finite(value: float | None) -> float | None:
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
    positions = positions_in_truth(best, run.truth)
    rigid = _rigid(best.poses, positions)
    return Trajectory(best.stamps_ns, rigid, best.has_orientation)


def _rigid(poses: Array, positions: Array) -> Array:
    """The poses moved so that their positions are those given: both are rigidly alike."""
    if len(poses) < 3:
        return poses
    return np.asarray(align(poses[:, :3, 3], positions)[0] @ poses)


def build_scene(
    about: ExaminedRun, pairs: list[Pair], gallery: Gallery, inliers: dict[Endpoints, Array]
) -> dict[str, Any]:
    """The scene: curves, keyframes, pairs with their pictures, matrix, threshold, errors and map."""
    media = _media(pairs, gallery)
    full = {pair.endpoints for pair in by_need(pairs)}
    told = [describe(about, pair, pair.endpoints in full) for pair in pairs]
    for one, pair in zip(told, pairs, strict=True):
        lines = inliers.get(pair.endpoints)
        if lines is not None and str(pair.endpoints[0]) in media["photographs"]:
            chosen = np.linspace(0, len(lines) - 1, min(len(lines), MAX_INLIERS)).astype(int)
            one["inliers"] = np.rint(lines[chosen]).astype(int).tolist() if len(lines) else []
            one["inlier_count"] = len(lines)
    return {
        "curves": _curves(about),
        "keyframes": _keyframes(about),
        "pairs": told,
        "photographs": media["photographs"],
        "scans": media["scans"],
        "scan_unit_m": SCAN_UNIT_M,
        "similarity": _similarity(about),
        "threshold": about.run.settings.verification.min_probability,
        "sweep": _sweep(about),
        "errors": error_curves(about.run) or None,
        "map": _map(gallery),
    }


def _media(pairs: list[Pair], gallery: Gallery) -> dict[str, dict[str, Any]]:
    """Photographs and scans by stamp, of the most telling pairs first, as many as find room."""
    room = MEDIA_BYTES
    photographs: dict[str, Any] = {}
    scans: dict[str, str] = {}
    encoded = encode_scans(gallery.scans)
    for pair in by_need(pairs):
        for stamp in pair.endpoints:
            photograph, scan = gallery.photographs.get(stamp), encoded.get(stamp, "")
            size = (len(photograph.address) if photograph else 0) + len(scan)
            if str(stamp) in scans or size > room:
                continue
            room -= size
            scans[str(stamp)] = scan
            if photograph is not None:
                photographs[str(stamp)] = [photograph.address, photograph.width, photograph.height]
    return {"photographs": photographs, "scans": scans}


def _curves(about: ExaminedRun) -> list[dict[str, Any]]:
    run = about.run
    curves = []
    if run.truth is not None:
        curves.append(("ground truth", run.truth.poses[:, :3, 3]))
    for name, trajectory in (("odometry", run.odometry), ("optimised", run.optimized)):
        if trajectory is not None:
            curves.append((name, positions_in_truth(trajectory, run.truth)))
    return [{"name": name, "xyz": _rounded(_thin(positions)).T.tolist()} for name, positions in curves]


def _keyframes(about: ExaminedRun) -> dict[str, Any]:
    run, places = about.run, about.places
    start = int(places.stamps[0]) if len(places.stamps) else 0
    best: dict[int, float] = {}
    for one in run.candidates:
        best[one.query_stamp_ns] = max(best.get(one.query_stamp_ns, -1.0), one.candidate.similarity)
    return {
        "t": [round((int(stamp) - start) * 1e-9, 3) for stamp in places.stamps],
        "xy": _rounded(_positions(about)).tolist(),
        "way": [_or_none(row.path_length_m) for row in run.keyframes],
        "similarity": [_or_none(best.get(int(stamp), np.nan)) for stamp in places.stamps],
        "latency": [_or_none(run.latencies_ms.get(int(stamp), np.nan)) for stamp in places.stamps],
    }


def _positions(about: ExaminedRun) -> Array:
    """(N, 2) of the keyframes where they are drawn; on a circle where no one knows their poses."""
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


def _similarity(about: ExaminedRun) -> dict[str, Any] | None:
    descriptors = about.run.descriptors
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
    """Way in m and distance from the truth in m, of odometry and optimised trajectory as far as there are."""
    told: dict[str, list[list[float]]] = {}
    for name, trajectory in (("odometry", run.odometry), ("optimised", run.optimized)):
        if trajectory is None or run.truth is None:
            continue
        poses, known = run.truth.at(trajectory.stamps_ns)
        if np.count_nonzero(known) < 3:
            continue
        there = positions_in_truth(trajectory, run.truth)[known]
        way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(poses[known, :3, 3], axis=0), axis=1))])
        both = np.column_stack([way, np.linalg.norm(there - poses[known, :3, 3], axis=1)])
        told[name] = _rounded(_thin(both)).T.tolist()
    return told


def _map(gallery: Gallery) -> dict[str, Any] | None:
    picture = gallery.map_picture()
    return {"address": picture.address, "lower": picture.lower, "upper": picture.upper} if picture else None


def _thin(rows: Array) -> Array:
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_POINTS)).astype(int))]


def _rounded(values: Array) -> Array:
    return np.asarray(np.round(np.asarray(values, float), 3))


def _or_none(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
