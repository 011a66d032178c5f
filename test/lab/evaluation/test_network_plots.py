from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from tiny_worlds import TINY

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Frame
from umf_ros.embedding import FeatureRequest
from umf_ros.embedding.umf import UmfEmbedder
from umf_ros.lab.evaluation.network_plots import look, plot_embeddings, plot_keypoints, plot_superfeatures, tsne
from umf_ros.lab.training.networks import save_weights
from umf_ros.networks.umf import UMF
from umf_ros.networks.weights import load_weights


def is_picture(path: Path) -> bool:
    picture = cv2.imread(str(path))
    return picture is not None and min(picture.shape[:2]) > 200 and picture.std() > 5


def clusters(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    label = np.repeat([0, 1, 2], 20)
    centres = 10 * rng.standard_normal((3, 16))
    return centres[label] + rng.standard_normal((60, 16)), label


def test_tsne_keeps_neighbours_together(rng: np.random.Generator) -> None:
    values, label = clusters(rng)
    place = tsne(values)
    distance = cdist(place, place) + 1e9 * np.eye(60)
    assert (label[distance.argmin(axis=1)] == label).mean() == 1.0
    inside = cdist(place[:20], place[:20]).max()
    assert inside < 0.6 * cdist(place[:20], place[20:]).mean()
    assert np.array_equal(place, tsne(values))


@pytest.mark.parametrize("count", [2, 3, 5])
def test_tsne_of_a_few(count: int, rng: np.random.Generator) -> None:
    assert np.isfinite(tsne(rng.standard_normal((count, 4)))).all()


def test_descriptors_are_drawn(tmp_path: Path, rng: np.random.Generator) -> None:
    values, label = clusters(rng)
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, :2, 3] = rng.standard_normal((60, 2)) * 30
    plot_embeddings(tmp_path / "a.png", values, poses, label, "a world")
    assert is_picture(tmp_path / "a.png")


def test_attention_and_key_points_are_drawn(tmp_path: Path, rng: np.random.Generator) -> None:
    weights = tmp_path / "tiny.safetensors"
    save_weights(UMF(TINY).eval(), weights, {})
    embedder, network = (
        UmfEmbedder(EmbeddingSettings(weights=str(weights), runtime="torch"), FeatureRequest(supers=True)),
        load_weights(weights),
    )
    from conftest import CAMERA

    def frame(image: np.ndarray | None, count: int) -> Frame:
        points = rng.uniform((1, -15, -2), (35, 15, 2), (count, 3)).astype(np.float32)
        return Frame(0, CAMERA, np.eye(4), np.eye(4), left=image, points=points, intensity=np.ones(count, np.float32))

    whole = look(network, embedder, frame(rng.integers(0, 255, (60, 80), np.uint8), 2000))
    dark = look(network, embedder, frame(np.zeros((60, 80), np.uint8), 2000))
    tokens = TINY.image_size[0] // 16 * (TINY.image_size[1] // 16)
    torch.testing.assert_close(whole.looked.sum(), torch.tensor(float(tokens)))  # one is the fair share
    plot_superfeatures(tmp_path / "super.png", [(whole, whole), (whole, dark)], TINY.image_size)
    plot_keypoints(tmp_path / "points.png", [whole, dark])
    assert is_picture(tmp_path / "super.png") and is_picture(tmp_path / "points.png")
