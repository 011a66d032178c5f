"""What all methods are asked: simulated worlds, sequences, a recording, still images and scans, as frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from umf_ros.baselines.handcrafted import ThumbnailEmbedder
from umf_ros.core.config import Database, Loop, Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Frame, ScanMotion
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory
from umf_ros.detector import LoopDetector
from umf_ros.lab.datasets.labels import Rule
from umf_ros.lab.datasets.s3li import ETNA_TEST
from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.lab.evaluation.methods_run import FrameSet
from umf_ros.lab.evaluation.places import PlaceSet, read_set
from umf_ros.lab.evaluation.protocol import RetrievalTask, loop_closure, place_recognition, revisits
from umf_ros.lab.evaluation.worlds import FIRST, REVISIT, TestWorld, visit_of
from umf_ros.lab.simulation.camera import resized
from umf_ros.lab.simulation.passes import thinned
from umf_ros.lab.simulation.sequences import etna_surveys
from umf_ros.lab.simulation.survey import Survey

SPEED_M_S = 1.0
"""Of a simulated sequence, whose samples have no stamps of their own."""


def world_set(world: TestWorld) -> FrameSet:
    """The first drive and the one on an offset path under another sun."""
    poses: list[Array] = []
    passes: list[int] = []

    def frames() -> Iterator[Frame]:
        for visit in world.driven((FIRST, REVISIT)):
            poses.append(visit.world_T_body)
            passes.append(visit.pass_index)
            yield visit.frame

    return FrameSet(world.name, frames(), lambda: place_recognition(np.stack(poses), np.array(passes)))


def sequence_set(sequence: SampleSequence, rule: Rule) -> FrameSet:
    """A sequence: in a simulated world later passes are asked for the first, in a recording for all earlier ones."""
    protocol = revisits if sequence.setting == "real" else place_recognition

    def frames() -> Iterator[Frame]:
        for index in range(len(sequence)):
            yield _frame(sequence, index)

    def task() -> RetrievalTask:
        return protocol(np.asarray(sequence.world_T_body), np.asarray(sequence.pass_index), rule)

    return FrameSet(sequence.name, frames(), task)


def recording_set(name: str, frames: Iterable[Frame], truth: Trajectory, settings: Settings) -> FrameSet:
    """The keyframes that the detector would choose, each asked for its own past.

    Its task raises:
        UmfError: the truth covers none of them.
    """
    kept: list[tuple[int, float]] = []
    # who embeds is of no account: nothing is asked of the detector but which frames it keeps
    detector = LoopDetector(settings.model_copy(update={"database": Database()}), ThumbnailEmbedder())

    def keyframes() -> Iterator[Frame]:
        for frame in frames:
            if frame.session:
                return
            if detector.select(frame) and truth.at(np.array([frame.stamp_ns]))[1][0]:
                kept.append((frame.stamp_ns, detector.embed(frame).path_length_m))
                yield frame

    def task() -> RetrievalTask:
        if not kept:
            raise UmfError("the ground truth covers none of the keyframes; do the clocks agree?")
        stamps, path_length = np.array([one[0] for one in kept], np.int64), np.array([one[1] for one in kept])
        return loop_closure(stamps, truth.at(stamps)[0], path_length, settings.loop, truth.has_orientation)

    return FrameSet(name, keyframes(), task, unanswerable_count=True)


def drive_sets(seed: int, every: int) -> Iterator[FrameSet]:
    """Every n-th sample of the simulated sequences that [UMF 5.1.2] tests on, each asked for its own past."""
    for name, survey in etna_surveys(seed):
        if f"s3li_{name}" in ETNA_TEST:
            passes = [thinned(drive, every) for drive in survey.passes]
            yield _drive_set(f"{name} {seed}", Survey(survey.world, passes, survey.calibration))


def _drive_set(name: str, survey: Survey) -> FrameSet:
    steps = [(number, step) for number, drive in enumerate(survey.passes) for step in range(len(drive.path))]
    world_T_body = np.stack([survey.pose(*step) for step in steps])
    moved = np.linalg.norm(np.diff(world_T_body[:, :3, 3], axis=0), axis=1)
    path_length_m = np.concatenate([[0.0], np.cumsum(moved)])
    stamps = (path_length_m / SPEED_M_S * 1e9).astype(np.int64)
    seen = (survey.sample(*step) for step in steps)
    frames = (visit_of(at, one, survey.calibration).frame for at, one in zip(stamps.tolist(), seen, strict=True))
    return FrameSet(name, frames, lambda: loop_closure(stamps, world_T_body, path_length_m, Loop()), True)


def still_set(places: PlaceSet) -> FrameSet:
    """Queries, then references, of a set of still images or scans.

    Raises:
        UmfError: something of the set is missing or damaged.
    """
    frames, task = read_set(places)
    return FrameSet(places.name, frames, lambda: task)


def _frame(sequence: SampleSequence, index: int) -> Frame:
    sample = sequence.sample(index)
    camera = sample.camera
    if sample.image is not None:
        height, width = sample.image.shape
        camera = resized(camera, width, height)
    return Frame(
        stamp_ns=index,
        camera=camera,
        body_T_camera=sample.body_T_camera,
        body_T_lidar=np.eye(4),
        left=sample.image,
        points=sample.points,
        intensity=sample.intensity,
        motion=None if sample.points is None else ScanMotion.none(len(sample.points)),
    )
