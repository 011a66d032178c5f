from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import CAMERA
from published import published_tensors
from scipy.spatial.transform import Rotation
from tiny_worlds import TINY, some_scan

from umf_ros import embedding
from umf_ros.baselines.handcrafted import GradientsEmbedder, ScanContextEmbedder, ThumbnailEmbedder
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError, WeightsError, either
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import transform
from umf_ros.embedding import FeatureRequest, make_embedder
from umf_ros.embedding.umf import UmfEmbedder
from umf_ros.lab.training.networks import save_weights
from umf_ros.networks.umf import UMF


def some_frame(seed: int = 0, **changes: object) -> Frame:
    rng = np.random.default_rng(seed)
    image = np.kron(rng.integers(0, 255, (32, 43)), np.ones((16, 16))).astype(np.uint8)
    values = {"left": image, "points": some_scan(seed), "intensity": rng.uniform(20, 500, 2000).astype(np.float32)}
    return Frame(stamp_ns=seed, camera=CAMERA, body_T_camera=np.eye(4), body_T_lidar=np.eye(4), **(values | changes))


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_weights(UMF(TINY), path, {})
    return path


@pytest.fixture
def embedder(weights):
    return UmfEmbedder(EmbeddingSettings(weights=str(weights), runtime="torch", threads=1), FeatureRequest(supers=True))


def test_what_comes_out(embedder):
    found = embedder.embed(some_frame())
    assert found.descriptor.shape == (embedder.dimension,)
    assert found.descriptor.dtype == np.float32
    assert np.linalg.norm(found.descriptor) == pytest.approx(1, abs=1e-5)
    assert 0 < len(found.image.positions) <= 400
    assert found.image.positions.min() >= 0
    assert (found.image.positions.max(0) < (688, 512)).all()
    assert np.isnan(found.image.points).all()
    assert found.image.descriptors.dtype == np.float16
    np.testing.assert_array_equal(found.cloud.positions, found.cloud.points)
    assert (np.diff(found.image.saliency) <= 0).all()
    assert (np.diff(found.cloud.saliency) <= 0).all()
    assert found.super_image.descriptors.shape == TINY.image_supers
    assert found.super_cloud.strength.shape == (TINY.cloud_supers[0],)


def test_cloud_features_lie_on_the_scan(embedder):
    frame = some_frame()
    positions = embedder.embed(frame).cloud.positions
    nearest = np.linalg.norm(positions[:, None] - frame.points[None], axis=-1).min(1)
    assert nearest.max() < 0.8


def test_the_same_frame_gives_the_same_embedding(embedder):
    one, two = embedder.embed(some_frame()), embedder.embed(some_frame())
    np.testing.assert_array_equal(one.descriptor, two.descriptor)
    np.testing.assert_array_equal(one.cloud.descriptors, two.cloud.descriptors)


def test_either_modality_may_be_missing(embedder):
    whole, dark = embedder.embed(some_frame()), embedder.embed(some_frame(left=None))
    blind = embedder.embed(some_frame(points=None, intensity=None))
    assert dark.image is dark.super_image is blind.cloud is blind.super_cloud is blind.scene is None
    assert dark.scene is not None and dark.scene.shape[1] == TINY.tokens  # of the scan
    for found in (dark, blind):
        assert np.linalg.norm(found.descriptor) == pytest.approx(1, abs=1e-5)
        assert 0 < found.descriptor @ whole.descriptor < 1
    black = embedder.embed(some_frame(left=np.zeros((512, 688), np.uint8)))
    np.testing.assert_array_equal(black.descriptor, dark.descriptor)
    empty = embedder.embed(some_frame(points=np.empty((0, 3), np.float32), intensity=np.empty(0, np.float32)))
    np.testing.assert_array_equal(empty.descriptor, blind.descriptor)


@pytest.mark.parametrize("shape", [(512, 688), (480, 640), (64, 96), (37, 53)])
def test_positions_belong_to_the_image_given(embedder, shape):
    image = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    positions = embedder.embed(some_frame(left=image)).image.positions
    assert (positions.max(0) < (shape[1], shape[0])).all()
    assert positions[:, 0].max() > shape[1] / 2


