"""XFeat's features of images: where they lie, and what names them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import CAMERA

from umf_ros.baselines.handcrafted import ThumbnailEmbedder
from umf_ros.core.config import EmbeddingSettings, Settings, Verification
from umf_ros.core.frames import Frame, Image, LocalFeatures
from umf_ros.detector import make_detector_embedder
from umf_ros.embedding import make_embedder
from umf_ros.embedding.local_features import LIMIT, WithXFeat, key_points, network_size, sample
from umf_ros.verification.rerank import mutual_neighbours, similarities


def scene(seed: int = 0) -> Image:
    """Ground with structure of many sizes."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.standard_normal((512, 688)), (0, 0), size) * size for size in (1.5, 3, 6, 12, 24)]
    rough = np.sum(layers, axis=0)
    return np.clip(120 + 45 * rough / rough.std(), 0, 255).astype(np.uint8)


def frame(image: Image | None) -> Frame:
    return Frame(1, CAMERA, np.eye(4), np.eye(4), left=image)


@pytest.fixture(scope="module")
def embedder() -> WithXFeat:
    return WithXFeat(ThumbnailEmbedder(), EmbeddingSettings(threads=1))


def features(embedder: WithXFeat, image: Image) -> LocalFeatures:
    found = embedder.embed(frame(image)).image
    assert found is not None
    return found


def test_what_comes_out(embedder: WithXFeat) -> None:
    found = features(embedder, scene())
    assert 200 < len(found.positions) <= LIMIT
    assert (found.positions >= 0).all() and (found.positions < [688, 512]).all()
    assert found.descriptors.shape[1] == 64 and found.descriptors.dtype == np.float16
    np.testing.assert_allclose(np.linalg.norm(found.descriptors.astype(float), axis=1), 1, atol=2e-3)
    assert (np.diff(found.saliency) <= 0).all() and np.isnan(found.points).all()


@pytest.mark.parametrize("shift", [(6.0, 0.0), (3.4, -2.7)])
def test_a_moved_picture_moves_its_features_by_as_much(embedder: WithXFeat, shift: tuple[float, float]) -> None:
    image = scene()
    across, down = shift
    moved = cv2.warpAffine(image, np.float32([[1, 0, across], [0, 1, down]]), (688, 512), borderMode=cv2.BORDER_REFLECT)
    here, there = features(embedder, image), features(embedder, moved)
    pairs = mutual_neighbours(similarities(here.descriptors, there.descriptors))
    found = there.positions[pairs[:, 1]] - here.positions[pairs[:, 0]]
    away = np.linalg.norm(found - shift, axis=1)
    assert len(pairs) > 150 and (away < 3).mean() > 0.5
    assert np.median(away[away < 3]) < 0.7  # a pixel of the network's image is 1.34 of these


def test_runtimes_agree(embedder: WithXFeat) -> None:
    other = WithXFeat(ThumbnailEmbedder(), EmbeddingSettings(runtime="torch"))
    one, two = features(embedder, scene()), features(other, scene())
    pairs = mutual_neighbours(similarities(one.descriptors, two.descriptors))
    apart = np.linalg.norm(one.positions[pairs[:, 0]] - two.positions[pairs[:, 1]], axis=1)
    # eight bits of one against single precision of the other
    assert len(pairs) > 0.8 * len(one.positions) and np.median(apart) < 0.1 and np.quantile(apart, 0.8) < 0.7


def test_pictures_of_any_size_are_seen_whole(embedder: WithXFeat) -> None:
    assert network_size(688, 512) == (512, 384)
    assert network_size(1242, 375) == (512, 160)
    assert network_size(160, 120) == (160, 128)
    found = features(embedder, cv2.resize(scene(), (1242, 375)))
    assert found.positions[:, 0].max() > 1100 and found.positions[:, 1].max() > 330


def test_without_a_picture_there_are_no_features(embedder: WithXFeat) -> None:
    assert embedder.embed(frame(None)).image is None
    assert embedder.embed(frame(np.zeros((512, 688), np.uint8))).image is None


def test_key_points_lie_between_the_pixels() -> None:
    rows, columns = np.mgrid[:64, :64]
    corners = 0.6 * np.exp(-((columns - 20.3) ** 2 + (rows - 30.8) ** 2) / 4).astype(np.float32)
    places, score = key_points(corners, np.full((8, 8), 0.5, np.float32))
    np.testing.assert_allclose(places, [[20.3, 30.8]], atol=0.05)
    assert score == pytest.approx([0.5 * corners[31, 20]], rel=1e-4)


def test_samples_are_bilinear_and_held_at_the_edge() -> None:
    maps = np.arange(12.0, dtype=np.float32).reshape(1, 3, 4)
    np.testing.assert_allclose(sample(maps, np.array([[1.5, 0.5], [-2, 0], [9, 9]])).ravel(), [3.5, 0, 11])


def test_the_name_tells_features_apart() -> None:
    plain = EmbeddingSettings(method="thumbnail", threads=1)
    assert make_embedder(plain).name == "thumbnail"
    chosen = make_detector_embedder(Settings(embedding=plain))
    assert chosen.name.startswith("thumbnail+xfeat-") and chosen.dimension == make_embedder(plain).dimension
    own = Settings(embedding=plain, verification=Verification(features="umf"))
    assert make_detector_embedder(own).name == "thumbnail"
