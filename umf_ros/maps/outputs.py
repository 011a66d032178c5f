"""Results of a solved map: trajectories, graph, verdicts, cloud without moving objects, pictures, summary, report."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import closing
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from umf_ros.core.config import TerrainSettings
from umf_ros.core.errors import UmfError, reading, writing
from umf_ros.core.geometry import Array, evenly, first_of_cubes, invert, transform
from umf_ros.core.io import atomic_write, write_atomically, write_table
from umf_ros.core.limits import read_json
from umf_ros.core.trajectory import Trajectory, write_geojson, write_tum
from umf_ros.map_poses import POSES, read_poses
from umf_ros.maps.joint_graph import JointMap, JointSession
from umf_ros.maps.map_folder import MapFolder
from umf_ros.places.database import PlaceDatabase
from umf_ros.places.store import stored_identity
from umf_ros.pose_graph.closures import VERDICT_COLUMNS, State, verdict_rows
from umf_ros.runs.report import render
from umf_ros.runs.scene import HeightMap, data_address
from umf_ros.runs.writer import read_summary
from umf_ros.terrain.grid import write_terrain
from umf_ros.terrain.voxels import REACH_M, PlacedScan, VoxelMap

VOXEL_M = 0.1
Poses = dict[int, Array]
_NEIGHBOURS_M, _FEWEST = 0.5, 12
_MOST_PROBED = 20_000
CLOUD = np.dtype([("point", "<f4", 3), ("session", "u1")])
"""Fields of the points of a map: position in the map frame, m, and number of the recording, modulo 256."""
_HEADERS = {
    ".ply": "ply\nformat binary_little_endian 1.0\nelement vertex {count}\nproperty float x\nproperty float y\n"
    "property float z\nproperty uchar session\nend_header\n",
    ".pcd": "VERSION 0.7\nFIELDS x y z session\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 1\n"
    "WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n",
}
THICKNESS = ("before", "with_moving", "after")


def write_results(folder: MapFolder, joint: JointMap) -> dict[str, Any]:
    """Write all results of a solved map; return the summary."""
    path = folder.path
    _write_poses(path / POSES, joint)
    trajectories = path / "trajectories"
    with writing(f"to {path}"):
        trajectories.mkdir(exist_ok=True)
    write_table(path / "graph_verdicts.csv", VERDICT_COLUMNS, verdict_rows(joint.graph.closures()))
    for one in joint.sessions:
        write_tum(trajectories / f"{one.session.name}.tum", Trajectory(one.stamps, one.poses))
    joint.graph.write_g2o(path / "graph.g2o")
    draw_map(path / "trajectories.png", joint)
    found, ground = write_cloud(folder, joint) if folder.places.is_file() else (dict.fromkeys(THICKNESS, nan), "")
    thickness = {name: None if isnan(value) else round(value, 4) for name, value in found.items()}
    summary = summarise(joint) | {"thickness_m": thickness, "ground": ground, "world": None}
    for one in summary["sessions"]:
        one["findings"] = summary_of(folder, one["name"]).get("findings", [])
    if joint.world is not None:
        world_T_map, origin = joint.world
        summary["world"] = {"origin": origin.tolist(), "world_T_map": world_T_map.tolist()}
        paths = {one.session.name: one.poses for one in joint.sessions}
        write_geojson(path / "trajectories.geojson", paths, world_T_map, origin)
    write_atomically(path / "summary.json", json.dumps(summary, indent=2) + "\n")
    _write_report(path, summary)
    return summary


def summary_of(folder: MapFolder, session: str) -> dict[str, Any]:
    """Return the summary of a session's replay; empty for a drive without a recording."""
    run = folder.folder_of(session)
    return read_summary(run) if (run / "summary.json").is_file() else {}


def summarise(joint: JointMap) -> dict[str, Any]:
    """Return the contents of `summary.json`."""
    ties = Counter(
        one.session.name
        for closure in joint.accepted_between()
        for stamp in (closure.query_stamp_ns, closure.match_stamp_ns)
        for one in joint.sessions
        if one.session.covers(stamp)
    )
    return {
        "sessions": [_about(joint, one, ties[one.session.name]) for one in joint.sessions],
        "joined": sum(one.joined for one in joint.sessions),
        "closures_within": _counts(joint.within),
        "closures_between": _counts(joint.between),
    }


def sentence(summary: dict[str, Any]) -> str:
    """Return a sentence on joined sessions and closures between them; on the closures of one, or places of a cloud."""
    within, between = (in_words(summary[f"closures_{where}"]) for where in ("within", "between"))
    if _is_cloud(summary):
        count = sum(one["places"] for one in summary["sessions"])
        return f"{count} places of a cloud, seen in {len(summary['sessions'])} directions"
    if len(summary["sessions"]) == 1:
        return f"one session; its closures: {within}"
    joined = f"{summary['joined']} of {len(summary['sessions'])} sessions"
    return f"{joined} in one frame; closures between them: {between}; within them: {within}"


def _is_cloud(summary: dict[str, Any]) -> bool:
    return {bool(one.get("of_cloud")) for one in summary["sessions"]} == {True}


