"""Presets, layers that learn, and what is written of a network."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest
import torch
from safetensors.torch import load_file
from tiny_worlds import TINY, some_input

from umf_ros.baselines.place_network import count_parameters
from umf_ros.core.errors import OutputError, WeightsError
from umf_ros.lab.training.networks import PRESETS, branch_layers, fine_layers, read_card, save_weights
from umf_ros.networks.config import NetworkConfig
from umf_ros.networks.umf import UMF
from umf_ros.networks.weights import load_weights


@pytest.fixture
def network() -> UMF:
    torch.manual_seed(0)
    return UMF(TINY).eval()


@pytest.fixture
def weights(network, tmp_path):
    path = tmp_path / "tiny.safetensors"
    save_weights(network, path, {"name": "tiny"})
    return path


@pytest.mark.parametrize("branch", ["image", "cloud"])
def test_a_branch_is_what_its_modality_alone_needs(network, branch):
    """All on the way to its half of the descriptor, and nothing of the other modality's."""
    mine = {id(value) for layer in branch_layers(network, branch) for value in layer.parameters()}
    names = {name for name, value in network.named_parameters() if id(value) in mine}
    other = {"image": "cloud", "cloud": "image"}[branch]
    assert f"fusion.{branch}_head.weight" in names and f"fusion.layers.0.{branch}_self.norm.weight" in names
    assert not any(part in name for name in names for part in (f"{other}_", "cross", "local", "super", "absent"))


def test_fine_layers_reach_the_local_features_only(network):
    """Without them the descriptor is the same."""
    batch = some_input(TINY)
    before = network(batch)
    with torch.no_grad():
        for layer in fine_layers(network):
            for value in layer.parameters():
                value.zero_()
    after = network(batch)
    assert torch.equal(before.descriptor, after.descriptor)
    assert not torch.allclose(before.image.descriptors, after.image.descriptors)
    assert not torch.allclose(before.cloud.descriptors, after.cloud.descriptors)


def test_the_thesis_network_has_about_39_million_parameters():
    assert count_parameters(UMF(PRESETS["umf_resnet50"])) == pytest.approx(39.4e6, rel=0.02)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_survives_its_own_card(name):
    assert NetworkConfig.from_dict(json.loads(json.dumps(asdict(PRESETS[name])))) == PRESETS[name]


def test_the_default_network_fits_a_rover():
    """Less than twenty megabytes in half precision."""
    network = UMF(PRESETS["umf_light"])
    assert 3.0e6 < count_parameters(network) < 10.0e6
    assert network.config.descriptor == 256


def test_weights_are_half_precision(weights):
    assert load_file(weights)["fusion.image_head.weight"].dtype == torch.float16


def test_card_is_missing(weights):
    weights.with_suffix(".json").unlink()
    with pytest.raises(WeightsError, match="card"):
        read_card(weights)


def test_nowhere_to_write(network, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        save_weights(network, tmp_path / "file" / "w.safetensors", {})


@pytest.mark.parametrize("content", ["", "{", "[1, 2]", "3"])
def test_a_card_that_is_none(weights, content):
    weights.with_suffix(".json").write_text(content)
    with pytest.raises(WeightsError, match="cannot read the card"):
        read_card(weights)


def test_new_weights_replace_old_ones_and_words_stay_readable(network, weights):
    with torch.no_grad():
        network.fusion.image_head.bias.fill_(0.25)
    save_weights(network, weights, {"name": "tiny", "note": "Ätna, 20°"})
    assert load_weights(weights).fusion.image_head.bias.unique().tolist() == [0.25]
    assert read_card(weights)["note"] == "Ätna, 20°"
    assert "Ätna" in weights.with_suffix(".json").read_text(encoding="utf-8")
