"""Pose graphs from g2o files, in three dimensions and in two, and the older TORO spelling of both.

An information matrix is read as GTSAM reads it: tangent space of the second vertex, translation
first, rotation in radians. A plane graph is lifted into space; what it does not say about height,
roll and pitch is given the weight of what it does say. Other programs leave the information out, write
zeros for unmeasured directions, the whole matrix, quaternions of any length or with w first: all are read.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from umf_ros.core.errors import GraphError, writing
from umf_ros.core.geometry import Array, heading, invert, make_pose
from umf_ros.core.io import read_lines
from umf_ros.core.trajectory import EDGE, g2o_lines
from umf_ros.pose_graph.closures import ClosureReason

LARGEST_ID = 2**63 - 1
_SIZES = {"VERTEX_SE2": 3, "VERTEX2": 3, "VERTEX_SE3:QUAT": 7, "VERTEX_SE3:EXPMAP": 7, "VERTEX3": 6}
_SIZES |= {"EDGE_SE2": 3, "EDGE2": 3, "EDGE_SE3:QUAT": 7, "EDGE_SE3:EXPMAP": 7, "EDGE3": 6}
_SIZES |= {"EDGE_SE2_SWITCHABLE": 3, "EDGE_SE3_SWITCHABLE": 7}
_SILENT = ("FIX", "PARAMS_")
_IN_PLANE = np.array([3, 4, 2])
_SWAP = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
# shares of the largest eigenvalue: information of an unmeasured direction; its replacement; placeholders for exact and
# for unknown in one matrix are no information at all (by hand)
_UNMEASURED, _FLOOR, _PLACEHOLDER = 1e-17, 1e-5, 1e-12


class Edge(NamedTuple):
    """A relative measurement between two vertices.

    Attributes:
        first: the vertex the pose is measured in.
        second: the measured vertex.
        pose: (4, 4) `first_T_second`.
        covariance: (6, 6) in GTSAM's order, tangent space of `second`.
    """

    first: int
    second: int
    pose: Array
    covariance: Array


@dataclass
class G2oGraph:
    """The content of a g2o file.

    Attributes:
        poses: (4, 4) initial poses by vertex id; may be empty.
        edges: relative poses between vertex ids.
        planar: all edges are two-dimensional.
        notes: conventions of the file that differ from g2o's, and what is not used.
        problems: what was wrong with lines that were skipped, each with its line number.
    """

    poses: dict[int, Array] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    planar: bool = False
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


class _Line(NamedTuple):
    """A vertex or an edge: its tag, one or two ids, and its numbers."""

    number: int
    tag: str
    ids: list[int]
    values: Array


MOST_PROBLEMS = 1000
"""Most malformed lines of a file that are named."""


def read_g2o(path: str | Path) -> G2oGraph:
    """Read a graph; a malformed line is skipped and named in `problems`.

    Raises:
        GraphError: the file cannot be read or holds no edge.
    """
    graph, ignored = G2oGraph(), Counter[str]()
    parsed: list[_Line] = []
    for number, text in enumerate(read_lines(path, GraphError), start=1):
        words = re.split(r"[\s,;]+", text.strip(" \t,;"))
        if not words[0] or words[0].startswith(("#", "%", *_SILENT)):
            continue
        if words[0] not in _SIZES and words[0].startswith(("VERTEX_", "EDGE_")):
            ignored[words[0][:40]] += 1
            continue
        try:
            parsed.append(_parse(number, words))
        except (GraphError, ValueError) as error:
            if len(graph.problems) < MOST_PROBLEMS:
                graph.problems.append(f"line {number}: {error}")
    if ignored:
        graph.notes.append("not used: " + ", ".join(f"{count} x {tag}" for tag, count in ignored.items()))
    _fill(graph, parsed)
    if not graph.edges:
        first = f" ({graph.problems[0]})" if graph.problems else ""
        raise GraphError(f"{path} holds no usable edge{first}")
    return graph


def _parse(number: int, words: list[str]) -> _Line:
    tag, length = words[0], len(words) - 1
    if tag not in _SIZES:
        raise GraphError(f"unknown tag {tag[:40]}")
    known, size = 1 if tag.startswith("VERTEX") else 2, _SIZES[tag]
    first = 3 if tag.endswith("SWITCHABLE") else known  # with the id of the switch
    side = 3 if size == 3 else 6
    usual = first + size + (side * (side + 1) // 2 if known == 2 else 0)
    if length not in {usual, *((first + size, first + size + side * side) if known == 2 else ())}:
        raise GraphError(f"{tag} has {length} values instead of {usual}")
    ids = [int(word) for word in words[1 : known + 1]]
    if not 0 <= min(ids) <= max(ids) <= LARGEST_ID:
        raise GraphError("negative vertex id, or one beyond all numbers")
    if known == 2 and ids[0] == ids[1]:
        raise GraphError(f"edge from vertex {ids[0]} to itself")
    values = np.array(words[first + 1 :], dtype=float)
    if not np.isfinite(values[:size]).all():
        raise GraphError("value is not finite")
    return _Line(number, tag, ids, values)


def _fill(graph: G2oGraph, parsed: list[_Line]) -> None:
    """Add vertices and edges to a graph, in the convention of its file."""
    tags = {line.tag for line in parsed}
    graph.planar = bool(tags) and not any("3" in tag for tag in tags if tag.startswith("EDGE"))
    turned = "VERTEX_SE3:EXPMAP" in tags  # poses of the world in cameras, rotation first
    if w_first := _is_w_first([line.values[3:7] for line in parsed if line.tag.startswith("EDGE_SE3")]):
        graph.notes.append("quaternions are read with w first: in their usual order all edges would turn by 180 deg")
    unknown: list[int] = []
    without_rotation = 0
    for line in parsed:
        try:
            pose = _read_pose(line.tag, line.values, w_first)
            pose = invert(pose) if turned and line.tag.endswith("EXPMAP") else pose
            if len(line.ids) == 1:
                graph.poses[line.ids[0]] = pose
                continue
            covariance = _read_covariance(line.tag, line.values[_SIZES[line.tag] :], turned)
        except (GraphError, ValueError) as error:
            if len(line.ids) == 1 and isinstance(error, _NoRotationError):
                without_rotation += 1
            else:
                graph.problems.append(f"line {line.number}: {error}")
            continue
        if covariance is None:
            unknown.append(len(graph.edges))
        graph.edges.append(Edge(line.ids[0], line.ids[1], pose, np.eye(6) if covariance is None else covariance))
    if without_rotation:
        graph.notes.append(f"{without_rotation} vertices have no rotation: their poses are not used")
    if unknown:
        _assume(graph, unknown)


def _assume(graph: G2oGraph, unknown: list[int]) -> None:
    """Give edges without usable information the median variances of the others, or one metre and radian."""
    rows = set(unknown)
    known = [np.diag(edge.covariance) for row, edge in enumerate(graph.edges) if row not in rows]
    if known:
        usual = np.diag(np.median(known, axis=0))
        graph.edges = [edge._replace(covariance=usual) if k in rows else edge for k, edge in enumerate(graph.edges)]
    what = "the usual one of the others is taken" if known else "all edges weigh the same"
    graph.notes.append(f"{len(unknown)} of {len(graph.edges)} edges have no usable information: {what}")


class _NoRotationError(ValueError):
    """A quaternion of zeros."""


def _is_w_first(quaternions: list[Array]) -> bool:
    """Return whether edges would nearly all be half turns about x with w last, and small rotations with w first."""
    sizes = np.abs(np.array(quaternions).reshape(-1, 4))
    usual = np.median(sizes / np.maximum(sizes.max(axis=1, keepdims=True), 1e-9), axis=0) if len(sizes) else np.ones(4)
    return bool(usual[0] > 0.9 and usual[3] < 0.3)


def _read_pose(tag: str, values: Array, w_first: bool) -> Array:
    size = _SIZES[tag]
    if size == 3:
        return make_pose(Rotation.from_euler("z", values[2]).as_matrix(), [*values[:2], 0.0])
    if size == 6:
        return make_pose(Rotation.from_euler("xyz", values[3:6]).as_matrix(), values[:3])
    quaternion = np.roll(values[3:7], -1) if w_first else values[3:7]
    if np.linalg.norm(quaternion) < 1e-3:
        raise _NoRotationError("quaternion of zeros")
    return make_pose(Rotation.from_quat(quaternion).as_matrix(), values[:3])


def _read_covariance(tag: str, values: Array, turned: bool) -> Array | None:
    """Return the (6, 6) covariance of the information of a line; None where it says nothing."""
    if not len(values) or not np.isfinite(values).all():
        return None
    if tag == "EDGE2":
        xx, xy, yy, tt, xt, yt = values
        plane = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
    elif _SIZES[tag] == 3:
        plane = _symmetric(values, 3)
    else:
        information = _symmetric(values, 6)
        return _covariance_of(information if turned and tag.endswith("EXPMAP") else information[_SWAP])
    information = np.zeros((6, 6))
    information[np.ix_(_IN_PLANE, _IN_PLANE)] = plane
    information[0, 0] = information[1, 1] = plane[2, 2]
    information[5, 5] = np.sqrt(max(0.0, plane[0, 0] * plane[1, 1]))
    return _covariance_of(information)


def _symmetric(values: Array, size: int) -> Array:
    if len(values) == size * size:
        return 0.5 * (values.reshape(size, size) + values.reshape(size, size).T)
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = values
    return matrix + np.triu(matrix, 1).T


def _covariance_of(information: Array) -> Array | None:
    """Invert an information matrix; unmeasured directions become very uncertain, None if it has placeholders only."""
    sizes, axes = np.linalg.eigh(information)
    largest = np.abs(sizes).max()
    if sizes[0] < -1e-9 * largest:
        raise GraphError(ClosureReason.COVARIANCE_NOT_POSITIVE)
    measured = sizes > _UNMEASURED * largest
    if not measured.any() or sizes[measured][0] < _PLACEHOLDER * largest:
        return None
    return (axes / np.where(measured, sizes, _FLOOR * largest)) @ axes.T


def write_plane(path: Path, poses: Array, edges: ArrayLike, ids: Sequence[int] | None = None) -> None:
    """Write a two-dimensional g2o file: position in the plane and heading; see `write_g2o`."""
    names, measured = range(len(poses)) if ids is None else ids, np.asarray(edges, EDGE)
    pairs = [(names[first], names[second]) for first, second in measured[["first", "second"]].tolist()]
    upper = np.triu_indices(3)
    information = np.linalg.inv(measured["covariance"][:, _IN_PLANE[:, None], _IN_PLANE])[:, upper[0], upper[1]]
    places, steps = (np.column_stack([one[:, :2, 3], heading(one)]) for one in (poses, measured["pose"]))
    lines = g2o_lines("VERTEX_SE2", [(name,) for name in names], places)
    with writing(path):
        edges_told = g2o_lines("EDGE_SE2", pairs, np.hstack([steps, information]))
        path.write_text("".join(lines + edges_told), encoding="utf-8")
