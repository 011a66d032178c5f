"""Data of the report: trajectories, closures, pairs and pictures."""

from __future__ import annotations

import base64
import math
from collections.abc import Container, Iterable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from umf_ros.core.errors import command_line
from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, evenly, relative, rotation_angle, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.pose_graph.closures import State
from umf_ros.runs.diagnosis import ClosureDiagnosis, contributions, explain, missing, most_probable
from umf_ros.runs.findings import explain_missed
from umf_ros.runs.reader import FinishedRun
from umf_ros.runs.run_file import SCAN_UNIT_M, Endpoints, Picture, RunFile
from umf_ros.runs.truth import JudgedRun, pose_in_truth, positions_in_truth
from umf_ros.verification.acceptance import CRITERIA
from umf_ros.verification.hypothesis import Hypothesis
from umf_ros.verification.measurement import MEASUREMENTS

ORDER = ("false", "missed", "rejected", "pending", "tested", "accepted")
"""Kinds of pairs, in order of priority where not all pictures fit."""
MOST = {"missed": 60, "tested": 20, "accepted": 400}
"""Most pairs of a kind that are explained in full."""
Photograph = tuple[str, int, int]
"""A reduced image: a `data:` address, and width and height in pixels of the image that it was made from."""
Pairs = dict[Endpoints, dict[str, Any]]
"""Entries of the page about pairs of keyframes, by their stamps."""
Pictures = Mapping[int, Picture]
"""Pictures of keyframes by their stamps."""


def pairs_of(about: JudgedRun) -> Pairs:
    """Return every closure, the missed revisits, and the most promising rejected candidates."""
    closures = enumerate((one.endpoints for one in about.run.closures), 1)
    pairs = {key: _describe(about, key, _kind(about, key), number) for number, key in closures}
    for why in explain_missed(about):
        if why.match_stamp_ns is not None:
            key = why.stamp_ns, why.match_stamp_ns
            pairs[key] = _describe(about, key, "missed", why=why)
    found = {one.query_stamp_ns for one in about.run.closures}
    best: dict[int, Hypothesis] = {}  # the most probable candidates of keyframes without a closure
    for one in sorted(about.run.candidates, key=lambda one: -(one.probability or 0)):
        if one.query_stamp_ns not in found and one.endpoints not in pairs and one.probability is not None:
            best.setdefault(one.query_stamp_ns, one)
    for one in list(best.values())[: MOST["tested"]]:
        row = about.row(one.query_stamp_ns)
        cause = None if row is None else explain(about, row)
        pairs[one.endpoints] = _describe(about, one.endpoints, "tested", why=cause)
    return pairs


def by_need(pairs: Pairs) -> list[Endpoints]:
    """Return the pairs that are shown in detail, the most informative first, spread over the run."""
    chosen: list[Endpoints] = []
    for kind in ORDER:
        own = [key for key, pair in pairs.items() if pair["kind"] == kind]
        chosen += [own[i] for i in _spread(len(own), MOST.get(kind, len(own)))]
    return chosen


def _spread(count: int, most: int) -> Iterable[int]:
    """Return up to `most` of `count` indices, coarse before fine: the first ones cover the whole run."""
    kept = evenly(count, most).tolist()
    strides = [1 << power for power in range(len(kept).bit_length(), -1, -1)]
    return list(dict.fromkeys(kept[i] for stride in strides for i in range(0, len(kept), stride)))


def _kind(about: JudgedRun, key: Endpoints) -> str:
    """Return the kind of a closure."""
    judged, verdict = about.by_endpoints.get(key), about.run.verdicts.get(key)
    if judged is not None and not judged.is_true:
        return "false"
    if verdict is None or verdict.state == State.ACCEPTED:
        return "accepted"
    return "pending" if verdict.state == State.PENDING else "rejected"


def _candidate(about: JudgedRun, key: Endpoints) -> Hypothesis | None:
    return next((one for one in about.tested[key[0]] if one.endpoints == key), None)


