"""Pose graphs of two laps as other programs write them: 80 poses, 20 closures, some with 3 wrong ones.

Spellings of one edge, units off by decades, and measurements written twice are cases of the tests of g2o files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from pathlib import Path

import gtsam
import numpy as np
from dialect_case import Case, Check, last_line
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, invert, make_pose, to_quaternion
from umf_ros.lab.datasets.g2o import read_g2o
from umf_ros.lab.program import Ended
from umf_ros.runs.truth import absolute_trajectory_error

COUNT, LAP = 80, 40
SIGMA_M, SIGMA_RAD = 0.03, 0.01
INFORMATION = (SIGMA_M**-2.0,) * 3 + (SIGMA_RAD**-2.0,) * 3
SLACK = 1.05
"""Largest error, of that of GTSAM's Levenberg-Marquardt on the graph without faults."""
POSITIONS = "singular_position_only"
"""Closures of positions alone, which leave a larger error."""
Measured = tuple[int, int, Array]
Ids = Callable[[int], int]


def _pose(k: int) -> Array:
    a = 2 * np.pi * k / LAP
    turn = Rotation.from_euler("zyx", [a + np.pi / 2, 0.05 * np.sin(a), 0.03 * np.cos(a)])
    return make_pose(turn.as_matrix(), [12 * np.cos(a), 12 * np.sin(a), 0.8 * np.sin(2 * a)])


_RNG = np.random.default_rng(7)
TRUE = np.stack([_pose(k) for k in range(COUNT)])


def _noisy(pose: Array) -> Array:
    turn = Rotation.from_rotvec(_RNG.normal(0, SIGMA_RAD, 3)).as_matrix()
    return pose @ make_pose(turn, _RNG.normal(0, SIGMA_M, 3))


def _measure(pairs: Sequence[tuple[int, int]]) -> list[Measured]:
    return [(a, b, _noisy(invert(TRUE[a]) @ TRUE[b])) for a, b in pairs]


ODOMETRY = _measure([(k, k + 1) for k in range(COUNT - 1)])
CLOSURES = _measure([(k, k + LAP) for k in range(0, LAP, 2)])
SKIPPING = _measure([(k, k + 2) for k in range(COUNT - 2)])
WRONG = [(a, b, _noisy(np.eye(4))) for a, b in ((5, 61), (11, 72), (17, 47))]
COMPOSED = [(k, k + 2, ODOMETRY[k][2] @ ODOMETRY[k + 1][2]) for k in range(COUNT - 2)]
INITIAL = [TRUE[0]]
for _, _, _step in ODOMETRY:
    INITIAL.append(INITIAL[-1] @ _step)
PLAIN = [*ODOMETRY, *CLOSURES]
APART = [edge for edge in PLAIN if edge[0] != LAP - 1]
"""Both laps as two rovers."""


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _numbers(pose: Array, scale: float = 1.0) -> list[float]:
    return [*pose[:3, 3], *scale * to_quaternion(pose)]


def _upper(diagonal: Iterable[float]) -> Array:
    return np.diag(list(diagonal))[np.triu_indices(len(list(diagonal)))]


def vertices(name: Ids = int, scale: float = 1.0, tag: str = "VERTEX_SE3:QUAT") -> list[str]:
    """Lines of the initial poses."""
    return [f"{tag} {name(k)} {_text(_numbers(pose, scale))}" for k, pose in enumerate(INITIAL)]


def edges(
    measured: Sequence[Measured],
    information: Sequence[float] = INFORMATION,
    name: Ids = int,
    scale: float = 1.0,
    tag: str = "EDGE_SE3:QUAT",
) -> list[str]:
    """Lines of edges with a diagonal information matrix."""
    upper = _text(_upper(information))
    return [f"{tag} {name(a)} {name(b)} {_text(_numbers(z, scale))} {upper}" for a, b, z in measured]


def _flat(pose: Array) -> list[float]:
    return [*pose[:2, 3], float(Rotation.from_matrix(pose[:3, :3]).as_euler("zyx")[0])]