def test_the_shipped_model_agrees_with_its_weights():
    """Eight bits change a descriptor by less than views of neighbouring places differ."""
    plain = UmfEmbedder(EmbeddingSettings(runtime="torch", threads=1), FeatureRequest(supers=True))
    fast = UmfEmbedder(EmbeddingSettings(runtime="openvino", threads=1), FeatureRequest(supers=True))
    assert plain.name.startswith("umf_scene-") and fast.name.startswith("umf_scene-int8-")
    for frame in (some_frame(), some_frame(1, left=None), some_frame(2, points=None, intensity=None)):
        wanted, found = plain.embed(frame), fast.embed(frame)
        assert 0.98 < wanted.descriptor @ found.descriptor < 0.99999
        if wanted.cloud is not None:
            assert abs(len(wanted.cloud.positions) - len(found.cloud.positions)) < 0.1 * len(wanted.cloud.positions)


def test_what_is_not_asked_for_is_left_out_and_changes_nothing_else():
    whole, bare = (
        UmfEmbedder(EmbeddingSettings(runtime="openvino", threads=1), FeatureRequest(image)) for image in (True, False)
    )
    one, other = whole.embed(some_frame()), bare.embed(some_frame())
    assert one.image is not None and other.image is None and one.cloud is not None and other.cloud is not None
    np.testing.assert_array_equal(one.descriptor, other.descriptor)
    np.testing.assert_array_equal(one.cloud.positions, other.cloud.positions)
    np.testing.assert_array_equal(one.cloud.descriptors, other.cloud.descriptors)


def test_shipped_weights_load():
    """The default network reads its own weights and knows a frame from another."""
    embedder = make_embedder(EmbeddingSettings(runtime="torch", threads=1))
    one, two = embedder.embed(some_frame(0)), embedder.embed(some_frame(1))
    assert embedder.dimension == 768
    assert one.descriptor @ two.descriptor < 0.99


def test_missing_weights_are_one_clear_error(tmp_path):
    with pytest.raises(WeightsError, match="do not exist"):
        make_embedder(EmbeddingSettings(weights=str(tmp_path / "none.safetensors")))


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"method": "magic"}, "unknown method"),
        ({"runtime": "openvino", "device": "cuda"}, "openvino"),
        ({"device": "abacus"}, "device"),
    ],
)
def test_wrong_settings(weights, changes, word):
    with pytest.raises(ConfigError, match=word):
        make_embedder(EmbeddingSettings(weights=str(weights), **changes))


@pytest.mark.parametrize("embedder", [ThumbnailEmbedder(), ScanContextEmbedder()], ids=lambda found: found.name)
def test_baselines_know_a_place_again(embedder):
    here, again, elsewhere = some_frame(0), some_frame(0), some_frame(1)
    noisy = np.clip(again.left.astype(int) + 8, 0, 255).astype(np.uint8)
    again = replace(again, left=noisy, points=again.points[::2], intensity=None)
    codes = [embedder.embed(frame).descriptor for frame in (here, again, elsewhere)]
    assert codes[0] @ codes[1] > codes[0] @ codes[2] + 0.01
    nothing = embedder.embed(some_frame(left=None, points=None, intensity=None)).descriptor
    assert np.linalg.norm(nothing) == pytest.approx(1)
    assert embedder.embed(here).descriptor.shape == (embedder.dimension,)


def test_baselines_by_name():
    for name in ("thumbnail", "scan_context"):
        assert make_embedder(EmbeddingSettings(method=name)).name == name
    assert embedding.find_methods()[0] == "umf" and {"scan_context", "thumbnail"} < set(embedding.find_methods())


NEW = """
import numpy as np
from umf_ros.core.frames import Embedding

class Nowhere:
    name, dimension = "nowhere", 3

    def embed(self, frame):
        return Embedding(descriptor=np.eye(3, dtype=np.float32)[frame.stamp_ns])

def make(settings, asked):
    return Nowhere()
"""


