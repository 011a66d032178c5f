"""Retrieval on a recording with ground truth, as the live node would retrieve."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from umf_ros.config import Database, Settings
from umf_ros.embedding.embedder import Embedder
from umf_ros.errors import UmfError
from umf_ros.frames import Frame, Keyframe
from umf_ros.lab.evaluation.curve_plots import plot_precision_recall, plot_recall
from umf_ros.lab.evaluation.markdown import Table, to_markdown
from umf_ros.lab.evaluation.protocol import Task, loop_closure
from umf_ros.lab.evaluation.reranking import METHODS, gather_evidence
from umf_ros.lab.evaluation.retrieval import rank
from umf_ros.lab.evaluation.scores import Scores, score
from umf_ros.lab.evaluation.summary import percent
from umf_ros.loop_detector import LoopDetector
from umf_ros.runs.folder import write_atomically
from umf_ros.trajectory import Trajectory

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

    def flat(self) -> dict[str, float | int | None]:
        """The figures of the descriptor alone, and recall@1 of the rerankers."""
        found = self.scores["fused"]
        values: dict[str, float] = {
            "recall1": found.recall1,
            "recall5": found.recall5,
            "recall_top_percent": found.recall_top_percent,
            "recall1_within5m": found.recall1_within_5m,
            "auc_pr": found.auc_pr,
            "recall_at_precision1": found.recall_at_precision1,
        }
        values |= {f"recall1_{name.split()[0]}": self.scores[name].recall1 for name in SHOWN[1:] if name in self.scores}
        rounded = {name: round(value, 4) if np.isfinite(value) else None for name, value in values.items()}
        return {"keyframes": self.keyframes, "queries": found.queries} | rounded

    def table(self) -> Table:
        """One row per ranking."""
        head = ["", "R@1", "R@5", "top 1 %", "within 5 m", "AUC-PR", "R@100 % P"]
        rows = []
        for name, found in self.scores.items():
            values = [found.recall1, found.recall5, found.recall_top_percent, found.recall1_within_5m]
            rows.append([name, *map(percent, [*values, found.auc_pr, found.recall_at_precision1])])
        return head, rows


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
        travelled = np.array([keyframe.travelled_m for keyframe in keyframes])
        task = loop_closure(stamps[rows], poses[rows], travelled[rows], self._settings.loop, truth.has_orientation)
        return BagResult(len(rows), self._scores(task, rows, report))

    def _scores(self, task: Task, rows: np.ndarray, report: Callable[[], None]) -> dict[str, Scores]:
        kept = [self.keyframes[row] for row in rows]
        descriptors = np.stack([keyframe.embedding.descriptor for keyframe in kept])
        similarity = descriptors @ descriptors.T
        ranking = rank(similarity, task.admissible)
        scores = {"fused": score(task, ranking, unanswerable_count=True)}
        if not any(keyframe.embedding.image or keyframe.embedding.cloud for keyframe in kept):
            return scores  # a baseline has no local features
        evidence = gather_evidence(kept, kept, ranking, similarity, self._settings.verification, report)
        return scores | {
            name: score(task, evidence.ranking(ranking, name), unanswerable_count=True) for name in METHODS
        }


def write_bag_result(folder: Path, result: BagResult, notes: list[str]) -> None:
    """Write the table, the figures and the curves.

    Raises:
        OutputError: the folder cannot be written.
    """
    shown = {name: result.scores[name] for name in SHOWN if name in result.scores}
    plot_precision_recall(folder / "precision_recall.png", {name: [found.curve] for name, found in shown.items()})
    plot_recall(folder / "recall.png", {name: found.recalls for name, found in shown.items()}, "candidates")
    write_atomically(folder / "evaluation.json", json.dumps(result.flat(), indent=2) + "\n")
    pictures = {"Precision and recall": "precision_recall.png", "Recall": "recall.png"}
    tables = {"Loop-closure protocol": result.table()}
    write_atomically(folder / "evaluation.md", to_markdown("Evaluation on a recording", notes, tables, pictures))
