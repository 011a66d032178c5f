"""Pictures of the network's output: descriptors in the plane, attention and key-points [UMF figures 5.5 to 5.11]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from sklearn.decomposition import PCA
from sklearn.manifold import TSNE
from torch import Tensor

from umf_ros.core.frames import Embedding, Frame, Image, Points
from umf_ros.core.geometry import Array, transform
from umf_ros.core.levelling import level
from umf_ros.embedding import Embedder
from umf_ros.embedding.inputs import prepare_scan
from umf_ros.lab.datasets.views import read_frame
from umf_ros.lab.evaluation.retrieval import Indices
from umf_ros.networks.fusion import received
from umf_ros.networks.umf import UMF, NetworkOutput
from umf_ros.verification.rerank import eligible_superfeatures

SHOWN = 3
"""Super-features drawn per pair."""

PERPLEXITY = 20.0
"""How many neighbours count in t-SNE, roughly."""


@dataclass(frozen=True, slots=True)
class Seen:
    """A frame and what the network attended to in it.

    Attributes:
        frame: the frame.
        embedding: its local and super-features.
        output: of the network.
        looked: (1, T) how much the scan's tokens looked at each token of the image, in the last layer of fusion.
        centroids: (V, 3) places of the voxels, body frame, m.
    """

    frame: Frame
    embedding: Embedding
    output: NetworkOutput
    looked: Tensor
    centroids: Points


def look(network: UMF, embedder: Embedder, frame: Frame) -> Seen:
    """Run the network once more, for its attention maps.

    Args:
        network: in eager torch.
        embedder: the same network as it is used, with super-features.
        frame: with an image and a scan.
    """
    points = None if frame.points is None else transform(level(frame.points, keep_slope=True), frame.points)
    scan = prepare_scan(points, frame.intensity, network.config)
    batch = read_frame(frame, network.config).tensors()
    maps: list[Tensor] = []
    last = network.get_submodule(f"fusion.layers.{network.config.layers - 1}.cloud_cross")
    hook = last.register_forward_hook(lambda module, tokens, found: maps.append(found[1]))
    with torch.inference_mode():
        output = network(batch, super_features=True)
    hook.remove()
    return Seen(frame, embedder.embed(frame), output, received(maps[0]), scan.centroids)


def plot_superfeatures(path: Path, pairs: Sequence[tuple[Seen, Seen]], size: tuple[int, int]) -> None:
    """Draw the attention of the super-features that a query and its match share (figures 5.5 to 5.7).

    Args:
        path: PNG to write.
        pairs: query and match.
        size: (H, W) of the network's image.
    """
    figure, panels = plt.subplots(2 * len(pairs), 2 * SHOWN, figsize=(15, 4.6 * len(pairs)), squeeze=False)
    for number, (query, match) in enumerate(pairs):
        image_ids, cloud_ids = _shared(query, match, "super_image"), _shared(query, match, "super_cloud")
        for row, (seen, name) in enumerate(((query, "query"), (match, "match"))):
            line = panels[2 * number + row]
            for column in range(SHOWN):
                _draw_image(line[column], seen, image_ids[column], size, name)
                _draw_voxels(line[SHOWN + column], seen, cloud_ids[column], name)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def plot_keypoints(path: Path, seen: Sequence[Seen]) -> None:
    """Draw key-points and fusion attention of some frames (figure 5.8)."""
    figure, panels = plt.subplots(len(seen), 3, figsize=(14, 4.2 * len(seen)), squeeze=False)
    for line, each in zip(panels, seen, strict=True):
        _draw_keypoints(line[0], each)
        _draw_cloud_keypoints(line[1], each)
        _draw_fusion(line[2], each)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def plot_embeddings(path: Path, descriptors: Array, world_T_body: Array, pass_index: Indices, title: str) -> None:
    """Draw where samples were taken and where their descriptors lie; equal colours are equal places.

    Args:
        path: PNG to write.
        descriptors: (N, D).
        world_T_body: (N, 4, 4).
        pass_index: (N,) shown as the shape of the marker: dots for the first, crosses for the others.
        title: of the picture.
    """
    positions, later = world_T_body[:, :2, 3], pass_index > 0
    middle = positions.mean(axis=0)
    # a trail is closed: its places are told apart by their direction from its middle
    hue = np.arctan2(*(positions - middle).T[::-1])
    figure, panels = plt.subplots(1, 3, figsize=(14, 4.8), layout="constrained")
    maps = {"places [m]": positions, "PCA": PCA(2).fit_transform(descriptors), "t-SNE": tsne(descriptors)}
    for panel, (name, points) in zip(panels, maps.items(), strict=True):
        for chosen, marker, size, label in ((~later, "o", 14, "first pass"), (later, "x", 20, "later passes")):
            colours = {"c": hue[chosen], "cmap": "hsv", "vmin": -np.pi, "vmax": np.pi}
            panel.scatter(*points[chosen].T, marker=marker, s=size, linewidths=0.9, label=label, **colours)
        panel.set_title(name)
        panel.set_aspect("equal", adjustable="datalim")
    panels[0].legend(fontsize=9)
    figure.suptitle(title)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def tsne(descriptors: Array) -> Array:
    """(N, 2) t-SNE of (N, D) descriptors, repeatable; a third of a few samples are neighbours at most."""
    perplexity = min(PERPLEXITY, max((len(descriptors) - 1) / 3, 1.0))
    return TSNE(perplexity=perplexity, init="pca", random_state=0).fit_transform(descriptors)


def _shared(query: Seen, match: Seen, name: str) -> list[int]:
    """IDs of the super-features to draw: eligible pairs first, then the strongest of the query."""
    ours, theirs = getattr(query.embedding, name), getattr(match.embedding, name)
    if ours is None or theirs is None:
        return list(range(SHOWN))
    eligible = eligible_superfeatures(ours, theirs)
    order = [*eligible[np.argsort(-ours.strength[eligible])], *np.argsort(-ours.strength)]
    return list(dict.fromkeys(map(int, order)))[:SHOWN]


def _draw_image(axes: Axes, seen: Seen, number: int, size: tuple[int, int], name: str) -> None:
    found = seen.output.super_image
    if found is not None and seen.frame.left is not None:
        rows, columns = size[0] // 4, size[1] // 4
        _overlay(axes, seen.frame.left, found.attention[0, number].view(rows, columns).float().numpy())
    axes.set_title(f"{name}, image {number}", fontsize=9)
    axes.axis("off")


def _draw_voxels(axes: Axes, seen: Seen, number: int, name: str) -> None:
    found = seen.output.super_cloud
    if found is not None:
        _from_above(axes, seen.centroids, found.attention[0, number].float().numpy(), found.attention[0, number] > 0)
    axes.set_title(f"{name}, scan {number}", fontsize=9)


def _draw_keypoints(axes: Axes, seen: Seen) -> None:
    image, features = seen.frame.left, seen.embedding.image
    if image is not None:
        axes.imshow(image, cmap="gray", aspect="auto")
    if features is not None:
        axes.scatter(features.positions[:, 0], features.positions[:, 1], c=features.saliency, cmap="plasma", s=9)
        axes.set_title(f"{len(features.positions)} image key-points", fontsize=9)
    axes.axis("off")


def _draw_cloud_keypoints(axes: Axes, seen: Seen) -> None:
    if seen.frame.points is not None:
        axes.scatter(-seen.frame.points[::4, 1], seen.frame.points[::4, 0], c="#bbbbbb", s=0.3)
    features = seen.embedding.cloud
    if features is not None:
        axes.scatter(-features.positions[:, 1], features.positions[:, 0], c=features.saliency, cmap="plasma", s=9)
        axes.set_title(f"{len(features.positions)} scan key-points, from above", fontsize=9)
    _box(axes)


def _draw_fusion(axes: Axes, seen: Seen) -> None:
    """Where the scan's tokens look in the image."""
    looked = seen.looked[0]
    if seen.frame.left is not None and len(looked) > 1:
        height, width = seen.frame.left.shape
        _overlay(axes, seen.frame.left, _grid(looked, width / height))
        axes.set_title("attention of the scan to the image", fontsize=9)
    axes.axis("off")


def _grid(values: Tensor, aspect: float) -> Array:
    """Tokens back in their rows and columns."""
    count = len(values)
    rows = min((r for r in range(1, count + 1) if count % r == 0), key=lambda r: abs(np.log(count / r / r / aspect)))
    return values.view(rows, -1).float().numpy()


def _overlay(axes: Axes, image: Image, heat: Array) -> None:
    large = cv2.resize(heat, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_CUBIC)
    axes.imshow(image, cmap="gray", aspect="auto")
    axes.imshow(np.clip(large / max(float(large.max()), 1e-12), 0, 1), cmap="inferno", alpha=0.55, aspect="auto")


def _from_above(axes: Axes, points: Points, heat: Array, chosen: Tensor) -> None:
    kept = chosen.numpy()
    heat = heat[kept] / max(float(heat.max()), 1e-12)
    axes.scatter(-points[kept, 1], points[kept, 0], c=heat, cmap="inferno", s=12, vmin=0, vmax=1)
    _box(axes)


def _box(axes: Axes) -> None:
    axes.set_xlim(-20, 20)
    axes.set_ylim(0, 40)
    axes.set_aspect("equal")
    axes.set_facecolor("#dddddd")
    axes.tick_params(labelsize=7)
