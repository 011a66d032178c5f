"""Every other method as an embedder: a place looks like itself, what is missing is missing, and a recording runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import CAMERA
from recordings import small_settings, traverse, write_mcap
from tiny_worlds import some_scan

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import open_bag
from umf_ros.baselines.dbow2 import OrbFeatures
from umf_ros.baselines.place_networks import NETWORKS
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import make_pose
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.embedding import make_embedder
from umf_ros.lab.fit.vocabulary import grow
from umf_ros.lab.training.baseline_objectives import DescriptorObjective
from umf_ros.lab.training.networks import DescriptorSettings, save_tensors
from umf_ros.replay import Replay

SEEN = ("dbow2", "netvlad", "minkloc_visual", "lite0_gem")
FELT = ("pointnet2", "minkloc_lidar", "solid")
BOTH = ("minkloc_fusion", "adafusion")


def scene(seed: int, noise: int = 0) -> np.ndarray:
    rough = np.random.default_rng(seed).standard_normal((192, 256)).astype(np.float32)
    smooth = sum(cv2.GaussianBlur(rough, (0, 0), sigma) * sigma for sigma in (1.5, 6))
    grain = np.random.default_rng(100 + noise).normal(0, 4, smooth.shape)
    return np.clip(128 + 60 * smooth + grain, 0, 255).astype(np.uint8)


def frame(seed: int, noise: int = 0, **changes: object) -> Frame:
    points = some_scan(seed) + np.random.default_rng(noise).normal(0, 0.02, (2000, 3)).astype(np.float32)
    values = {"left": scene(seed, noise), "points": points, "intensity": np.full(2000, 80, np.float32)}
    return Frame(seed, CAMERA, np.eye(4), np.eye(4), **(values | changes))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of all methods: fresh networks on the shipped trunk, and a small vocabulary."""
    folder = tmp_path_factory.mktemp("weights")
    for method in NETWORKS:
        torch.manual_seed(0)
        settings = DescriptorSettings(method=method, train="nowhere")
        network = DescriptorObjective.make_network(settings)
        save_tensors(network, folder / f"{method}.safetensors", {}, {"method": method}, "half")
    words = grow([OrbFeatures().of(scene(seed)) for seed in range(6)], 8, 3, np.random.default_rng(0))
    words.save(folder / "dbow2.safetensors")
    return folder


def settings_of(method: str, weights: Path) -> EmbeddingSettings:
    path = weights / f"{method}.safetensors"
    return EmbeddingSettings(method=method, weights=str(path) if path.is_file() else "", threads=1)


@pytest.mark.parametrize("method", [*SEEN, *FELT, *BOTH])
def test_a_place_looks_like_itself(method: str, weights: Path) -> None:
    embedder = make_embedder(settings_of(method, weights))
    first = np.stack([embedder.embed(frame(seed)).descriptor for seed in range(5)])
    again = np.stack([embedder.embed(frame(seed, noise=1)).descriptor for seed in range(5)])
    assert first.shape == (5, embedder.dimension) and first.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1, atol=1e-5)
    assert ((again @ first.T).argmax(axis=1) == np.arange(5)).mean() >= 0.8
    np.testing.assert_array_equal(embedder.embed(frame(0)).descriptor, first[0])


@pytest.mark.parametrize("method", [*SEEN, *FELT, *BOTH])
def test_what_a_method_does_not_read_does_not_matter(method: str, weights: Path) -> None:
    embedder = make_embedder(settings_of(method, weights))
    whole = embedder.embed(frame(0)).descriptor
    dark = embedder.embed(frame(0, left=None)).descriptor
    blind = embedder.embed(frame(0, points=None, intensity=None)).descriptor
    if method in SEEN:
        np.testing.assert_array_equal(whole, blind)
    if method in FELT:
        np.testing.assert_array_equal(whole, dark)
    if method in BOTH:
        assert 0 < whole @ dark < 1 and 0 < whole @ blind < 1
    nothing = embedder.embed(frame(0, left=None, points=None, intensity=None)).descriptor
    assert np.linalg.norm(nothing) == pytest.approx(1, abs=1e-5)


def test_solid_turns_with_the_rover_and_not_with_its_mounting() -> None:
    embedder = make_embedder(EmbeddingSettings(method="solid"))
    here = frame(3)
    assert here.points is not None
    turn = np.array([[0.9553, -0.2955, 0], [0.2955, 0.9553, 0], [0, 0, 1]])
    turned = replace(here, points=(here.points @ turn.T).astype(np.float32))
    assert embedder.embed(here).descriptor @ embedder.embed(turned).descriptor > 0.999
    raised = make_pose(np.eye(3), [0, 0, 2.0])
    moved = replace(here, points=(here.points + np.array([0, 0, 2.0])).astype(np.float32), body_T_lidar=raised)
    np.testing.assert_allclose(embedder.embed(moved).descriptor, embedder.embed(here).descriptor, atol=0.02)


@pytest.mark.parametrize("method", ["dbow2", "netvlad"])
def test_weights_that_are_not_there_are_one_clear_line(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("umf_ros.baselines.place_networks.find", _nothing)
    with pytest.raises(ConfigError, match=f"umf train --method {method}"):
        make_embedder(EmbeddingSettings(method=method))


def _nothing(name: str) -> Path:
    from umf_ros.core.errors import UmfError

    raise UmfError(f"{name} is not installed")


@pytest.mark.parametrize("method", [*SEEN, *FELT, *BOTH])
def test_one_parameter_drives_a_recording(method: str, weights: Path, tmp_path: Path) -> None:
    """Replay and the live node make their embedder by the same function: here on a short bag."""
    bag = open_bag(write_mcap(tmp_path / "a.mcap", traverse(2.0)))
    policy = {"keyframe__min_translation_m": 0.2, "keyframe__min_period_s": 0.0}
    settings = small_settings(tmp_path, **policy).model_copy(update={"embedding": settings_of(method, weights)})
    (tmp_path / "run").mkdir()
    detector = LoopDetector(settings, make_detector_embedder(settings))
    replay = Replay(tmp_path / "run", settings, detector)
    detections = list(replay.run(FrameReader(bag, settings).stream()))
    assert replay.finish({"image": 0}) is True
    keyframes = [one.keyframe for one in detections if one.keyframe is not None]
    assert len(keyframes) > 2
    assert keyframes[0].embedding.descriptor.shape == (make_embedder(settings.embedding).dimension,)
