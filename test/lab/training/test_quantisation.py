"""OpenVINO models of the networks: what conversion and quantisation keep."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_worlds import TINY
from torch import nn

from umf_ros.core.resources import find
from umf_ros.embedding.runtimes import FACTS, OpenVinoRuntime, openvino_core
from umf_ros.lab.fit import quantisation
from umf_ros.lab.fit.quantisation import (
    FRAMES,
    TwoRangeConvolution,
    convert,
    export_model,
    fold_normalisation,
    quantise,
    rendered_frames,
    save_model,
)
from umf_ros.lab.training.networks import save_weights
from umf_ros.networks.config import XFEAT_OUTPUTS
from umf_ros.networks.umf import UMF

XFEAT = find("models/xfeat.safetensors")


def silent(text: str) -> None: ...


@pytest.fixture
def worlds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the frames of the only world that calibrates."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (FRAMES, 96, 128)).astype(np.uint8)
    points = rng.uniform(0, 20, (FRAMES, 50, 4)).astype(np.float16)
    np.savez(tmp_path / "world_00300.npz", images=images, points=points)
    monkeypatch.setattr(quantisation, "WORLDS", range(300, 301))
    return tmp_path


def test_rendered_worlds_are_read_and_some_modalities_are_missing(worlds: Path) -> None:
    frames = list(rendered_frames(worlds, [300], lambda text: pytest.fail(text)))
    assert len(frames) == FRAMES
    assert sum(frame.left is None for frame in frames) == sum(frame.points is None for frame in frames) == 2
    assert not any(frame.left is None and frame.points is None for frame in frames)


def test_two_ranges_compute_the_convolution_itself() -> None:
    torch.manual_seed(0)
    conv = nn.Conv3d(3, 4, 3, padding=1)
    x = torch.rand(1, 3, 5, 5, 5) * 30
    torch.testing.assert_close(TwoRangeConvolution(conv, 4.0)(x), conv(x), rtol=1e-4, atol=1e-4)


def test_folding_keeps_the_outputs() -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(1, 3, 3), nn.BatchNorm2d(3), nn.ReLU(), nn.Conv2d(3, 2, 1)).eval()
    network[1].running_mean.normal_()
    x = torch.randn(1, 1, 6, 6)
    wanted = network(x)
    fold_normalisation(network)
    assert isinstance(network[1], nn.Identity)
    torch.testing.assert_close(network(x), wanted, rtol=1e-4, atol=1e-5)


def test_convolutions_are_quantised_but_for_those_named() -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(1, 4, 3), nn.ReLU(), nn.Conv2d(4, 4, 3)).eval()
    model = convert(network, {"image": torch.zeros(1, 1, 8, 8)}, ("map",))
    assert model.inputs[0].any_name == "image" and model.outputs[0].any_name == "map"
    inputs = [[np.random.default_rng(seed).normal(size=(1, 1, 8, 8)).astype(np.float32)] for seed in range(4)]
    found = quantise(model, inputs, (r".*module\.0/.*",), silent)
    quantised = [node.get_friendly_name() for node in found.get_ops() if node.get_type_name() == "FakeQuantize"]
    assert len(quantised) == 1 and "module.0/" not in quantised[0]


def test_outside_of_the_encoders_nothing_is_quantised(worlds: Path) -> None:
    weights = worlds / "tiny.safetensors"
    save_weights(UMF(replace(TINY, scene=8)).eval(), weights, {})
    model = export_model(weights, "int8", worlds, silent)
    readers = [
        port.get_node().get_friendly_name()
        for node in model.get_ops()
        if node.get_type_name() == "FakeQuantize"
        for port in node.output(0).get_target_inputs()
    ]
    encoders = re.compile(r"__module\.network\.(image_encoder|voxel_encoder|scene\.trunk)\b")
    assert len(readers) > 20 and all(map(encoders.match, readers))


def test_an_exported_model_runs_beside_its_weights(worlds: Path) -> None:
    shutil.copy(XFEAT, worlds)
    weights = worlds / XFEAT.name
    image = [np.random.default_rng(1).uniform(0, 255, (1, 1, 96, 128)).astype(np.float32)]
    found = {}
    for precision in ("float32", "int8"):
        save_model(export_model(weights, precision, worlds, silent), weights.with_suffix(".openvino"))
        runtime = OpenVinoRuntime(weights, XFEAT_OUTPUTS, 1)
        assert runtime.precision == precision
        found[precision] = runtime.run(image)["descriptors"]
    cosine = (found["float32"] * found["int8"]).sum(axis=0) / np.linalg.norm(found["int8"], axis=0)
    assert 0.98 < np.median(cosine) < 0.99999


def test_a_model_for_other_programs_is_two_files(tmp_path: Path) -> None:
    save_model(export_model(XFEAT, "float32", tmp_path, silent), tmp_path / "net.xml")
    assert openvino_core().read_model(tmp_path / "net.xml").get_rt_info([FACTS, "precision"]).value == "float32"
    assert (tmp_path / "net.bin").stat().st_size > 2_000_000