def in_words(counts: dict[str, int]) -> str:
    """Return the number of closures, and of those in each state that occurs; they add up."""
    return ", ".join(f"{count} {state}" for state, count in counts.items() if count or state in ("found", "accepted"))


def crispness(summary: dict[str, Any]) -> str:
    """Return a sentence on the thickness of surfaces; empty where no drives overlap."""
    thickness = summary["thickness_m"]
    if thickness["after"] is None or _is_cloud(summary):
        return ""
    before, after = (f"{100 * thickness[when]:.1f}" for when in ("before", "after"))
    return f"surfaces seen by several sessions are {after} cm thick, by odometry alone {before} cm"


def _about(joint: JointMap, one: JointSession, ties: int) -> dict[str, Any]:
    session = one.session
    spans = joint.graph.session_spans()
    return {
        "name": session.name,
        "recording": session.recording["path"],
        "of_cloud": session.recording.get("of_cloud", False),
        "places": session.places,
        "places_in_map": len(one.stamps),
        "joined": one.joined,
        "length_m": round(one.path_length_m, 1),
        "closures_between": ties,
        "clock_shift_s": session.shift_ns // 10**9,
        "graph_sessions": [n for n, span in enumerate(spans) if span is not None and session.covers(span[0])],
    }


def _counts(verdicts: list[Any]) -> dict[str, int]:
    counts = Counter(verdict.state for verdict in verdicts)
    return {"found": len(verdicts), **{state.value: counts[state] for state in State}}


def _write_poses(path: Path, joint: JointMap) -> None:
    stamps = [np.empty(0, np.int64), *(one.stamps + one.session.shift_ns for one in joint.sessions)]
    poses = [np.empty((0, 4, 4)), *(one.poses for one in joint.sessions)]
    with atomic_write(path) as part, part.open("wb") as file:
        np.savez(file, stamps=np.concatenate(stamps), poses=np.concatenate(poses))


def draw_map(path: Path, joint: JointMap, heights: HeightMap | None = None) -> None:
    """Plot all joined sessions and their accepted closures from above, on the ground where its heights are given."""
    figure = Figure(figsize=(9, 7), layout="constrained")
    axes = figure.subplots()
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.grid(alpha=0.3)
    halo = [] if heights is None else [withStroke(linewidth=3.0, foreground="white")]
    if heights is not None and (drawn := heights.draw()) is not None:
        (left, bottom), (right, top) = heights.lower, heights.upper
        axes.imshow(drawn[0][..., [2, 1, 0, 3]], extent=(left, right, bottom, top))
        figure.colorbar(ScalarMappable(Normalize(*drawn[1]), "viridis"), ax=axes, label="height [m]", shrink=0.8)
    for number, one in enumerate(one for one in joint.sessions if one.joined):
        axes.plot(*one.poses[:, :2, 3].T, color=f"C{number % 10}", label=one.session.name, path_effects=halo)
    for name, verdicts, colour in (("within", joint.within, "dimgray"), ("between", joint.between, "black")):
        ends = [verdict.closure.endpoints for verdict in verdicts if verdict.state is State.ACCEPTED]
        poses, known = joint.graph.poses_at(np.array(ends, np.int64).reshape(-1))
        lines = poses[:, :2, 3].reshape(-1, 2, 2)[known.reshape(-1, 2).all(axis=1)]
        if len(lines):
            axes.add_collection(LineCollection(lines.tolist(), colors=colour, path_effects=halo))
            axes.plot(*lines.reshape(-1, 2).T, ".", color=colour, label=f"{len(lines)} closures {name} sessions")
    span_m = float(np.diff(axes.get_xlim())[0])
    lengths_m = [n * 10.0**power for power in range(-2, 6) for n in (1, 2, 5)]
    length_m = max((one for one in lengths_m if one <= span_m / 4), default=lengths_m[0])
    size = {"pad": 0.5, "sep": 4, "size_vertical": span_m / 250, "fill_bar": True}
    axes.add_artist(AnchoredSizeBar(axes.transData, length_m, f"{length_m:g} m", "lower right", **size))
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside upper center", ncols=4, fontsize=9)
    with writing(path):
        figure.savefig(path, dpi=120)


def _write_report(folder: Path, summary: dict[str, Any]) -> None:
    """Write the self-contained `report.html` from the summary and the pictures in the folder of a map."""
    causes = [f"{one['name']}: {one['findings'][0]}. " for one in summary["sessions"] if one.get("findings")]
    pictures = {"trajectories": folder / "trajectories.png", "ground": folder / "map.png"}
    page = render(
        "map.html",
        name=folder.resolve().name,
        sentence="".join(causes[:1]) + sentence(summary),
        mark="warn" if causes or summary["joined"] < len(summary["sessions"]) else "good",
        sessions=summary["sessions"],
        crispness=crispness(summary),
        **{name: data_address("image/png", p.read_bytes()) if p.is_file() else "" for name, p in pictures.items()},
    )
    write_atomically(folder / "report.html", page)


