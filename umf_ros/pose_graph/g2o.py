"""Pose graphs as g2o files, in three dimensions and in two, and the older TORO spelling of both.

An information matrix is read as GTSAM reads it: tangent space of the second vertex, translation
first, rotation in radians. A plane graph is lifted into space; what it does not say about height,
roll and pitch is given the weight of what it does say.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.errors import GraphError, OutputError
from umf_ros.geometry import Array, from_quaternion, heading, make_pose, to_quaternion
from umf_ros.pose_graph.closures import check_covariance
from umf_ros.pose_graph.condensed import Edge

_IGNORED = ("FIX", "PARAMS_", "VERTEX_XY", "VERTEX_TRACKXYZ", "EDGE_SE2_XY", "EDGE_SE3_TRACKXYZ")
_SWAP = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])


@dataclass
class G2oGraph:
    """The content of a g2o file.

    Attributes:
        poses: (4, 4) initial poses by vertex id; may be empty.
        edges: relative poses between vertex ids.
        planar: the file is two-dimensional.
        problems: what was wrong with lines that were skipped, each with its line number.
    """

    poses: dict[int, Array] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    planar: bool = False
    problems: list[str] = field(default_factory=list)


def read_g2o(path: str | Path) -> G2oGraph:
    """Read a graph; a malformed line is skipped and named in `problems`.

    Raises:
        GraphError: the file cannot be read or holds no edge.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise GraphError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'not a text file'}") from None
    graph = G2oGraph()
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#") or words[0].startswith(_IGNORED):
            continue
        try:
            _read_line(graph, words)
        except (GraphError, ValueError, np.linalg.LinAlgError) as error:
            graph.problems.append(f"line {number}: {error}")
    if not graph.edges:
        first = f" ({graph.problems[0]})" if graph.problems else ""
        raise GraphError(f"{path} holds no usable edge{first}")
    return graph


def _read_line(graph: G2oGraph, words: list[str]) -> None:
    tag, length = words[0], len(words)
    expected = {"VERTEX_SE2": 5, "VERTEX2": 5, "VERTEX_SE3:QUAT": 9, "VERTEX3": 8}
    expected |= {"EDGE_SE2": 12, "EDGE2": 12, "EDGE_SE3:QUAT": 31, "EDGE3": 30}
    if tag not in expected:
        raise GraphError(f"unknown tag {tag[:40]}")
    if length != expected[tag]:
        raise GraphError(f"{tag} has {length - 1} values instead of {expected[tag] - 1}")
    ids = [int(word) for word in words[1 : 2 if tag.startswith("VERTEX") else 3]]
    if min(ids) < 0:
        raise GraphError("negative vertex id")
    values = np.array(words[1 + len(ids) :], dtype=float)
    if not np.isfinite(values).all():
        raise GraphError("value is not finite")
    pose, rest = _read_pose(tag, values)
    graph.planar |= tag in ("VERTEX_SE2", "VERTEX2", "EDGE_SE2", "EDGE2")
    if len(ids) == 1:
        graph.poses[ids[0]] = pose
        return
    if ids[0] == ids[1]:
        raise GraphError(f"edge from vertex {ids[0]} to itself")
    graph.edges.append(Edge(ids[0], ids[1], pose, _read_covariance(tag, rest)))


def _read_pose(tag: str, values: Array) -> tuple[Array, Array]:
    if "2" in tag:
        return make_pose(Rotation.from_euler("z", values[2]).as_matrix(), [*values[:2], 0.0]), values[3:]
    if tag.endswith("QUAT"):
        return from_quaternion(values[:3], values[3:7]), values[7:]
    return make_pose(Rotation.from_euler("xyz", values[3:6]).as_matrix(), values[:3]), values[6:]


def _read_covariance(tag: str, values: Array) -> Array:
    information: Array = np.zeros((6, 6))
    if tag == "EDGE2":
        xx, xy, yy, tt, xt, yt = values
        plane = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
    elif tag == "EDGE_SE2":
        plane = _symmetric(values, 3)
    else:
        information = _symmetric(values, 6)
        return _invert(information[_SWAP])
    kept = np.ix_([3, 4, 2], [3, 4, 2])
    information[kept] = plane
    information[0, 0] = information[1, 1] = plane[2, 2]
    information[5, 5] = np.sqrt(plane[0, 0] * plane[1, 1])
    return _invert(information)


def _symmetric(upper: Array, size: int) -> Array:
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = upper
    return matrix + np.triu(matrix, 1).T


def _invert(information: Array) -> Array:
    check_covariance(information)
    covariance = np.linalg.inv(information)
    return 0.5 * (covariance + covariance.T)


def write_g2o(
    path: str | Path,
    poses: Sequence[Array],
    edges: Sequence[Edge],
    planar: bool = False,
    ids: Sequence[int] | None = None,
) -> None:
    """Write vertices and edges.

    Args:
        path: the file.
        poses: (4, 4) of each vertex.
        edges: between vertices by their place in `poses`.
        planar: keep x, y and heading only.
        ids: of the vertices in the file; None: 0, 1, ...

    Raises:
        OutputError: the file cannot be written.
    """
    names = range(len(poses)) if ids is None else ids
    vertex, edge = (_planar_vertex, _planar_edge) if planar else (_spatial_vertex, _spatial_edge)
    lines = [vertex(pose, name) for pose, name in zip(poses, names, strict=True)]
    _write(path, lines + [edge(item, names[item.first], names[item.second]) for item in edges])


def write_vertex_table(path: str | Path, vertices: Mapping[tuple[int, int], int]) -> None:
    """Write which vertex of a g2o file is which stamp: `id,session,stamp_ns` lines.

    Args:
        path: the file.
        vertices: vertex id by session and stamp.

    Raises:
        OutputError: the file cannot be written.
    """
    _write(path, ["id,session,stamp_ns", *(f"{v},{session},{stamp}" for (session, stamp), v in vertices.items())])


def _write(path: str | Path, lines: Iterable[str]) -> None:
    try:
        Path(path).write_text("".join(line + "\n" for line in lines), encoding="ascii")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from None


def _spatial_vertex(pose: Array, name: int) -> str:
    return f"VERTEX_SE3:QUAT {name} {_numbers([*pose[:3, 3], *to_quaternion(pose)])}"


def _spatial_edge(edge: Edge, first: int, second: int) -> str:
    information = np.linalg.inv(edge.covariance)[_SWAP][np.triu_indices(6)]
    measured = [*edge.pose[:3, 3], *to_quaternion(edge.pose)]
    return f"EDGE_SE3:QUAT {first} {second} {_numbers(measured)} {_numbers(information)}"


def _planar_vertex(pose: Array, name: int) -> str:
    return f"VERTEX_SE2 {name} {_numbers([*pose[:2, 3], heading(pose)])}"


def _planar_edge(edge: Edge, first: int, second: int) -> str:
    plane = np.linalg.inv(edge.covariance[np.ix_([3, 4, 2], [3, 4, 2])])[np.triu_indices(3)]
    measured = [*edge.pose[:2, 3], heading(edge.pose)]
    return f"EDGE_SE2 {first} {second} {_numbers(measured)} {_numbers(plane)}"


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:.12g}" for value in values)
