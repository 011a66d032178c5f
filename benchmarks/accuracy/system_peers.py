"""Other systems on the scans of a recording, in their own environment: `benchmarks/accuracy/systems.py` calls it.

    python system_peers.py PEER SCANS.npz SETTINGS.json OUT.json

It imports nothing of this package, and prints nothing that is read. SCANS.npz holds `points` (M, 3) float32 in the body
frame, one scan after another, `first` (N + 1,) where each begins, `stamps` (N,) ns and `odom_T_body` (N, 4, 4); for
KISS-Matcher also `pairs` (P, 2), rows of scans that may show one place. OUT.json gets closures (stamps of the query's
and the match's window, match_T_query of the middle of each), poses, CPU seconds, and the peak of memory.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray


class Scans:
    """The scans of a recording and the odometry between them."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as content:
            self._points, self._first = content["points"], content["first"]
            self.stamps, self.odom_T_body = content["stamps"], content["odom_T_body"]
            self.pairs = content["pairs"] if "pairs" in content.files else np.empty((0, 2), int)

    def __len__(self) -> int:
        return len(self.stamps)

    def points(self, row: int) -> Array:
        """(K, 3) float64 of one scan, body frame."""
        return self._points[self._first[row] : self._first[row + 1]].astype(np.float64)

    def windows(self, length_m: float) -> Iterator[range]:
        """Consecutive scans over so many metres of path length."""
        steps = np.linalg.norm(np.diff(self.odom_T_body[:, :3, 3], axis=0), axis=1)
        number = (np.concatenate([[0], np.cumsum(steps)]) // length_m).astype(int)
        for one in np.unique(number):
            rows = np.flatnonzero(number == one)
            yield range(int(rows[0]), int(rows[-1]) + 1)

    def local_map(self, rows: range, every: int = 2) -> Array:
        """Points (K, 3) of a window in the body frame of its middle scan, placed by odometry."""
        middle_T_odom = np.linalg.inv(self.odom_T_body[middle(rows)])
        parts = []
        for row in rows[::every]:
            pose = middle_T_odom @ self.odom_T_body[row]
            parts.append(self.points(row) @ pose[:3, :3].T + pose[:3, 3])
        return np.concatenate(parts)


def middle(rows: range) -> int:
    """The scan that stands for a window."""
    return rows[len(rows) // 2]


def found(scans: Scans, query: range, match: range, match_T_query: Array) -> dict[str, Any]:
    """One closure between two windows, as it is written."""
    ends = {name: [int(scans.stamps[rows[0]]), int(scans.stamps[rows[-1]])] for name, rows in
            (("query_window", query), ("match_window", match))}  # fmt: skip
    stamps = {"query": int(scans.stamps[middle(query)]), "match": int(scans.stamps[middle(match)])}
    return ends | stamps | {"match_T_query": np.asarray(match_T_query).tolist()}


def map_closures(scans: Scans, settings: dict[str, Any]) -> dict[str, Any]:
    """Density maps of windows along the odometry, compared by their ORB features."""
    from map_closures.config import MapClosuresConfig
    from map_closures.map_closures import MapClosures

    own = {name: value for name, value in settings.items() if name != "window_m"}
    detector, windows, closures = MapClosures(MapClosuresConfig(**own)), [], []
    for number, rows in enumerate(scans.windows(settings["window_m"])):
        windows.append(rows)
        closure = detector.get_best_closure(number, scans.local_map(rows))
        if closure.number_of_inliers >= detector._config.inliers_threshold:
            query_T_match = np.asarray(closure.pose)
            closures.append(found(scans, rows, windows[closure.source_id], np.linalg.inv(query_T_match)))
    return {"closures": closures}


def kiss_slam(scans: Scans, settings: dict[str, Any]) -> dict[str, Any]:
    """The whole system on the scans alone; it takes no odometry."""
    from kiss_slam.config import load_config
    from kiss_slam.slam import KissSLAM

    config = load_config(None)
    config.odometry.preprocessing.deskew = False  # the scans are straightened already
    config.local_mapper.splitting_distance = settings["splitting_distance"]
    slam = KissSLAM(config)
    rows, closures, edges = [0], [], []
    accept = slam.closer.compute

    def remember(*arguments: Any) -> Any:
        answer = accept(*arguments)
        if answer[0]:
            edges.append(answer[1:])
        return answer

    slam.closer.compute = remember
    for row in range(len(scans)):
        slam.process_scan(scans.points(row), np.empty(0))
        while len(rows) < len(list(slam.local_map_graph.local_maps())):
            rows.append(row + 1)
    windows = [range(a, max(b, a + 1)) for a, b in zip(rows, [*rows[1:], len(scans)], strict=True)]
    trajectories = [np.stack(node.local_trajectory) for node in slam.local_map_graph.local_maps()]
    for match, query, query_T_match in edges:  # between the beginnings of the maps: carried to their middles
        ends = [_within(trajectories[number], windows[number]) for number in (match, query)]
        match_T_query = np.linalg.inv(ends[0]) @ np.linalg.inv(query_T_match) @ ends[1]
        closures.append(found(scans, windows[query], windows[match], match_T_query))
    return {"closures": closures, "poses": [pose.tolist() for pose in slam.poses[: len(scans)]]}


def _within(trajectory: Array, rows: range) -> Array:
    return trajectory[min(len(rows) // 2, len(trajectory) - 1)]


def kiss_matcher(scans: Scans, settings: dict[str, Any]) -> dict[str, Any]:
    """Pairs that another method found alike, aligned from nothing and refined by small_gicp."""
    import small_gicp
    from kiss_matcher import KISSMatcher, KISSMatcherConfig

    voxel_m, closures = settings["voxel_m"], []
    for query, match in scans.pairs.tolist():
        source, target = scans.points(query), scans.points(match)
        matcher = KISSMatcher(KISSMatcherConfig(voxel_m))
        result = matcher.estimate(source, target)
        if matcher.get_num_final_inliers() < settings["inliers"]:
            continue
        guess = np.eye(4)
        guess[:3, :3], guess[:3, 3] = np.asarray(result.rotation), np.asarray(result.translation)
        refined = small_gicp.align(
            target, source, guess, registration_type="GICP", downsampling_resolution=0.3, num_threads=1
        )
        closures.append(found(scans, range(query, query + 1), range(match, match + 1), refined.T_target_source))
    return {"closures": closures}


PEERS = {"map_closures": map_closures, "kiss_slam": kiss_slam, "kiss_matcher": kiss_matcher}


def main() -> None:
    """Run one peer."""
    peer, scans_file, settings_file, out = sys.argv[1:]
    scans, settings = Scans(Path(scans_file)), json.loads(Path(settings_file).read_text(encoding="utf-8"))
    before = time.process_time()
    answer = PEERS[peer](scans, settings)
    answer["cpu_s"] = time.process_time() - before
    answer["memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    Path(out).write_text(json.dumps(answer), encoding="utf-8")


if __name__ == "__main__":
    main()
