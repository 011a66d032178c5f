from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_worlds import TINY, some_input

from umf_ros.core.errors import WeightsError
from umf_ros.lab.training.networks import PRESETS, read_card, save_weights
from umf_ros.networks.config import DEFAULT, NetworkConfig, locate_weights
from umf_ros.networks.umf import UMF
from umf_ros.networks.weights import load_weights


@pytest.fixture
def weights(network, tmp_path):
    path = tmp_path / "tiny.safetensors"
    save_weights(network, path, {"name": "tiny"})
    return path


def rewrite(path, tensors=None, architecture=None):
    content = load_file(path) if tensors is None else tensors
    shape = asdict(TINY) if architecture is None else architecture
    save_file(content, path, metadata={"architecture": json.dumps(shape)})


def test_weights_come_back(network, weights):
    batch = some_input(TINY)
    similarity = (network(batch).descriptor * load_weights(weights)(batch).descriptor).sum(-1)
    assert similarity.min() > 0.9999
    assert NetworkConfig.from_dict(read_card(weights)["architecture"]) == TINY


def test_eight_bits_take_half_the_space_and_say_nearly_the_same(tmp_path):
    network = UMF(replace(TINY, width=32, tokens=64)).eval()
    paths = {name: tmp_path / f"{name}.safetensors" for name in ("half", "int8")}
    for name, path in paths.items():
        save_weights(network, path, {}, name)
    assert paths["int8"].stat().st_size < 0.62 * paths["half"].stat().st_size
    assert [read_card(path)["precision"] for path in paths.values()] == ["half", "int8"]
    stored = load_file(paths["int8"])
    assert stored["fusion.image_head.bias"].dtype == torch.float16
    large = [name for name, value in stored.items() if value.dtype == torch.int8]
    assert large and all(stored[name].abs().max() == 127 for name in large)
    restored = load_weights(paths["int8"])
    for name in large:
        wanted, found = network.state_dict()[name], restored.state_dict()[name]
        step = wanted.abs().amax(dim=tuple(range(1, wanted.ndim)), keepdim=True) / 127
        assert ((wanted - found).abs() <= 0.501 * step).all()
    batch = some_input(network.config)
    assert (network(batch).descriptor * restored(batch).descriptor).sum(-1).min() > 0.999


def test_weights_with_an_endless_header_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes((9 * 10**6).to_bytes(8, "little") + b'{"a":[' + b"{}," * 3 * 10**6)
    with pytest.raises(WeightsError, match="header is too large"):
        load_weights(path)


def test_shipped_weights_are_known_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert locate_weights(None) == locate_weights(Path("umf_scene"))
    assert load_weights(locate_weights(None)).config == PRESETS[DEFAULT]
    assert locate_weights(tmp_path / "umf_light") == tmp_path / "umf_light"


def with_nan(path):
    tensors = load_file(path)
    tensors["fusion.image_head.weight"][0, 0] = float("nan")
    rewrite(path, tensors)


FAULTS = {
    "missing": (Path.unlink, "do not exist"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:5000]), "truncated"),
    "text": (lambda path: path.write_text("hello"), "not a safetensors file"),
    "not a number": (with_nan, r"fusion\.image_head\.weight holds values that are not finite"),
    "another name": (lambda path: rewrite(path, architecture=asdict(TINY) | {"vision": 1}), "another architecture"),
    "another shape": (lambda path: rewrite(path, architecture=asdict(TINY) | {"tokens": 48}), "another architecture"),
    "other tensors": (lambda path: rewrite(path, {"layer.weight": torch.zeros(3)}), "another architecture"),
    "no architecture": (lambda path: save_file(load_file(path), path), "states none"),
    "no JSON": (lambda path: save_file(load_file(path), path, {"architecture": "{not json"}), "another architecture"),
    "a list": (lambda path: save_file(load_file(path), path, {"architecture": "[1, 2]"}), "another architecture"),
    "a number": (lambda path: save_file(load_file(path), path, {"architecture": "7"}), "another architecture"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_other_files_are_refused(weights, fault):
    change, message = FAULTS[fault]
    change(weights)
    with pytest.raises(WeightsError, match=message):
        load_weights(weights)


@pytest.mark.parametrize(
    "changes",
    [
        {"backbone": "vgg16"},
        {"backbone": []},
        {"heads": 0},
        {"heads": -4},
        {"tokens": "many"},
        {"tokens": 2**40},
        {"image_size": [100, 128]},
        {"image_size": [32]},
        {"local": 18},
        {"width": True},
        {"pyramid": 1.5},
        {"layers": 10**7},
        {"voxel_channels": [8, 8, 8, 8]},
        {"coarse_voxels": 10**9},
        {"image_supers": [8000, 8000]},
        {"scene": 8000},
    ],
    ids=str,
)
def test_an_architecture_that_cannot_be_built(weights, changes):
    rewrite(weights, architecture=asdict(TINY) | changes)
    with pytest.raises(WeightsError, match="another architecture") as raised:
        load_weights(weights)
    assert "\n" not in str(raised.value)


def test_statistics_of_the_normalisation_come_back_too(network, tmp_path):
    """A network whose running means were lost would still load, and be useless."""
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.uniform_(-1, 1)
            module.num_batches_tracked.fill_(70_000)  # no half holds that many
    save_weights(network, tmp_path / "a.safetensors", {})
    before, after = network.state_dict(), load_weights(tmp_path / "a.safetensors").state_dict()
    for name, value in before.items():
        if value.is_floating_point():
            torch.testing.assert_close(after[name], value, atol=1e-3, rtol=1e-3)
        else:
            assert torch.equal(after[name], value)


def test_loaded_weights_are_ready_to_use(weights):
    found = load_weights(weights)
    assert not found.training
    assert {value.dtype for value in found.parameters()} == {torch.float32}


def test_scales_that_do_not_fit_are_one_line(tmp_path):
    path = tmp_path / "int8.safetensors"
    save_weights(UMF(replace(TINY, width=32, tokens=64)), path, {}, "int8")
    tensors = load_file(path)
    for name in [name for name in tensors if name.endswith(".scale")]:
        tensors[name] = torch.ones(3, 5, 7, dtype=torch.float16)
    rewrite(path, tensors)
    with pytest.raises(WeightsError) as raised:
        load_weights(path)
    assert "\n" not in str(raised.value)
