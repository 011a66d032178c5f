from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny_worlds import TINY

from umf_ros.lab.training.masked_objectives import (
    MaskedBatch,
    MaskedImagesObjective,
    hide,
    normalised,
    patches,
    repainted,
    sparse,
    spread,
    unpatch,
    visible_patches,
)
from umf_ros.lab.training.trainer import load_run
from umf_ros.networks.encoders import Backbone
from umf_ros.networks.umf import UMF

SIZE = TINY.image_size


def objective() -> MaskedImagesObjective:
    settings = load_run(None, method="masked_images", train="", decoder_width=32)
    return MaskedImagesObjective(UMF(TINY), settings)


@pytest.fixture(params=["resnet18", "resnet50"])
def backbone(request: pytest.FixtureRequest) -> Backbone:
    torch.manual_seed(0)
    return Backbone(request.param, 8).train()


@pytest.fixture
def visible(rng: np.random.Generator) -> torch.Tensor:
    return visible_patches(4, SIZE, 0.5, rng)


def test_hidden_places_stay_empty_through_every_stage(backbone: Backbone, visible: torch.Tensor) -> None:
    with sparse(backbone, visible):
        maps = backbone(hide(torch.rand(4, 1, *SIZE), visible))
    for found in maps:
        where = spread(visible, found.shape[2]).expand_as(found)
        assert (found[~where] == 0).all() and (found[where] != 0).any()


def test_nothing_of_a_hidden_patch_leaks(backbone: Backbone, visible: torch.Tensor) -> None:
    image = torch.rand(4, 1, *SIZE)
    altered = torch.where(spread(visible, SIZE[0]), image, torch.rand(4, 1, *SIZE))
    with sparse(backbone, visible):
        maps, others = backbone(hide(image, visible)), backbone(hide(altered, visible))
    assert all(torch.equal(a, b) for a, b in zip(maps, others, strict=True))


def test_with_everything_visible_it_is_the_ordinary_encoder(backbone: Backbone) -> None:
    image = torch.rand(4, 1, *SIZE)
    ordinary = backbone(image)[-1]
    with sparse(backbone, torch.ones(4, 1, 2, 3, dtype=torch.bool)):
        emulated = backbone(image)[-1]
    assert torch.allclose(ordinary, emulated, atol=5e-3)  # statistics of 24 values amplify rounding
    assert torch.equal(backbone(image)[-1], ordinary)  # and afterwards again


def test_statistics_are_those_of_the_visible_part(visible: torch.Tensor) -> None:
    """A mostly hidden batch must not teach the normalisation that images are black."""
    torch.manual_seed(0)
    dense, masked = Backbone("resnet18", 8).train(), Backbone("resnet18", 8).train()
    masked.load_state_dict(dense.state_dict())
    image = torch.rand(4, 1, *SIZE) + 5
    dense(image)
    with sparse(masked, visible):
        masked(hide(image, visible))
    spread_of = [net.stem[0][1].running_var.mean().item() for net in (dense, masked)]
    assert spread_of[1] == pytest.approx(spread_of[0], rel=0.5)


def test_patches_are_cut_and_put_back() -> None:
    image = torch.rand(2, 1, *SIZE)
    flat = patches(image)
    assert flat.shape == (2, 6, 1024)
    assert torch.equal(flat[1, 4], image[1, 0, 32:, 32:64].flatten())
    assert torch.equal(unpatch(flat, SIZE), image)
    even = normalised(flat)
    assert even.mean(2).abs().max() < 1e-4 and (normalised(100 * flat).var(2) - 1).abs().max() < 0.01
    snow = normalised(flat * 0.01).var(2)  # nothing but noise stays small
    assert snow.max() < 0.01


def test_only_hidden_patches_count_and_are_painted(visible: torch.Tensor) -> None:
    torch.manual_seed(1)
    model = objective().eval()
    image = torch.rand(4, 1, *SIZE)
    batch = MaskedBatch(image, visible)
    loss, painting = model(batch)["total"], model.paint(batch)
    error = (patches(painting) - normalised(patches(image))).square().mean(2)
    assert loss.item() == pytest.approx(error[~visible.flatten(1)].mean().item(), rel=1e-5)
    result = repainted(image, painting, visible)
    where = spread(visible, SIZE[0])
    assert torch.equal(result[where], image[where]) and not torch.equal(result, image)
    perfect = repainted(image, unpatch(normalised(patches(image)), SIZE), visible)
    assert torch.allclose(perfect, image, atol=1e-5)


def test_every_parameter_learns(visible: torch.Tensor) -> None:
    model = objective()
    model(MaskedBatch(torch.rand(4, 1, *SIZE), visible))["total"].backward()
    learned = [*model.network.image_encoder.backbone.parameters(), *model.decoder.parameters()]
    assert [value for value in learned if value.grad is None] == []


def test_exactly_the_wanted_share_of_every_image_is_hidden(rng: np.random.Generator) -> None:
    visible = visible_patches(50, (128, 160), 0.6, rng)
    assert visible.shape == (50, 1, 4, 5)
    assert (visible.flatten(1).sum(1) == 8).all()
    assert visible.float().mean(0).min() > 0.2 and visible.float().mean(0).max() < 0.65  # no place is preferred


def test_a_patch_at_least_stays_visible(rng: np.random.Generator) -> None:
    assert visible_patches(3, (64, 64), 0.99, rng).flatten(1).sum(1).tolist() == [1, 1, 1]
