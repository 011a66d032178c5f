"""Evaluate on frames of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from umf_ros.baselines.handcrafted import ThumbnailEmbedder
from umf_ros.core.config import Database, Loop, Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Frame, Keyframe, ScanMotion
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory
from umf_ros.detector import LoopDetector
from umf_ros.embedding import Embedder
from umf_ros.lab.datasets.s3li import ETNA_TEST
from umf_ros.lab.datasets.sample import Rule, SampleSequence
from umf_ros.lab.evaluation.methods_run import FrameSet
from umf_ros.lab.evaluation.places import PlaceSet, read_set
from umf_ros.lab.evaluation.results import (
    HEADINGS,
    EvaluationReport,
    Figures,
    Scores,
    rounded,
    score,
    scores_table,
)
from umf_ros.lab.evaluation.retrieval import (
    METHODS,
    RetrievalTask,
    loop_closure,
    place_recognition,
    rank,
    rerank_all,
    revisits,
)
from umf_ros.lab.evaluation.summary import DRAWN
from umf_ros.lab.evaluation.worlds import FIRST, REVISIT, TestWorld, visit_of
from umf_ros.lab.simulation.camera import resized
from umf_ros.lab.simulation.presets import etna_surveys
from umf_ros.lab.simulation.route import thinned
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


@dataclass(frozen=True, slots=True)
class BagResult:
    """How well a recording's own past is recognised.

    Attributes:
        keyframes: frames that became keyframes and have a true pose.
        scores: of the descriptor alone ("fused") and of the rerankers.
    """

    keyframes: int
    scores: dict[str, Scores]

    def figures(self) -> Figures:
        """The figures of the descriptor alone, and recall@1 of the rerankers."""
        found = self.scores["fused"]
        values = {name.replace("within_5m", "within5m"): getattr(found, name) for name in HEADINGS}
        values |= {f"recall1_{name.split()[0]}": self.scores[name].recall1 for name in DRAWN[1:] if name in self.scores}
        return {"keyframes": self.keyframes, "queries": found.queries} | rounded(values)

    def report(self, notes: list[str]) -> EvaluationReport:
        """Figures, table and curves."""
        shown = {name: [self.scores[name]] for name in DRAWN if name in self.scores}
        tables = {"Loop-closure protocol": scores_table({name: [found] for name, found in self.scores.items()})}
        return EvaluationReport("Evaluation on a recording", notes, self.figures(), tables, shown)


class BagEvaluation:
    """Has the detector choose and embed keyframes, and asks each for its own past.

    Args:
        settings: of keyframes, of the gaps and of reranking.
        embedder: the same as the node's.

    Attributes:
        keyframes: what the detector would remember.
    """

    def __init__(self, settings: Settings, embedder: Embedder) -> None:
        self._settings = settings
        # places of earlier runs are not asked for
        self._detector = LoopDetector(settings.model_copy(update={"database": Database()}), embedder)
        self.keyframes: list[Keyframe] = []

    def remember(self, frames: Iterable[Frame], report: Callable[[Frame, int], None]) -> None:
        """Embed the keyframes among the frames of the recording's first session."""
        for frame in frames:
            if frame.session:
                break
            if self._detector.select(frame):
                self.keyframes.append(self._detector.embed(frame))
            report(frame, len(self.keyframes))

    def judge(self, truth: Trajectory, report: Callable[[], None] = lambda: None) -> BagResult:
        """Score against the truth.

        Raises:
            UmfError: the truth covers none of the keyframes.
        """
        keyframes = self.keyframes
        stamps = np.array([keyframe.stamp_ns for keyframe in keyframes], np.int64)
        poses, known = truth.at(stamps)
        if not known.any():
            raise UmfError(f"the ground truth covers none of the {len(keyframes)} keyframes; do the clocks agree?")
        rows = np.flatnonzero(known)
        path_length = np.array([keyframe.path_length_m for keyframe in keyframes])
        task = loop_closure(stamps[rows], poses[rows], path_length[rows], self._settings.loop, truth.has_orientation)
        return BagResult(len(rows), self._scores(task, rows, report))

    def _scores(self, task: RetrievalTask, rows: np.ndarray, report: Callable[[], None]) -> dict[str, Scores]:
        kept = [self.keyframes[row] for row in rows]
        descriptors = np.stack([keyframe.embedding.descriptor for keyframe in kept])
        similarity = descriptors @ descriptors.T
        ranking = rank(similarity, task.admissible)
        scores = {"fused": score(task, ranking, unanswerable_count=True)}
        if not any(keyframe.embedding.image or keyframe.embedding.cloud for keyframe in kept):
            return scores  # a baseline has no local features
        reranking = rerank_all(kept, kept, ranking, similarity, self._settings.verification, report)
        return scores | {name: score(task, reranking.after(name), unanswerable_count=True) for name in METHODS}
