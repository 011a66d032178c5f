"""Retrieval on a recording with ground truth, as the live node would retrieve."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from umf_ros.core.config import Database, Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Frame, Keyframe
from umf_ros.core.trajectory import Trajectory
from umf_ros.detector import LoopDetector
from umf_ros.embedding.embedder import Embedder
from umf_ros.lab.evaluation.protocol import RetrievalTask, loop_closure
from umf_ros.lab.evaluation.results import (
    HEADINGS,
    EvaluationReport,
    Figures,
    plot_precision_recall,
    plot_recall,
    rounded,
    scores_table,
)
from umf_ros.lab.evaluation.retrieval import METHODS, rank, rerank_all
from umf_ros.lab.evaluation.scores import Scores, score

PICTURES = {"Precision and recall": "precision_recall.png", "Recall": "recall.png"}
SHOWN = ("fused", "superfeatures both", "ransac both")


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
        values |= {f"recall1_{name.split()[0]}": self.scores[name].recall1 for name in SHOWN[1:] if name in self.scores}
        return {"keyframes": self.keyframes, "queries": found.queries} | rounded(values)

    def write(self, folder: Path, notes: list[str]) -> EvaluationReport:
        """Write the table, the figures and the curves.

        Raises:
            OutputError: the folder cannot be written.
        """
        shown = {name: self.scores[name] for name in SHOWN if name in self.scores}
        plot_precision_recall(folder / "precision_recall.png", {name: [found.curve] for name, found in shown.items()})
        plot_recall(folder / "recall.png", {name: found.recalls for name, found in shown.items()}, "candidates")
        tables = {"Loop-closure protocol": scores_table({name: [found] for name, found in self.scores.items()})}
        report = EvaluationReport("Evaluation on a recording", notes, self.figures(), tables, PICTURES)
        report.write(folder)
        return report


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
