"""Fit the weight of the similarity by words to simulated worlds and to sets of real images.

python -m umf_ros.lab.fit.words PLACES.yaml

A query's best candidates by the network are compared with each other, as in `umf_ros.lab.fit.reranking`, whose slope of
the network's similarity is kept: the weight is that under which the right ones are likeliest. It is fitted to images
alone (`umf_ros.core.frames.WORDS_WEIGHT`); that of images with scans is printed beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from scipy.optimize import minimize_scalar

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import Array
from umf_ros.embedding import FeatureRequest
from umf_ros.embedding.umf import UmfEmbedder
from umf_ros.lab.evaluation.places import PlaceSet, read_place_sets, read_set
from umf_ros.lab.evaluation.retrieval import MODES, TOP_K, Mask, RetrievalTask, as_keyframe, word_similarity
from umf_ros.lab.fit.reranking import Examples, near_places, read_world, recall1, surprise
from umf_ros.verification.rerank import likelihoods

SEEDS = range(10000, 10012)
WEIGHTS = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0])
Weighed = tuple[Examples, Array]
"""Candidates (Q, K) by the network, and their similarity by words."""


def examples_of(
    embedder: UmfEmbedder, name: str, frames: Sequence[Frame], task: RetrievalTask, near: Mask, mode: str
) -> Weighed:
    """Return the candidates of frames in one of the `MODES`.

    Args:
        embedder: with local vectors of images.
        name: of the world or set; a world's begins with "world".
        frames: queries and references.
        task: which of them are asked for which.
        near: (Q, R) pairs that are neither right nor wrong.
        mode: what the frames show.
    """
    keyframes = [as_keyframe(frame, embedder.embed(MODES[mode](frame))) for frame in frames]
    ours, theirs = ([keyframes[row] for row in rows] for rows in (task.queries, task.references))
    queries, references = (np.stack([one.embedding.descriptor for one in each]) for each in (ours, theirs))
    similarity = queries @ references.T
    best = np.argsort(-similarity, axis=1, kind="stable")[:, :TOP_K]
    right, close, chosen, words = (
        np.take_along_axis(one, best, axis=1)
        for one in (task.positive, near, similarity, word_similarity(ours, theirs))
    )
    return Examples(name, name.startswith("world"), chosen, right, ~right & ~close, {}), words


def fit_weight(found: Sequence[Weighed]) -> float:
    """Return the weight under which the right candidates are likeliest."""
    slope, examples = likelihoods()["similarity"]["slope"], [one for one, _ in found]

    def loss(weight: float) -> float:
        return surprise(examples, [slope * (one.similarity + weight * words) for one, words in found])

    return float(minimize_scalar(loss, bounds=(-1.0, 2.0), method="bounded").x)


def _sets(places: Sequence[PlaceSet]) -> list[tuple[str, list[Frame], RetrievalTask, Mask]]:
    found = []
    for item in track([*SEEDS, *places], "reading", transient=True):
        if isinstance(item, int):
            found.append((f"world {item}", *read_world(item)))
        elif item.kind == "image":
            frames, task = read_set(item)
            found.append((item.name, frames, task, near_places(task)))
    return found


def main(listing: Annotated[Path, typer.Argument(help="development sets of images")]) -> None:
    """Print the weight of images alone and of images with scans, and the recall of others."""
    console, embedder = Console(), UmfEmbedder(EmbeddingSettings(), FeatureRequest(image=False))
    sets = _sets(read_place_sets(listing))
    for mode in ("image", "fused"):
        found = [examples_of(embedder, *one, mode) for one in sets if mode == "image" or one[0].startswith("world")]
        console.print(f"{mode}: weight {fit_weight(found):.2f}")
        for one, words in found:
            recalls = [recall1(one, one.similarity + weight * words) for weight in WEIGHTS]
            console.print(one.name, dict(zip(WEIGHTS.tolist(), np.round(recalls, 3).tolist(), strict=True)))


if __name__ == "__main__":
    typer.run(main)
