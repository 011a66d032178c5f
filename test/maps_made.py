"""Maps written by hand: sessions round one circle of 100 m, each a part of it, and closures between them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from umf_ros.core.config import Settings
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, expmap, make_pose, relative
from umf_ros.core.io import write_table
from umf_ros.maps.map_folder import BETWEEN, MapFolder, MapSession
from umf_ros.runs.run_file import CLOSURES, COLUMNS, RunFile, closure_row
from umf_ros.sensors.decode import OdometrySample

PERIOD_NS = 10**9
START_NS = 1_700_000_000 * 10**9
COVARIANCE = np.diag([0.05, 0.05, 0.05, 0.01, 0.01, 0.01]) ** 2
SIGMAS = np.array([0.002, 0.002, 0.003, 0.02, 0.02, 0.02])


def on_circle(metres: Array) -> Array:
    """(N, 4, 4) `world_T_body` after metres round the circle."""
    angle = 2 * np.pi * np.asarray(metres, float) / 100
    poses = np.tile(np.eye(4), (len(angle), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angle)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(angle), -np.sin(angle)
    poses[:, :2, 3] = 100 / (2 * np.pi) * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)
    return poses


@dataclass
class MadeSession:
    """A session of a metre per second from a place of the circle on; its clock starts like all others'."""

    name: str
    first_m: int
    last_m: int
    between: list[LoopClosure] = field(default_factory=list)

    @property
    def truth(self) -> Array:
        return on_circle(np.arange(self.first_m, self.last_m + 1))

    def stamp(self, metre: int) -> int:
        """Own clock."""
        return START_NS + (metre - self.first_m) * PERIOD_NS

    def drifting(self, seed: int) -> Iterator[OdometrySample]:
        """Odometry that drifts, from an origin of its own."""
        pose = np.eye(4)
        steps = relative_steps(self.truth)
        noise = expmap(np.random.default_rng(seed).normal(size=(len(steps), 6)) * SIGMAS)
        for row, stamp in enumerate(range(self.first_m, self.last_m + 1)):
            pose = pose if row == 0 else pose @ steps[row - 1] @ noise[row - 1]
            yield OdometrySample(self.stamp(stamp), pose)


def relative_steps(poses: Array) -> Array:
    return np.stack([relative(a, b) for a, b in pairwise(poses)])


def made_map(path: Path, sessions: list[MadeSession], settings: Settings | None = None) -> MapFolder:
    """The folder that `umf map` would have left before the joint graph is solved."""
    folder = MapFolder.open_or_create(path, settings or Settings())
    for number, made in enumerate(sessions):
        run = folder.folder_of(made.name)
        run.mkdir(parents=True)
        with closing(RunFile(run)) as file:
            for one in made.drifting(number):
                file.append_odometry(one)
        metres = range(made.first_m, made.last_m + 1)
        keyframes = [[made.stamp(metre), number, metre - made.first_m] for metre in metres]
        write_table(run / "keyframes.csv", COLUMNS["keyframes"], keyframes)
        write_table(run / "closures.csv", CLOSURES, [])
        first, last = made.stamp(made.first_m), made.stamp(made.last_m)
        recording = {"path": f"{made.name}.mcap", "start_ns": first, "end_ns": last, "messages": {"a": number}}
        shift = folder.shift_for(first)
        folder.add(MapSession(made.name, recording, shift, first, last, 100 * number, len(metres), number, 1))
        write_table(run / BETWEEN, CLOSURES, [closure_row(closure, 0.9) for closure in made.between])
    return folder


def tie(
    folder_shift: tuple[int, int], match: MadeSession, query: MadeSession, metre: int, at_m: int | None = None
) -> LoopClosure:
    """A right closure at a metre of the circle that both passed; wrong if it claims that the match was at `at_m`."""
    match_m = metre if at_m is None else at_m
    true = relative(*on_circle(np.array([metre, metre])))
    stamps = query.stamp(metre) + folder_shift[1], match.stamp(match_m) + folder_shift[0]
    return LoopClosure(*stamps, true @ make_pose(np.eye(3), [0, 0, 0]), COVARIANCE, 0.99)
