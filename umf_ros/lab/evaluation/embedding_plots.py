"""Descriptors in the plane: PCA and t-SNE (thesis figures 5.10 and 5.11)."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.distance import cdist

from umf_ros.geometry import Array
from umf_ros.lab.evaluation.retrieval import Indices

MOST = 600
"""Points beyond which t-SNE, here quadratic, would take long."""


def pca(values: Array, axes: int = 2) -> Array:
    """(N, axes) coordinates of (N, D) values along their directions of largest variance."""
    centred = values - values.mean(axis=0)
    u, spread, _ = np.linalg.svd(centred, full_matrices=False)
    return u[:, :axes] * spread[:axes]


def tsne(values: Array, perplexity: float = 20.0, steps: int = 400, seed: int = 0) -> Array:
    """(N, 2) t-SNE of (N, D) values (van der Maaten and Hinton 2008), the exact algorithm.

    Args:
        values: one row per sample.
        perplexity: how many neighbours count, roughly; at most a third of the samples.
        steps: of gradient descent, the first quarter with exaggerated attraction.
        seed: of the jitter that breaks ties in the start, which is the PCA.
    """
    count = len(values)
    wanted = _affinities(values, min(perplexity, max((count - 1) / 3, 1.0)))
    start = pca(values)
    rng = np.random.default_rng(seed)
    place = start / max(start.std(), 1e-12) * 1e-2 + 1e-4 * rng.standard_normal((count, 2))
    velocity, gain = np.zeros_like(place), np.ones_like(place)
    for step in range(steps):
        exaggeration = 8.0 if step < steps // 4 else 1.0
        gradient = _gradient(place, exaggeration * wanted)
        gain = np.maximum(np.where(gradient * velocity < 0, gain + 0.2, gain * 0.8), 0.01)
        momentum = 0.5 if step < steps // 4 else 0.8
        velocity = momentum * velocity - max(count / 8.0, 50.0) * gain * gradient
        place = place + velocity
        place -= place.mean(axis=0)
    return place


def _affinities(values: Array, perplexity: float) -> Array:
    """(N, N) symmetric chances of picking each other as neighbours."""
    squared = cdist(values, values, "sqeuclidean")
    np.fill_diagonal(squared, np.inf)
    low, high = np.full(len(values), 1e-9), np.full(len(values), 1e9)
    for _ in range(60):  # bisection, all samples at once, in the logarithm of the precision
        beta = np.sqrt(low * high)[:, None]
        weights = np.exp(-(squared - squared.min(axis=1, keepdims=True)) * beta)
        chance = weights / weights.sum(axis=1, keepdims=True)
        entropy = -(chance * np.log(np.maximum(chance, 1e-300))).sum(axis=1)
        wide = entropy > np.log(perplexity)
        low, high = np.where(wide, beta[:, 0], low), np.where(wide, high, beta[:, 0])
    return (chance + chance.T) / (2 * len(values))


def _gradient(place: Array, wanted: Array) -> Array:
    closeness = 1 / (1 + cdist(place, place, "sqeuclidean"))
    np.fill_diagonal(closeness, 0)
    pull = (wanted - closeness / closeness.sum()) * closeness
    return 4 * (pull.sum(axis=1, keepdims=True) * place - pull @ place)


def plot_embeddings(path: Path, descriptors: Array, world_T_body: Array, pass_index: Indices, title: str) -> None:
    """Draw where samples were taken and where their descriptors lie; equal colours are equal places.

    Args:
        path: PNG to write.
        descriptors: (N, D).
        world_T_body: (N, 4, 4).
        pass_index: (N,) shown as the shape of the marker: dots for the first, crosses for the others.
        title: of the picture.
    """
    rows = np.linspace(0, len(descriptors) - 1, min(len(descriptors), MOST)).astype(int)
    descriptors, positions, later = descriptors[rows], world_T_body[rows, :2, 3], pass_index[rows] > 0
    middle = positions.mean(axis=0)
    # a trail is closed: its places are told apart by their direction from its middle
    hue = np.arctan2(*(positions - middle).T[::-1])
    figure, panels = plt.subplots(1, 3, figsize=(14, 4.8), layout="constrained")
    for panel, (name, points) in zip(
        panels,
        {"places [m]": positions, "PCA": pca(descriptors), "t-SNE": tsne(descriptors)}.items(),
        strict=True,
    ):
        for chosen, marker, size, label in ((~later, "o", 14, "first pass"), (later, "x", 20, "later passes")):
            colours = {"c": hue[chosen], "cmap": "hsv", "vmin": -np.pi, "vmax": np.pi}
            panel.scatter(*points[chosen].T, marker=marker, s=size, linewidths=0.9, label=label, **colours)
        panel.set_title(name)
        panel.set_aspect("equal", adjustable="datalim")
    panels[0].legend(fontsize=9)
    figure.suptitle(title)
    figure.savefig(path, dpi=110)
    plt.close(figure)
