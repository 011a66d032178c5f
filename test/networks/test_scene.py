"""The scene's part of the descriptor: what it is blind to, what it sees, and how it enters the descriptor."""

from __future__ import annotations

from dataclasses import replace

import torch
from tiny_worlds import TINY, some_input

from umf_ros.networks.efficientnet import SceneDescriptor
from umf_ros.networks.umf import UMF

SCENE = replace(TINY, scene=16)


def test_what_all_cells_share_is_taken_away() -> None:
    scene = SceneDescriptor(16).eval()
    with torch.inference_mode():
        cells = scene.pool(torch.randn(2, 1, 96, 128))
    assert cells.shape == (2, 112, 3, 5)
    torch.testing.assert_close(cells.mean(dim=(2, 3)), torch.zeros(2, 112), atol=1e-5, rtol=0)


def test_a_landmark_on_the_other_side_is_another_scene() -> None:
    scene = SceneDescriptor(64).eval()
    image = 0.1 * torch.randn(1, 1, 96, 128)
    image[..., 20:70, 10:50] += 3
    with torch.inference_mode():
        shown = image, image.flip(-1), image + 0.01 * torch.randn_like(image)
        here, there, again = (torch.nn.functional.normalize(scene(each), dim=1) for each in shown)
    assert float(here @ again.T) > 0.99
    assert float(here @ there.T) < 0.9


def test_what_is_strange_is_long_by_more_than_it_differs() -> None:
    scene = SceneDescriptor(64).eval()
    cells = torch.randn(1, 15 * 112)
    with torch.inference_mode():
        once, twice = scene.project(cells), scene.project(2 * cells)
    torch.testing.assert_close(twice, 4 * once)


def test_the_scene_lengthens_the_descriptor_and_weighs_what_it_is_long() -> None:
    network = UMF(SCENE).eval()
    batch = some_input(SCENE, 3)
    present = batch.coarse_mask.any(1)
    with torch.inference_mode():
        features = network.encode(batch)
        found = network.fuse(features, batch.image_present, torch.zeros_like(present))
        assert found.descriptor.shape == (3, SCENE.length) == (3, TINY.descriptor + 16)
    half = TINY.descriptor // 2
    weight = found.image[:, half:].norm(dim=1) / found.image[:, :half].norm(dim=1)
    torch.testing.assert_close(weight, features.scene.norm(dim=1))
    torch.testing.assert_close(found.image.norm(dim=1), torch.ones(3))


def test_the_scene_says_nothing_of_a_frame_without_an_image() -> None:
    network = UMF(SCENE).eval()
    batch = some_input(SCENE)
    nothing, present = torch.zeros(2, dtype=torch.bool), torch.ones(2, dtype=torch.bool)
    with torch.inference_mode():
        found = network.fuse(network.encode(batch), nothing, present).descriptor
    assert float(found[:, : found.shape[1] - TINY.descriptor // 2].abs().max()) < 1e-5


def test_training_leaves_the_trunk_alone_and_reaches_the_projection() -> None:
    network = UMF(SCENE)
    batch = some_input(SCENE)
    network(batch).descriptor[:, 0].sum().backward()
    assert network.scene is not None
    assert not any(parameter.requires_grad for parameter in network.scene.trunk.parameters())
    assert float(network.scene.projection.weight.grad.abs().sum()) > 0
