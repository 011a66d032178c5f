"""Simulated worlds to test on: several passes of one trail, each harder in its own way."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from umf_ros.core.frames import Frame, ScanMotion
from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.camera import resized
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.passes import SETTINGS, Pass, plan_passes, thinned
from umf_ros.lab.simulation.seeds import TEST, VALIDATION
from umf_ros.lab.simulation.survey import Survey, SurveyFrame
from umf_ros.lab.simulation.world import World, ground
from umf_ros.sensors.calibration import Calibration, load_calibration

WORLDS = 4
FIRST_SEEDS = {"test": TEST.start, "validation": VALIDATION.start}
FIRST, REVISIT, SAME_LIGHT, OPPOSITE = range(4)
"""Numbers of the passes."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """How densely the passes are driven: metres between references, and every how many steps a pass is asked.

    Attributes:
        step_m: distance between the samples of the first pass.
        revisit: the pass on an offset path under another sun takes every so many-th sample.
        same_light: so does the same pass under the first one's sun.
        opposite: so does the pass in the opposite direction.
    """

    step_m: float
    revisit: int
    same_light: int
    opposite: int


FULL = Sampling(step_m=1.6, revisit=2, same_light=4, opposite=4)
QUICK = Sampling(step_m=3.2, revisit=4, same_light=8, opposite=8)


@dataclass(frozen=True, slots=True)
class Visit:
    """A frame and where it was taken.

    Attributes:
        frame: at training resolution, with the intrinsics of that resolution.
        world_T_body: true pose.
        pass_index: which pass.
    """

    frame: Frame
    world_T_body: Array
    pass_index: int


class TestWorld:
    """One world in the hard setting (offset to 4.5 m, yaw 16 deg, sun moved 70 deg, aliasing).

    Args:
        seed: of the world; its family follows from it.
        sampling: how densely it is driven.
        calibration: of the rover; None: the simulated one.
    """

    __test__ = False  # no test of pytest's, whatever the name suggests

    def __init__(self, seed: int, sampling: Sampling, calibration: Calibration | None = None) -> None:
        self.seed, self.family = seed, FAMILIES[seed % len(FAMILIES)]
        self.name = f"{self.family} {seed}"
        self._sampling = sampling
        self._calibration = calibration or load_calibration("simulated")

    @cached_property
    def passes(self) -> list[Pass]:
        """The drives by their numbers."""
        return _drives(self.seed, self.family, self._sampling)

    def __len__(self) -> int:
        return sum(len(drive.path) for drive in self.passes)

    @property
    def revisits(self) -> int:
        """Samples of the pass that is reranked."""
        return len(self.passes[REVISIT].path)

    def __iter__(self) -> Iterator[Visit]:
        """Build the world and drive; takes some seconds before the first frame."""
        return self.driven(range(len(self.passes)))

    def driven(self, wanted: Collection[int]) -> Iterator[Visit]:
        """The same, of some passes alone."""
        path = np.concatenate([drive.path for drive in self.passes])
        world = World(self.seed, self.family, SETTINGS["hard"].aliasing, path)
        calibration = self._calibration
        drives = [
            drive if number in wanted else thinned(drive, len(drive.path)) for number, drive in enumerate(self.passes)
        ]
        for stamp, sample in enumerate(Survey(world, drives, calibration)):
            if sample.pass_index in wanted:
                yield visit_of(stamp, sample, calibration)


def test_worlds(first_seed: int, sampling: Sampling, count: int = WORLDS) -> list[TestWorld]:
    """So many worlds of different families, made from `first_seed` on."""
    return [TestWorld(first_seed + number, sampling) for number in range(count)]


def _drives(seed: int, family: str, sampling: Sampling) -> list[Pass]:
    setting = SETTINGS["hard"]
    trail = ground(seed, family, setting.aliasing).trail
    first, offset, opposite = plan_passes(trail, ("first", "offset", "opposite"), setting, sampling.step_m, seed)
    same_light = replace(offset, label="same light", sun=first.sun)
    return [
        first,
        thinned(offset, sampling.revisit),
        thinned(same_light, sampling.same_light),
        thinned(opposite, sampling.opposite),
    ]


def visit_of(stamp_ns: int, sample: SurveyFrame, calibration: Calibration) -> Visit:
    """A simulated sample as a frame, its intrinsics those of its resolution."""
    height, width = sample.image.shape
    points = sample.points.astype(np.float32)
    frame = Frame(
        stamp_ns=stamp_ns,
        camera=resized(calibration.camera, width, height),
        body_T_camera=calibration.body_T_camera,
        body_T_lidar=calibration.body_T_lidar,
        left=sample.image,
        points=points[:, :3],
        intensity=points[:, 3],
        motion=ScanMotion.none(len(points)),
    )
    return Visit(frame, sample.world_T_body.astype(float), sample.pass_index)
