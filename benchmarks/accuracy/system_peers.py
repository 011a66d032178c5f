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
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "test"))
from support.peer_scans import Array, Scans, found


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