def _describe(
    about: JudgedRun, key: Endpoints, kind: str, number: int = 0, why: ClosureDiagnosis | None = None
) -> dict[str, Any]:
    """Return the entry of a pair; `number` is that of its closure, 0 without one."""
    candidate, verdict = _candidate(about, key), about.run.verdicts.get(key)
    known = about.run.closures[number - 1] if number else candidate
    entry = {
        "kind": kind,
        "number": number,
        "q": about.row(key[0]),
        "m": about.row(key[1]),
        "stamps": [str(stamp) for stamp in key],  # browser numbers cannot hold nanoseconds
        "p": _number(known.probability if known else None),
        "s": _number(candidate.candidate.similarity if candidate else None),
        "graph": f"{verdict.state}: {verdict.reason}{verdict.figures}" if verdict else "",
        "truth": _truth_words(about, key),
    }
    return entry if why is None else entry | {"why": why.what, "parameter": why.parameter}


def _details(about: JudgedRun, key: Endpoints, number: int) -> dict[str, Any]:
    """Return the bars of a pair's log-odds, and its pose."""
    entry: dict[str, Any] = {}
    if (candidate := _candidate(about, key)) is not None:
        given, lost = contributions(about, candidate), missing(about, candidate)
        names = sorted({*given, *lost} - {"bias"}, key=lambda name: -(given.get(name, 0) + lost.get(name, 0)))
        entry["bars"] = [[name, round(given.get(name, 0), 2), round(lost.get(name, 0), 2)] for name in names]
        entry["bias"] = round(given.get("bias", 0), 2)
        entry["values"] = {name: float(f"{x:.3g}") for name, x in candidate.measurements.items() if math.isfinite(x)}
    pose, source = (about.run.closures[number - 1].match_T_query, "the closure") if number else _pose(about, key)
    if pose is not None:
        entry["pose"] = [round(float(value), 4) for value in pose[:3].ravel()]
        shift_m, turn_deg = size_of(pose)
        entry |= {"pose_source": source, "shift_m": round(shift_m, 2), "turn_deg": round(turn_deg, 1)}
    return entry


def _pose(about: JudgedRun, key: Endpoints) -> tuple[Array | None, str]:
    """Return the relative pose by the truth, else by the optimised trajectory: rejected candidates have none."""
    run = about.run
    with_turns = run.truth if run.truth is not None and run.truth.has_orientation else None
    for source, trajectory in (("the truth", with_turns), ("the optimised trajectory", run.optimized)):
        if trajectory is None:
            continue
        poses, known = trajectory.at(np.array(key, np.int64))
        if known.all():
            return relative(poses[1], poses[0]), source
    return None, ""


def size_of(pose: Array) -> tuple[float, float]:
    """Return metres and degrees of a pose (4, 4)."""
    return float(np.linalg.norm(pose[:3, 3])), float(np.degrees(rotation_angle(pose)))


def _truth_words(about: JudgedRun, key: Endpoints) -> str:
    """Return the error of a closure, or distance of two keyframes in truth; empty where it is unknown."""
    judged = about.by_endpoints.get(key)
    if judged is None:
        distance_m = about.distance(*key)
        return f"{distance_m:.1f} m apart" if np.isfinite(distance_m) else ""
    turned = f", {judged.rotation_error_deg:.2f} deg" if np.isfinite(judged.rotation_error_deg) else ""
    return f"{'true' if judged.is_true else 'FALSE'}: {judged.translation_error_m:.2f} m{turned} off"


def _number(value: float | None) -> float | None:
    """Return a number for the page; None where it is unknown."""
    return None if value is None or not np.isfinite(value) else round(float(value), 4)


MAP_CELLS, MAP_REACH_M = 700, 25.0  # by hand: bounds the picture
SHOWN_POINTS = 500  # by hand: of a scan, enough to see the ground


