"""Everything the report draws, as plain numbers for the page's script."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from umf_ros.core.geometry import Array, align
from umf_ros.core.trajectory import Trajectory
from umf_ros.runs.findings import ExaminedRun
from umf_ros.runs.finished_run import FinishedRun
from umf_ros.runs.gallery import SCAN_UNIT_M, Gallery, encode_scans
from umf_ros.runs.scene_pairs import Pair, by_need, describe
from umf_ros.runs.tables import Endpoints
from umf_ros.runs.truth import positions_in_truth

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
        best[one.query_stamp_ns] = max(best.get(one.query_stamp_ns, -1.0), one.similarity)
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
        if best.reason == "accepted" and stamp in right:
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