def thin(cloud: NDArray[np.void], voxel_m: float = VOXEL_M) -> NDArray[np.void]:
    """Keep the first point of `CLOUD` in every voxel."""
    return cloud[first_of_cubes(cloud["point"].astype(float), voxel_m)]


def thickness(cloud: NDArray[np.void]) -> float:
    """Return the median thickness in m of surfaces seen by at least two recordings; thinner means a crisper map.

    The standard deviation across the plane through the neighbours within half a metre of points all over the map
    [after the mean plane variance of Razlaw 2015]; NaN where no two recordings overlap.
    """
    points, sessions = cloud["point"], cloud["session"]
    rows, found = evenly(len(points), _MOST_PROBED), []
    for near in cKDTree(points).query_ball_point(points[rows], _NEIGHBOURS_M) if len(rows) else []:
        if len(near) >= _FEWEST and len(set(sessions[near].tolist())) > 1:
            found.append(np.sqrt(max(np.linalg.eigvalsh(np.cov(points[near].T.astype(float)))[0], 0.0)))
    return float(np.median(found)) if found else nan


def gather(folder: MapFolder, poses: Poses) -> tuple[list[PlacedScan], NDArray[np.uint8]]:
    """Return the scans of a map at poses `map_T_body` by their stamps on its clock, and the session of each."""
    scans, sessions = [], []
    with closing(PlaceDatabase.of_map(folder.path, *stored_identity(folder.places))) as places:
        for number, one in enumerate(folder.sessions):
            for row in range(one.first_place, one.first_place + one.places):
                keyframe = places[row]
                if keyframe.stamp_ns in poses:
                    scans.append((keyframe.points, keyframe.body_T_lidar, poses[keyframe.stamp_ns]))
                    sessions.append(number % 256)
    return scans, np.array(sessions, np.uint8)


def merge(scans: list[PlacedScan], sessions: NDArray[np.uint8]) -> NDArray[np.void]:
    """Return the points of scans, each with its session, in one cloud of `CLOUD`."""
    placed = [transform(pose, points[np.linalg.norm(points, axis=1) < REACH_M]) for points, _, pose in scans]
    count = [len(points) for points in placed]
    cloud = np.empty(sum(count), CLOUD)
    cloud["point"] = np.concatenate([np.empty((0, 3), np.float32), *placed])
    cloud["session"] = np.repeat(sessions, count)
    return cloud


def write_cloud(folder: MapFolder, joint: JointMap) -> tuple[dict[str, float], str]:
    """Write `map.ply`, `map.pcd`, the picture `map.png` and the files of `write_terrain`.

    Returns:
        Thickness of surfaces in m: "before", by the odometry of every session alone; "with_moving", by the joint graph;
        "after", without moving objects. Then, what `write_terrain` returns.
    """
    solved, driven = Poses(), Poses()
    for one in joint.sessions:
        stamps = (one.stamps + one.session.shift_ns).tolist()
        solved |= zip(stamps, one.poses, strict=True)
        if stamps:
            driven |= zip(stamps, one.poses[0] @ invert(one.odometry[0]) @ one.odometry, strict=True)
    scans, sessions = gather(folder, solved)
    everything, voxels = merge(scans, sessions), VoxelMap(folder.settings.terrain.cell_m)
    voxels.add(scans)
    cloud = everything[voxels.are_static(everything["point"].astype(float))]
    thinned = thin(cloud)
    write_points(folder.path / "map.ply", thinned)
    write_points(folder.path / "map.pcd", thinned)
    path = np.concatenate([np.empty((0, 2)), *(one.poses[:, :2, 3] for one in joint.sessions)])
    if len(path) and len(cloud):
        heights = HeightMap(path)
        heights.add(cloud["point"])
        draw_map(folder.path / "map.png", joint, heights)
    ground = write_terrain(folder.path, voxels.points(), folder.settings.terrain, joint.world)
    before = thickness(thin(merge(*gather(folder, driven))))
    return {"before": before, "with_moving": thickness(thin(everything)), "after": thickness(thinned)}, ground


def export_terrain(folder: MapFolder, settings: TerrainSettings, out: Path) -> str:
    """Write the files of the ground of a solved map into a folder; return their names, and what was limited.

    Raises:
        UmfError: the map has not been solved.
        OutputError: a file cannot be written.
    """
    solved, voxels = read_poses(folder.path), VoxelMap(settings.cell_m)
    voxels.add(gather(folder, Poses(zip(solved.stamps_ns.tolist(), solved.poses, strict=True)))[0])
    with reading(folder.path / "summary.json", UmfError, "is damaged"):
        world = read_json(folder.path / "summary.json").get("world")
    placed = None if world is None else (np.array(world["world_T_map"]), np.array(world["origin"]))
    return write_terrain(out, voxels.points(), settings, placed)


def write_points(path: Path, cloud: NDArray[np.void]) -> None:
    """Write x, y, z and session of the points of `CLOUD` as a binary PLY or PCD file."""
    with atomic_write(path) as part:
        part.write_bytes(_HEADERS[path.suffix].format(count=len(cloud)).encode("ascii") + cloud.tobytes())