def test_a_package_of_a_user_adds_a_method_by_an_entry_point(tmp_path):
    (tmp_path / "my_rover.py").write_text(NEW)
    about = tmp_path / "my_rover-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my_rover\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[umf_ros.embedders]\nnowhere = my_rover:make\nbroken = my_rover:missing\n")
    code = (
        "from umf_ros.core.config import EmbeddingSettings as S; from umf_ros.core.errors import ConfigError\n"
        "from umf_ros.embedding import find_methods, make_embedder\n"
        "from types import SimpleNamespace as Frame; made = make_embedder(S(method='nowhere'))\n"
        "print(find_methods()[0], 'nowhere' in find_methods(), *made.embed(Frame(stamp_ns=1)).descriptor)\n"
        "try:\n    make_embedder(S(method='broken'))\nexcept ConfigError as error:\n    print(error)"
    )
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{Path(embedding.__file__).parents[2]}"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    first, second = done.stdout.splitlines()
    assert first == "umf True 0.0 1.0 0.0"
    assert second.startswith("embedding.method broken: its entry point cannot be loaded:")


def test_an_unknown_method_is_one_line():
    with pytest.raises(ConfigError, match=f"unknown method 'magic'; known: {', '.join(embedding.find_methods())}"):
        make_embedder(EmbeddingSettings(method="magic"))


def test_every_command_names_the_methods():
    """And to list them loads none of them."""
    show = "from umf_ros.cli import main; import sys; sys.argv = ['umf', sys.argv[1], '--help']; main()"
    for command in ("replay", "explain", "evaluate"):
        said = subprocess.run([sys.executable, "-c", show, command], capture_output=True, text=True, check=True)
        assert f" {either(embedding.find_methods())}." in " ".join(said.stdout.replace("\u2502", " ").split())
    listed = "import sys, umf_ros.embedding; print([name for name in ('torch', 'cv2') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", listed], capture_output=True, text=True).stdout.strip() == "[]"


def test_the_name_tells_weights_apart(weights, tmp_path):
    other = tmp_path / weights.name
    torch.manual_seed(1)
    save_weights(UMF(TINY), other, {})
    names = [
        UmfEmbedder(EmbeddingSettings(weights=str(path), runtime="torch", threads=1)).name
        for path in (weights, other, weights)
    ]
    assert names[0] == names[2] != names[1]
    assert all(name.startswith("tiny-") for name in names)


@pytest.mark.parametrize(
    "left", [np.full((512, 688), 255, np.uint8), np.full((512, 688), 90, np.uint8)], ids=["dazzled", "covered"]
)
def test_an_image_that_shows_nothing_is_missing(embedder, left):
    found, wanted = embedder.embed(some_frame(left=left)), embedder.embed(some_frame(left=None))
    assert found.image is None and found.super_image is None
    np.testing.assert_array_equal(found.descriptor, wanted.descriptor)


def test_a_scan_of_a_few_points_is_missing(embedder):
    few = some_frame(points=some_scan(0)[:10], intensity=np.full(10, 50, np.float32))
    wanted = embedder.embed(some_frame(points=None, intensity=None))
    found = embedder.embed(few)
    assert found.cloud is None
    np.testing.assert_array_equal(found.descriptor, wanted.descriptor)


def test_points_that_are_no_numbers_are_ignored(embedder):
    frame = some_frame()
    dirty = np.concatenate([frame.points, np.full((30, 3), np.nan, np.float32)])
    intensity = np.concatenate([frame.intensity, np.zeros(30, np.float32)])
    found, wanted = embedder.embed(replace(frame, points=dirty, intensity=intensity)), embedder.embed(frame)
    np.testing.assert_allclose(found.descriptor, wanted.descriptor, atol=1e-6)


def test_a_scan_without_intensities_is_used(embedder):
    whole, plain = embedder.embed(some_frame()), embedder.embed(some_frame(intensity=None))
    assert plain.cloud is not None and len(plain.cloud.positions) == len(whole.cloud.positions)


