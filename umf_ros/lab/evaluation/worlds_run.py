"""An evaluation on simulated worlds, from the weights to the report."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from umf_ros.config import EmbeddingSettings, Verification
from umf_ros.embedding import METHODS, make_embedder
from umf_ros.embedding.embedder import Embedder
from umf_ros.embedding.umf_embedder import UmfEmbedder
from umf_ros.frames import Frame
from umf_ros.lab.evaluation.attention_plots import look, plot_keypoints, plot_superfeatures
from umf_ros.lab.evaluation.curve_plots import plot_precision_recall, plot_recall
from umf_ros.lab.evaluation.embedding_plots import plot_embeddings
from umf_ros.lab.evaluation.latency import at_full_size, cost_of_weights
from umf_ros.lab.evaluation.markdown import to_markdown
from umf_ros.lab.evaluation.scores import Scores
from umf_ros.lab.evaluation.summary import WorldsSummary
from umf_ros.lab.evaluation.world_evaluation import WorldEvaluation, WorldResult
from umf_ros.lab.evaluation.worlds import TestWorld
from umf_ros.networks.weights import load_weights, locate_weights
from umf_ros.runs.folder import write_atomically

RERANKED = ("fused", "superfeatures both", "ransac both")
TIMED_FRAMES = 8
PICTURES = {
    "Precision and recall (figure 5.13)": "precision_recall.png",
    "Recall among the first candidates": "recall.png",
    "Recall@1 by number of reranked candidates (figure 5.12)": "candidates.png",
    "Descriptors in the plane (figures 5.10 and 5.11)": "embeddings.png",
    "Attention of super-features on images and voxels (figures 5.5 to 5.7)": "superfeatures.png",
    "Key-points and fusion (figure 5.8)": "keypoints.png",
}


class WorldsRun:
    """Evaluates one network on some worlds and fills a results folder.

    Args:
        weights: safetensors file or name of shipped weights, or None for the default.
        worlds: to drive through.
        repeats: how often each frame is embedded when time is taken.
        others: whether to compare with the methods that need no training.
        report: called with the name of what is worked on, and 1 for every frame or query done.
    """

    def __init__(
        self,
        weights: Path | None,
        worlds: list[TestWorld],
        repeats: int,
        others: bool,
        report: Callable[[str, int], None],
    ) -> None:
        self._weights = locate_weights(weights)
        self._worlds, self._repeats, self._report = worlds, repeats, report
        self._embedder = UmfEmbedder(self._weights, super_features=True)
        names = [name for name in METHODS if name != "umf"] if others else []
        self._others = {name: make_embedder(EmbeddingSettings(method=name)) for name in names}

    def run(self) -> WorldsSummary:
        """Drive through all worlds, then take times."""
        results: list[WorldResult] = []
        baselines: dict[str, list[Scores]] = {name: [] for name in self._others}
        for world in self._worlds:
            evaluation = WorldEvaluation(world, self._embedder, Verification(), lambda: self._report(world.name, 1))  # noqa: B023
            results.append(evaluation.run())
            for name, embedder in self._others.items():
                baselines[name].append(evaluation.compare(embedder))
        self._report("taking times", 0)
        seen = [frame for result in results for pair in result.examples for frame in pair]
        frames = [at_full_size(frame) for frame in seen[:TIMED_FRAMES]]
        default = cost_of_weights(self._weights, frames, self._repeats)
        return WorldsSummary(results, baselines, default, cost_of_weights(Path("umf_resnet50"), frames, self._repeats))

    def write(self, summary: WorldsSummary, folder: Path, notes: list[str]) -> None:
        """Write tables, figures and pictures.

        Raises:
            OutputError: the folder cannot be written.
        """
        self._report("drawing", 0)
        self._draw(summary, folder)
        write_atomically(folder / "evaluation.json", json.dumps(summary.flat(), indent=2) + "\n")
        text = to_markdown("Evaluation on simulated worlds", notes, summary.tables(), PICTURES)
        write_atomically(folder / "evaluation.md", text)

    def _draw(self, summary: WorldsSummary, folder: Path) -> None:
        results = summary.results
        curves = {name: [result.scores[name].curve for result in results] for name in RERANKED}
        plot_precision_recall(folder / "precision_recall.png", curves)
        recalls = {name: np.mean([result.scores[name].recalls for result in results], axis=0) for name in RERANKED}
        plot_recall(folder / "recall.png", recalls, "candidates")
        by_count = {
            name: np.mean([result.by_candidates[name] for result in results], axis=0)
            for name in results[0].by_candidates
        }
        plot_recall(folder / "candidates.png", by_count, "candidates reranked")
        first = results[0]
        plot_embeddings(folder / "embeddings.png", first.descriptors, first.world_T_body, first.pass_index, first.name)
        pairs = [result.examples[len(result.examples) // 2] for result in results if result.examples]
        _draw_attention(folder, self._weights, self._embedder, pairs)


def _draw_attention(folder: Path, weights: Path, embedder: Embedder, pairs: list[tuple[Frame, Frame]]) -> None:
    network = load_weights(weights)
    seen = [(look(network, embedder, query), look(network, embedder, match)) for query, match in pairs]
    plot_superfeatures(folder / "superfeatures.png", seen, network.config.image_size)
    plot_keypoints(folder / "keypoints.png", [query for query, _ in seen])
