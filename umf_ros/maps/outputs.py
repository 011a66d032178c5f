"""Results of a solved map: trajectories, graph, verdicts, cloud, pictures, summary and report."""

from __future__ import annotations

import json
from collections import Counter
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from umf_ros.core.errors import writing
from umf_ros.core.io import atomic_write, write_atomically
from umf_ros.core.trajectory import Trajectory, write_geojson, write_tum
from umf_ros.localizer import POSES
from umf_ros.maps.joint_graph import JointMap, JointSession
from umf_ros.maps.map_folder import MapFolder
from umf_ros.maps.point_cloud import write_cloud
from umf_ros.pose_graph.closures import State, verdict_table
from umf_ros.runs.gallery import data_address
from umf_ros.runs.report import plot_trajectories, render

THICKNESS = ("before", "with_moving", "after")


def write_results(folder: MapFolder, joint: JointMap) -> dict[str, Any]:
    """Write all results of a solved map; return the summary."""
    path = folder.path
    _write_poses(path / POSES, joint)
    trajectories = path / "trajectories"
    with writing(f"to {path}"):
        trajectories.mkdir(exist_ok=True)
        (path / "graph_verdicts.csv").write_text(verdict_table(joint.graph.closures()), encoding="utf-8")
    for one in joint.sessions:
        write_tum(trajectories / f"{one.session.name}.tum", Trajectory(one.stamps, one.poses))
    joint.graph.write_g2o(path / "graph.g2o")
    _draw(path / "trajectories.png", joint)
    found = write_cloud(folder, joint) if folder.places.is_file() else dict.fromkeys(THICKNESS, nan)
    thickness = {name: None if isnan(value) else round(value, 4) for name, value in found.items()}
    summary = summarise(joint) | {"thickness_m": thickness, "world": None}
    if joint.world is not None:
        world_T_map, origin = joint.world
        summary["world"] = {"origin": origin.tolist(), "world_T_map": world_T_map.tolist()}
        paths = {one.session.name: one.poses for one in joint.sessions}
        write_geojson(path / "trajectories.geojson", paths, world_T_map, origin)
    write_atomically(path / "summary.json", json.dumps(summary, indent=2) + "\n")
    _write_report(path, summary)
    return summary


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
    """Return a sentence on joined sessions and closures between them."""
    between, joined = summary["closures_between"], f"{summary['joined']} of {len(summary['sessions'])} sessions"
    return f"{joined} in one frame; closures between them: {between['accepted']} of {between['found']} accepted"


def crispness(summary: dict[str, Any]) -> str:
    """Return a sentence on the thickness of surfaces; empty where no sessions overlap."""
    thickness = summary["thickness_m"]
    if thickness["after"] is None:
        return ""
    before, after = (f"{100 * thickness[when]:.1f}" for when in ("before", "after"))
    return f"surfaces seen by several sessions are {after} cm thick, by odometry alone {before} cm"


def _about(joint: JointMap, one: JointSession, ties: int) -> dict[str, Any]:
    session = one.session
    steps = np.linalg.norm(np.diff(one.poses[:, :3, 3], axis=0), axis=1)
    spans = joint.graph.session_spans()
    return {
        "name": session.name,
        "recording": session.recording["path"],
        "odometry": session.odometry,
        "places": session.places,
        "places_in_map": len(one.stamps),
        "joined": one.joined,
        "length_m": round(float(steps.sum()), 1),
        "closures_between": ties,
        "clock_shift_s": session.shift_ns // 10**9,
        "graph_sessions": [n for n, span in enumerate(spans) if span is not None and session.covers(span[0])],
    }


def _counts(verdicts: list[Any]) -> dict[str, int]:
    counts = Counter(verdict.state for verdict in verdicts)
    return {"found": len(verdicts), **{state.value: counts[state] for state in (State.ACCEPTED, State.REJECTED)}}


def _write_poses(path: Path, joint: JointMap) -> None:
    stamps = [np.empty(0, np.int64), *(one.stamps + one.session.shift_ns for one in joint.sessions)]
    poses = [np.empty((0, 4, 4)), *(one.poses for one in joint.sessions)]
    with atomic_write(path) as part, part.open("wb") as file:
        np.savez(file, stamps=np.concatenate(stamps), poses=np.concatenate(poses))


def _draw(path: Path, joint: JointMap) -> None:
    """Plot all joined sessions from above, and the accepted closures between them."""
    palette = colormaps["tab10"]
    shown = [one for one in joint.sessions if one.joined]
    curves = [(one.session.name, to_hex(palette(i % 10)), one.poses[:, :3, 3]) for i, one in enumerate(shown)]
    closures = joint.accepted_between()
    stamps = np.array([(c.match_stamp_ns, c.query_stamp_ns) for c in closures], np.int64).reshape(-1)
    poses, known = joint.graph.poses_at(stamps)
    lines = poses[:, :3, 3].reshape(-1, 2, 3)[known.reshape(-1, 2).all(axis=1)]
    with writing(path):
        plot_trajectories(path, curves, lines, [None] * len(lines))


def _write_report(folder: Path, summary: dict[str, Any]) -> None:
    """Write the self-contained `report.html` from the summary and the pictures in the folder of a map."""
    joined, count = summary["joined"], len(summary["sessions"])
    pictures = {"trajectories": folder / "trajectories.png", "ground": folder / "map.png"}
    page = render(
        "map.html",
        name=folder.resolve().name,
        sentence=sentence(summary),
        mark="good" if joined == count else "warn",
        sessions=summary["sessions"],
        between=summary["closures_between"],
        within=summary["closures_within"],
        crispness=crispness(summary),
        **{name: data_address("image/png", p.read_bytes()) if p.is_file() else "" for name, p in pictures.items()},
    )
    write_atomically(folder / "report.html", page)