def test_key_points_cover_the_whole_image(embedder):
    positions = embedder.embed(some_frame()).image.positions
    cells = set(map(tuple, (positions // (688 / 6, 512 / 4)).astype(int).tolist()))
    assert len(cells) == 24
    # the centres of the fine cells, in pixels of the full image: (cell + 1/2) cell widths, less half a pixel
    across = (positions[:, 0] + 0.5) / (688 / 24) - 0.5
    np.testing.assert_allclose(across, across.round(), atol=1e-3)


def test_scan_context_keeps_the_highest_return_of_every_cell():
    """A pillar raises its own cell; what is beyond the range or beside the view changes nothing."""
    ground = np.array([[r, r * np.tan(a), 0.0] for r in np.arange(3, 50, 1.5) for a in np.linspace(-0.55, 0.55, 40)])
    pillar = np.array([[20.0, 5.0, 3.0], [20.0, 5.0, 1.0]])
    outside = np.array([[70.0, 0.0, 9.0], [5.0, 20.0, 9.0], [-10.0, 0.0, 9.0]])

    def code(*parts: np.ndarray) -> np.ndarray:
        frame = some_frame(points=np.concatenate(parts).astype(np.float32), intensity=None)
        return ScanContextEmbedder().embed(frame).descriptor

    plain, raised = code(ground), code(ground, pillar)
    np.testing.assert_array_equal(plain, code(ground, outside))
    np.testing.assert_array_equal(raised, code(ground, pillar[:1]))
    change = np.abs(raised - plain)[: 20 * 24].reshape(20, 24)
    ring, sector = np.unravel_index(change.argmax(), change.shape)
    assert (ring, sector) == (int(np.hypot(20, 5) / 3), int((np.arctan2(5, 20) + 0.61) / 1.22 * 24))


def test_the_thumbnail_is_blind_to_exposure_and_not_to_the_view():
    image = some_frame().left // 2
    codes = [ThumbnailEmbedder().embed(some_frame(left=left)).descriptor for left in (image, image * 2, image[:, ::-1])]
    assert codes[0] @ codes[1] > 0.99
    assert codes[0] @ codes[2] < 0.6


def test_gradients_are_blind_to_contrast_and_not_to_the_view():
    image = (some_frame().left // 4 + 40).astype(np.uint8)
    flat = np.full_like(image, 90)
    codes = [GradientsEmbedder().embed(some_frame(left=left)).descriptor for left in (image, image * 2, image[:, ::-1])]
    assert codes[0].shape == (GradientsEmbedder.dimension,)
    assert codes[0] @ codes[1] > 0.99
    assert codes[0] @ codes[2] < codes[0] @ codes[1] - 0.01
    for nothing in (flat, None):
        assert np.linalg.norm(GradientsEmbedder().embed(some_frame(left=nothing)).descriptor) == pytest.approx(1)


def test_the_untrained_trunk_needs_its_published_weights_and_sees_the_image_alone(tmp_path):
    with pytest.raises(ConfigError, match=r"lite0: embedding\.weights must name"):
        make_embedder(EmbeddingSettings(method="lite0"))
    torch.save(published_tensors(), tmp_path / "lite0.pth")
    for method, length in (("lite0_mean", 320), ("lite0", 320 * 49)):
        embedder = make_embedder(EmbeddingSettings(method=method, weights=str(tmp_path / "lite0.pth")))
        here, again, there = (embedder.embed(some_frame(seed)).descriptor for seed in (0, 0, 1))
        assert here.shape == (embedder.dimension,) == (length,)
        np.testing.assert_array_equal(here, again)
        assert float(here @ here) == pytest.approx(1, abs=1e-4)
        assert float(here @ there) < 0.9999
        np.testing.assert_array_equal(embedder.embed(some_frame(0, points=None)).descriptor, here)
        assert embedder.embed(some_frame(0, left=None)).descriptor[0] == 1


def test_the_mount_of_the_lidar_changes_neither_descriptor_nor_where_features_lie(weights):
    """The tilt of a mount is undone before the network reads a scan."""
    embedder = UmfEmbedder(EmbeddingSettings(weights=str(weights), runtime="torch", threads=1))
    x, y = np.random.default_rng(3).uniform([[1.0], [-18.0]], [[38.0], [18.0]], (2, 20_000))
    rocks = 1.5 * (np.sin(2 * x) * np.cos(1.5 * y) > 0.9)
    points = np.column_stack([x, y, rocks]).astype(np.float32)
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_rotvec([0.25, 0.375, 0.0]).as_matrix()
    mount[2, 3] = -1.2
    level, tilted = (
        embedder.embed(some_frame(left=None, points=cloud, intensity=None))
        for cloud in (points, transform(mount, points))
    )
    assert level.descriptor @ tilted.descriptor > 0.99
    offsets = tilted.cloud.positions[:, None] - transform(mount, points)[None]
    assert np.linalg.norm(offsets, axis=2).min(axis=1).max() < 0.8
