"""What a solved map leaves in its folder: trajectories, graph, verdicts, cloud, pictures and summary."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from umf_ros.core.errors import UmfError, writing
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.maps.joint_graph import JointMap, JointSession
from umf_ros.maps.map_folder import MapFolder
from umf_ros.maps.point_cloud import Crispness, write_cloud
from umf_ros.maps.report import write_report
from umf_ros.pose_graph.closures import State
from umf_ros.pose_graph.g2o import verdict_table
from umf_ros.runs.report import plot_trajectories
from umf_ros.runs.writer import write_atomically

POSES = "poses.npz"
"""Every place that has a pose in the map: `stamps` (N,) on the map's clock, `poses` (N, 4, 4) `map_T_body`."""


def write_results(folder: MapFolder, joint: JointMap) -> dict[str, Any]:
    """Write all results of a solved map; returns the summary.

    Raises:
        OutputError: the folder cannot be written.
    """
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
    crispness = write_cloud(folder, joint) if folder.places.is_file() else Crispness(nan, nan)
    summary = summarise(joint) | {"thickness_m": {name: _rounded(value) for name, value in asdict(crispness).items()}}
    write_atomically(path / "summary.json", json.dumps(summary, indent=2) + "\n")
    write_report(path, summary)
    return summary


def read_poses(path: Path) -> Trajectory:
    """The poses of a map's places, on the map's clock.

    Raises:
        UmfError: the map has not been solved, or the file is damaged.
    """
    try:
        with np.load(path / POSES) as stored:
            return Trajectory(stored["stamps"], stored["poses"])
    except (OSError, ValueError, KeyError):
        raise UmfError(f"{path / POSES} cannot be read: umf map writes it when a map is solved") from None


def summarise(joint: JointMap) -> dict[str, Any]:
    """What `summary.json` holds."""
    ties = Counter(
        name
        for closure in joint.accepted_between()
        for stamp in (closure.query_stamp_ns, closure.match_stamp_ns)
        for name in _names_at(joint, stamp)
    )
    return {
        "sessions": [_about(joint, one, ties[one.session.name]) for one in joint.sessions],
        "joined": sum(one.joined for one in joint.sessions),
        "closures_within": _counts(joint.within),
        "closures_between": _counts(joint.between),
    }


def _rounded(value: float) -> float | None:
    return None if isnan(value) else round(value, 4)


def _about(joint: JointMap, one: JointSession, ties: int) -> dict[str, Any]:
    session = one.session
    steps = np.linalg.norm(np.diff(one.poses[:, :3, 3], axis=0), axis=1) if len(one.poses) > 1 else np.zeros(1)
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


def _names_at(joint: JointMap, stamp_ns: int) -> list[str]:
    return [one.session.name for one in joint.sessions if one.session.covers(stamp_ns)]


def _write_poses(path: Path, joint: JointMap) -> None:
    stamps = [one.stamps + one.session.shift_ns for one in joint.sessions]
    poses = [one.poses for one in joint.sessions]
    part = path.with_name(path.name + ".part")
    with writing(path):
        with part.open("wb") as file:
            np.savez(file, stamps=np.concatenate([np.empty(0, np.int64), *stamps]), poses=_joined(poses))
        part.replace(path)


def _joined(poses: list[Array]) -> Array:
    return np.concatenate([np.empty((0, 4, 4)), *poses])


def _draw(path: Path, joint: JointMap) -> None:
    """All sessions from above, each in its colour, and the closures that tie them together."""
    palette = colormaps["tab10"]
    shown = [one for one in joint.sessions if one.joined]
    curves = [(one.session.name, to_hex(palette(i % 10)), one.poses[:, :3, 3]) for i, one in enumerate(shown)]
    closures = joint.accepted_between()
    stamps = np.array([(c.match_stamp_ns, c.query_stamp_ns) for c in closures], np.int64).reshape(-1)
    poses, known = joint.graph.poses_at(stamps)
    lines = poses[:, :3, 3].reshape(-1, 2, 3)[known.reshape(-1, 2).all(axis=1)]
    with writing(path):
        plot_trajectories(path, curves, lines, [None] * len(lines))