class HeightMap:
    """Mean heights around a path.

    Attributes:
        lower, upper: (2,) x and y of its lower left and upper right corner, m.
    """

    def __init__(self, path: Array) -> None:
        """Make an empty map around the (N, 2) positions of a path, N > 0."""
        self.lower = path.min(axis=0) - MAP_REACH_M
        span = path.max(axis=0) + MAP_REACH_M - self.lower
        self._cell = max(0.1, float(span.max()) / MAP_CELLS)
        self._shape = tuple(math.ceil(side / self._cell) for side in span)
        self._sum, self._count = np.zeros(self._shape), np.zeros(self._shape, np.int32)
        self.upper = self.lower + np.array(self._shape) * self._cell

    def add(self, points: Array) -> None:
        """Add (N, 3) points in the map's frame."""
        column, row = np.floor((points[:, :2] - self.lower) / self._cell).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < self._shape[0]) & (row < self._shape[1])
        np.add.at(self._sum, (column[inside], row[inside]), points[inside, 2])
        np.add.at(self._count, (column[inside], row[inside]), 1)

    def draw(self) -> tuple[Array, tuple[float, float]] | None:
        """Draw heights as colours and relief as light from the north-west.

        Returns:
            (H, W, 4) uint8 BGRA pixels with y upwards, blank where unknown; heights in m of the darkest and of the
            brightest colour. None if the map is empty.
        """
        seen = self._count > 0
        if not seen.any():
            return None
        height: Array = np.where(seen, self._sum / np.maximum(self._count, 1), 0.0)
        low, high = np.percentile(height[seen], [2, 98])
        share = np.clip((height - low) / max(high - low, 0.1), 0, 1)
        colours = cv2.applyColorMap((share * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
        slope = np.gradient(height, self._cell)
        light = np.clip(0.85 + 0.6 * (slope[0] - slope[1]), 0.4, 1.15)
        shaded = np.clip(colours * light[..., None], 0, 255).astype(np.uint8)
        pixels = np.dstack([shaded, np.where(seen, 255, 0).astype(np.uint8)])
        # columns of the array are y: a picture has y upwards along its rows
        return np.ascontiguousarray(np.swapaxes(pixels, 0, 1)[::-1]), (float(low), float(max(high, low + 0.1)))


def read_pictures(
    folder: Path, shown: Container[int], drawn: Trajectory | None
) -> tuple[dict[int, Picture], HeightMap | None]:
    """Return the pictures of a run whose stamps are `shown`, and its scans along a trajectory as a map from above."""
    pictures: dict[int, Picture] = {}
    heights = HeightMap(drawn.poses[:, :2, 3]) if drawn is not None and len(drawn) else None
    with closing(RunFile(folder, read_only=True)) as file:
        for picture in file.pictures():
            if picture.stamp_ns in shown:
                pictures[picture.stamp_ns] = picture
            if drawn is not None and heights is not None:
                poses, known = drawn.at(np.array([picture.stamp_ns], np.int64))
                points = picture.scan * SCAN_UNIT_M
                near = points[np.linalg.norm(points, axis=1) < MAP_REACH_M]
                if known[0]:
                    heights.add(transform(poses[0], near))
    return pictures, heights


def data_address(kind: str, content: bytes) -> str:
    """Return the content inside an address."""
    return f"data:{kind};base64,{_base64(content)}"


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


MAX_POINTS = 3000
"""Most points of a curve."""
MAX_SIDE = 300
"""Rows and columns of the matrix of similarities."""
MEDIA_BYTES = 2_500_000
"""Most bytes of all photographs and scans: with the drawing library a page of less than 5 MB."""
MAX_INLIERS = 60


def drawn_trajectory(about: JudgedRun) -> Trajectory | None:
    """Return the best trajectory of a run, in the frame of the drawing."""
    run = about.run
    best = run.optimized or run.odometry
    if best is None:
        return run.truth
    return Trajectory(best.stamps_ns, pose_in_truth(best, run.truth) @ best.poses, best.has_orientation)


def build_scene(
    about: JudgedRun,
    pairs: Pairs,
    pictures: Pictures,
    inliers: Mapping[Endpoints, Array],
    heights: HeightMap | None = None,
) -> dict[str, Any]:
    """Return the scene: curves, keyframes, pairs with their pictures, matrix, threshold, errors and map."""
    chosen = by_need(pairs)
    photographs, scans = _media(chosen, pictures)
    for key in chosen:
        pairs[key] |= _details(about, key, pairs[key]["number"])
    known = {name: one for kind in CRITERIA.values() for name, one in kind.items()}
    for key, lines in inliers.items():
        if key in pairs and str(key[0]) in photographs:
            few = lines[evenly(len(lines), MAX_INLIERS)]
            pairs[key] |= {"inliers": np.rint(few).astype(int).tolist(), "inlier_count": len(lines)}
    return {
        "curves": [{"name": name, "xyz": _thin(xyz).T.tolist()} for name, xyz in named_curves(about.run).items()],
        "keyframes": _keyframes(about),
        "pairs": list(pairs.values()),
        "opened": _opened(list(pairs.values())),
        "explain": command_line("explain", about.run.folder),
        "photographs": photographs,
        "scans": scans,
        "scan_unit_m": SCAN_UNIT_M,
        "similarity": _similarity(about.run.descriptors),
        "measurements": {
            name: {read: MEASUREMENTS[read] for read in one.names or (name,)} for name, one in known.items()
        },
        "threshold": about.run.settings.verification.min_probability,
        "sweep": _sweep(about),
        "errors": error_curves(about.run) or None,
        "map": _map_picture(heights),
    }


def _opened(pairs: list[dict[str, Any]]) -> int:
    """Return the pair that the page opens on: a false closure, else a typical accepted one, else the first of all.

    Typical is the one with the median number of image features, or the median probability where there are no images.
    """
    kinds = [pair["kind"] for pair in pairs]
    accepted = [row for row, kind in enumerate(kinds) if kind == "accepted"]
    if "false" in kinds or not accepted:
        return next((kinds.index(kind) for kind in ORDER if kind in kinds), -1)
    accepted.sort(key=lambda row: (pairs[row].get("inlier_count", 0), pairs[row]["p"] or 0))
    return accepted[len(accepted) // 2]


def _map_picture(heights: HeightMap | None) -> dict[str, Any] | None:
    """Return the map: `data:` address, (x, y) in m of `lower` left and `upper` right corner; None if empty."""
    if heights is None or (drawn := heights.draw()) is None:
        return None
    webp = cv2.imencode(".webp", drawn[0], [cv2.IMWRITE_WEBP_QUALITY, 75])[1].tobytes()
    corners = {"lower": np.round(heights.lower, 3).tolist(), "upper": np.round(heights.upper, 3).tolist()}
    return corners | {"address": data_address("image/webp", webp)}


def _media(pairs: Iterable[Endpoints], pictures: Pictures) -> tuple[dict[str, Photograph], dict[str, str]]:
    """Return the photographs and scans by stamp, of the most informative pairs first, as many as fit.

    A scan is base64 of some of its points: little-endian int16 triples in `SCAN_UNIT_M`, body frame.
    """
    room = MEDIA_BYTES
    photographs: dict[str, Photograph] = {}
    scans: dict[str, str] = {}
    for stamp in dict.fromkeys(stamp for key in pairs for stamp in key):
        if (picture := pictures.get(stamp)) is None:
            continue
        address = data_address("image/jpeg", picture.jpeg) if picture.jpeg else ""
        scan = _base64(picture.scan[evenly(len(picture.scan), SHOWN_POINTS)].astype("<i2").tobytes())
        if len(address) + len(scan) <= room:
            room -= len(address) + len(scan)
            scans[str(stamp)] = scan
            if address:
                photographs[str(stamp)] = address, picture.width, picture.height
    return photographs, scans


def named_curves(run: FinishedRun) -> dict[str, Array]:
    """Return positions (N, 3) of truth, odometry and optimised trajectory, if available, in the truth's frame."""
    known = {"ground truth": run.truth, "odometry": run.odometry, "optimised": run.optimized}
    return {name: positions_in_truth(one, run.truth) for name, one in known.items() if one is not None}


def _keyframes(about: JudgedRun) -> dict[str, Any]:
    run, stamps = about.run, about.run.stamps.tolist()
    best: dict[int, float] = {}
    for one in run.candidates:
        best[one.query_stamp_ns] = max(best.get(one.query_stamp_ns, -1.0), one.candidate.similarity)
    return {
        "t": [round((stamp - stamps[0]) * 1e-9, 3) for stamp in stamps],
        "xy": np.round(_positions(about), 3).tolist(),
        "similarity": [_number(best.get(stamp)) for stamp in stamps],
        "latency": [_number(run.latencies_ms.get(stamp)) for stamp in stamps],
    }


def _positions(about: JudgedRun) -> Array:
    """Return (N, 2) of the keyframes where they are drawn; on a circle where their poses are unknown."""
    stamps, drawn = about.run.stamps, drawn_trajectory(about)
    if drawn is not None:
        poses, known = drawn.at(stamps)
        if known.any():
            rows = np.flatnonzero(known)
            xy: Array = poses[:, :2, 3]
            for axis in range(2):  # keyframes before the first known pose are drawn there
                xy[:, axis] = np.interp(np.arange(len(stamps)), rows, xy[rows, axis])
            return xy
    angle = np.linspace(0, 2 * np.pi, max(len(stamps), 1), endpoint=False)
    return 10 * np.column_stack([np.sin(angle), np.cos(angle)])[: len(stamps)]


def _similarity(descriptors: Points) -> dict[str, Any] | None:
    if not len(descriptors):
        return None
    rows = evenly(len(descriptors), MAX_SIDE)
    matrix = np.clip(np.rint(100 * descriptors[rows] @ descriptors[rows].T), -100, 100).astype("<i1")
    return {"rows": rows.tolist(), "data": _base64(matrix.tobytes())}


def _sweep(about: JudgedRun) -> list[list[float | int]]:
    """Return per keyframe with candidates: best probability, same place (1, 0, or -1 for unknown), revisit."""
    rows: list[list[float | int]] = []
    right = dict(zip(about.closures.query_stamp_ns.tolist(), about.closures.is_true.tolist(), strict=True))
    for row, stamp in enumerate(map(int, about.run.stamps)):
        best, revisit = most_probable(about, stamp), int(len(about.same_places(row)) > 0)
        if best is None:
            if revisit:
                rows.append([0, 0, 1])
            continue
        same = about.is_same_place(stamp, best.match_stamp_ns)
        if best.accepted and stamp in right:
            same = right[stamp]
        rows.append([round(best.probability or 0, 4), -1 if same is None else int(same), revisit])
    return rows


def error_curves(run: FinishedRun) -> dict[str, list[list[float]]]:
    """Return path length and distance from the truth in m, of odometry and optimised trajectory, if available."""
    curves: dict[str, list[list[float]]] = {}
    for name, trajectory in (("odometry", run.odometry), ("optimised", run.optimized)):
        if trajectory is None or run.truth is None:
            continue
        poses, known = run.truth.at(trajectory.stamps_ns)
        if np.count_nonzero(known) < 3:
            continue
        true = poses[known, :3, 3]
        path_m = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
        error_m = np.linalg.norm(positions_in_truth(trajectory, run.truth)[known] - true, axis=1)
        curves[name] = _thin(np.column_stack([path_m, error_m])).T.tolist()
    return curves


def _thin(rows: Array) -> Array:
    """Return some of the rows (N, C), rounded to a millimetre."""
    kept = rows[evenly(len(rows), MAX_POINTS)]
    return np.asarray(np.round(kept, 3))