def _plane(heading_of_closures: float = SIGMA_RAD**-2.0) -> list[str]:
    lines = [f"VERTEX_SE2 {k} {_text(_flat(pose))}" for k, pose in enumerate(INITIAL)]
    for measured, heading in ((ODOMETRY, SIGMA_RAD**-2.0), (CLOSURES, heading_of_closures)):
        upper = _text(_upper([*INFORMATION[:2], heading]))
        lines += [f"EDGE_SE2 {a} {b} {_text(_flat(z))} {upper}" for a, b, z in measured]
    return lines


def _symbol(k: int) -> int:
    return (ord("ab"[k // LAP]) << 56) + k % LAP


IDS: dict[str, Ids] = {
    "symbols_two_robots": _symbol,
    "descending": lambda k: COUNT - k,
    "stamps": lambda k: 10**18 + k**2,
}


def _toro() -> list[str]:
    def row(pose: Array) -> str:
        return _text([*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")])

    return [f"VERTEX3 {k} {row(pose)}" for k, pose in enumerate(INITIAL)] + [
        f"EDGE3 {a} {b} {row(z)} {_text(_upper(INFORMATION))}" for a, b, z in PLAIN
    ]


def _tags() -> dict[str, list[str]]:
    head, upper = vertices(), _text(_upper(INFORMATION))
    landmark = "EDGE_SE3_TRACKXYZ 3 900 0 1 1 1 1 0 0 1 0 1"
    return {
        "params": ["PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1", *head, "VERTEX_TRACKXYZ 900 1 2 3", *edges(PLAIN), landmark],
        "prior": [*head, f"EDGE_SE3_PRIOR 0 0 {_text(_numbers(INITIAL[0]))} {upper}", *edges(PLAIN)],
        "expmap": [*head, *edges(PLAIN, tag="EDGE_SE3:EXPMAP")],
        "toro": _toro(),
    }


def _digits() -> dict[str, list[str]]:
    head, upper = vertices(), _text(_upper(INFORMATION))
    short = [f"VERTEX_SE3:QUAT {k} " + " ".join(f"{x:.2f}" for x in _numbers(p)) for k, p in enumerate(INITIAL)]
    short += [f"EDGE_SE3:QUAT {a} {b} {' '.join(f'{x:.2f}' for x in _numbers(z))} {upper}" for a, b, z in PLAIN]
    return {
        "negative_w": [*vertices(scale=-1), *edges(PLAIN, scale=-1)],
        "short_digits": short,
        POSITIONS: [*head, *edges(ODOMETRY), *edges(CLOSURES, [*INFORMATION[:3], 0, 0, 0])],
        "infinite_z": [*head, *edges(PLAIN, [*INFORMATION[:2], 1e-9, *INFORMATION[3:]])],
        "infinite": [*head, *edges(ODOMETRY, [np.inf] * 6), *edges(CLOSURES)],
        "wheel_covariance": [*head, *edges(ODOMETRY, [1e9, 1e9, 1e-6, 1e-6, 1e-6, 1e3]), *edges(CLOSURES)],
        "huge": [*head, *edges(PLAIN, [1e12] * 6)],
        "se2": _plane(),
        "se2_singular_heading": _plane(0.0),
    }


def _structures() -> dict[str, tuple[list[str], list[Measured]]]:
    """Lines, and the edges that an ordinary optimiser needs."""
    head = vertices()
    unsorted = [head[k] for k in np.random.default_rng(3).permutation(COUNT)]
    longer = [(k, k + 3, COMPOSED[k][2] @ ODOMETRY[k + 2][2]) for k in range(COUNT - 3)]
    lines = {
        "plain": [*head, *edges(PLAIN)],
        "closures_first": [*head, *edges([*CLOSURES, *ODOMETRY])],
        "unsorted": [*edges(PLAIN)[::-1], *unsorted],
        "no_vertices": edges(PLAIN),
        "closures_twice": [*head, *edges([*PLAIN, *CLOSURES])],
        "odometry_partly_twice": [*head, *edges([*ODOMETRY, *ODOMETRY[::10], *CLOSURES])],
        "odometry_once_twice": [*head, *edges([*ODOMETRY, ODOMETRY[20], *CLOSURES])],
        "skip_three_too": [*head, *edges([*PLAIN, *longer])],
    }
    lines |= {name: [*vertices(IDS[name]), *edges(PLAIN, name=IDS[name])] for name in ("descending", "stamps")}
    found = {name: (one, PLAIN) for name, one in lines.items()}
    every_second = [*SKIPPING, ODOMETRY[0], *CLOSURES]
    found["skip_one"] = [*head, *edges(every_second)], every_second
    found["symbols_two_robots"] = [*vertices(_symbol), *edges(APART, name=_symbol)], APART
    lap = [edge for edge in ODOMETRY if edge[0] != LAP - 1]
    found["two_components"] = [*head, *edges(lap)], lap
    return found


def _units() -> dict[str, list[str]]:
    stated = {"identity": [1.0] * 6, "covariance": [SIGMA_M**2] * 3 + [SIGMA_RAD**2] * 3}
    stated |= {f"x1e{power}": [10.0**power * one for one in INFORMATION] for power in (-8, -2, 2, 8)}
    found = {}
    for name, information in stated.items():
        found[f"units_{name}"] = [*vertices(), *edges(PLAIN, information)]
        found[f"units_{name}_wrong"] = [*vertices(), *edges([*PLAIN, *WRONG], information)]
    return found


@cache
def _reference(key: str) -> float:
    """Error of GTSAM's Levenberg-Marquardt on the edges of a structure, m."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, pose in enumerate(INITIAL):
        values.insert(k, gtsam.Pose3(pose))
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(TRUE[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    if key == "two_components":
        graph.add(gtsam.PriorFactorPose3(LAP, gtsam.Pose3(INITIAL[LAP]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    measured = _structures()[key][1] if key != POSITIONS else PLAIN
    for a, b, pose in measured:
        sigma_rad = 1e3 if key == POSITIONS and b - a == LAP else SIGMA_RAD
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma_rad] * 3 + [SIGMA_M] * 3))
        graph.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(pose), noise))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found = np.array([solved.atPose3(k).translation() for k in range(COUNT)])
    return absolute_trajectory_error(found, TRUE[:, :3, 3])


def _near_reference(key: str, name: Ids, flat: bool) -> Check:
    truth = TRUE[:, :3, 3] * [1, 1, 0 if flat else 1]

    def check(ended: Ended, folder: Path) -> tuple[bool, str]:
        file = folder / "out.g2o"
        if ended.status or not file.is_file():
            return False, last_line(ended)
        poses = read_g2o(file).poses
        found = np.array([poses[name(k)][:3, 3] for k in range(COUNT) if name(k) in poses])
        if len(found) < COUNT:
            return False, f"{len(found)} of {COUNT} poses"
        error_m = absolute_trajectory_error(found, truth)
        return error_m <= SLACK * _reference(key), f"{error_m:.3f} m"

    return check


def _write(lines: Sequence[str], folder: Path) -> None:
    (folder / "out.g2o").unlink(missing_ok=True)
    (folder / "in.g2o").write_text("\n".join([*lines, ""]), "utf-8")


def _case(name: str, lines: Sequence[str], key: str = "plain") -> Case:
    check = _near_reference(key, IDS.get(name, int), name.startswith("se2"))
    command = ("graph", "optimize", "in.g2o", "-o", "out.g2o")
    return Case(f"09 {name}", partial(_write, lines), command, f"ATE at most {SLACK * _reference(key):.3f} m", check)


CASES = [
    *(_case(name, lines, "plain" if needed is PLAIN else name) for name, (lines, needed) in _structures().items()),
    *(
        _case(name, lines, name if name == POSITIONS else "plain")
        for group in (_tags, _digits, _units)
        for name, lines in group().items()
    ),
]
