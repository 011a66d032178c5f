"""Runtimes of the networks, and the cache of converted models."""

from __future__ import annotations

import subprocess
import sys
import threading

import numpy as np
import pytest
import torch
from tiny_worlds import TINY, some_scan
from torch import Tensor, nn

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError, OutputError, WeightsError
from umf_ros.core.resources import find
from umf_ros.embedding.embedder import FeatureRequest
from umf_ros.embedding.inputs import pack, prepare_scan
from umf_ros.embedding.runtimes import (
    OUTPUTS,
    SUPERS,
    OpenVinoRuntime,
    cache_path,
    convert,
    import_openvino,
    load_or_convert,
    make_runtime,
    make_xfeat_runtime,
    outputs_of,
    save_model,
)
from umf_ros.embedding.torch_runtimes import FlatUmf, TorchRuntime, to_tensors
from umf_ros.networks.config import locate_weights
from umf_ros.networks.umf import UMF


class Scale(nn.Module):
    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, values: Tensor, offset: Tensor) -> Tensor:
        return self.factor * values + offset


EXAMPLE = {"values": torch.zeros(1, 3), "offset": torch.zeros(1, 3)}


def answer(model: object) -> list[float]:
    values, offset = np.ones((1, 3), np.float32), np.full((1, 3), 0.5, np.float32)
    return OpenVinoRuntime(model, 1).run([values, offset])[0].tolist()


@pytest.fixture
def network() -> UMF:
    torch.manual_seed(0)
    return UMF(TINY)


def test_torch_runtime_gives_the_outputs_of_the_network(network):
    image = np.random.default_rng(0).normal(size=TINY.image_size).astype(np.float32)
    batch = pack([image], [prepare_scan(some_scan(0), None, TINY)], TINY)
    outputs = outputs_of(FeatureRequest(supers=True))
    found = dict(zip(outputs, TorchRuntime(FlatUmf(network, outputs), "cpu", 1).run(batch), strict=True))
    wanted = network.eval()(to_tensors(batch), super_features=True)
    assert set(found) == {*OUTPUTS, *SUPERS}
    np.testing.assert_allclose(found["descriptor"], wanted.descriptor[0].detach(), atol=1e-6)
    np.testing.assert_allclose(found["cloud_saliency"], wanted.cloud.saliency[0].detach(), atol=1e-6)
    np.testing.assert_allclose(found["super_image_strength"], wanted.super_image.strength[0].detach(), atol=1e-5)
    assert {values.dtype for values in found.values()} == {np.dtype(np.float32)}


def test_only_requested_outputs_are_computed():
    assert outputs_of(FeatureRequest()) == OUTPUTS
    assert outputs_of(FeatureRequest(supers=True)) == (*OUTPUTS, *SUPERS)
    assert outputs_of(FeatureRequest(image=False)) == ("descriptor", "cloud", "cloud_saliency")


@pytest.mark.parametrize(("runtime", "device"), [("openvino", "cuda"), ("torch", "abacus"), ("auto", "abacus")])
def test_an_unusable_runtime_or_device_is_refused_in_one_line(runtime, device):
    with pytest.raises(ConfigError, match="embedding") as raised:
        make_runtime(locate_weights(None), EmbeddingSettings(runtime=runtime, device=device), FeatureRequest())
    assert "\n" not in str(raised.value)


def test_a_converted_model_has_named_inputs_of_fixed_size():
    model = convert(Scale(2.0), EXAMPLE)
    assert [port.any_name for port in model.inputs] == ["values", "offset"]
    assert [tuple(port.shape) for port in model.inputs] == [(1, 3), (1, 3)]
    assert answer(model) == [2.5] * 3


def test_a_model_is_converted_once_and_then_cached(tmp_path):
    path = tmp_path / "cache" / "model.xml"
    assert answer(load_or_convert(path, lambda: convert(Scale(2.0), EXAMPLE))) == [2.5] * 3
    assert sorted(file.name for file in path.parent.iterdir()) == ["model.bin", "model.xml"]
    assert answer(load_or_convert(path, lambda: pytest.fail("converted again"))) == [2.5] * 3


@pytest.mark.parametrize("part", [".xml", ".bin"])
def test_a_damaged_cached_model_is_converted_again(tmp_path, part):
    path = tmp_path / "model.xml"
    save_model(convert(Scale(2.0), EXAMPLE), path)
    path.with_suffix(part).write_bytes(b"<net" if part == ".xml" else b"")
    assert answer(load_or_convert(path, lambda: convert(Scale(3.0), EXAMPLE))) == [3.5] * 3
    assert answer(load_or_convert(path, lambda: pytest.fail("converted again"))) == [3.5] * 3


def test_a_model_runs_without_a_writable_cache(tmp_path):
    (tmp_path / "file").write_text("")
    path = tmp_path / "file" / "model.xml"
    assert answer(load_or_convert(path, lambda: convert(Scale(2.0), EXAMPLE))) == [2.5] * 3
    with pytest.raises(OutputError, match="cannot write"):
        save_model(convert(Scale(2.0), EXAMPLE), path)


def test_the_cache_path_depends_on_weights_and_outputs(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    one, other = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    one.write_bytes(b"one")
    other.write_bytes(b"other")
    paths = {cache_path(one), cache_path(one, OUTPUTS), cache_path(other)}
    assert len(paths) == 3 and {path.parent for path in paths} == {tmp_path / "cache" / "umf_ros"}
    other.write_bytes(b"one")
    assert cache_path(other) == cache_path(one)  # the path depends on the content, not on the name


def test_ctrl_c_after_destroyed_networks_does_not_crash() -> None:
    script = """
import gc, os, signal
import torch
from umf_ros.embedding import runtimes
for _ in range(2):
    model = runtimes.import_openvino().convert_model(torch.nn.Linear(4, 4), example_input=torch.zeros(1, 4))
    compiled = runtimes.OpenVinoRuntime(model, 1)
    del compiled, model
    gc.collect()
signal.signal(signal.SIGINT, lambda *_: print("alive"))
os.kill(os.getpid(), signal.SIGINT)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "alive\n"), done.stderr


def test_conversion_does_not_load_the_telemetry() -> None:
    script = """
import sys, torch
from umf_ros.embedding.runtimes import convert
convert(torch.nn.Linear(4, 4), {"x": torch.zeros(1, 4)})
print([name for name, module in sys.modules.items() if "openvino_telemetry" in name and module], len(sys.modules) > 9)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "[] True\n"), done.stderr


def test_the_first_inference_runs_in_the_thread_that_makes_the_runtime(monkeypatch):
    """Two threads that initialise OpenVINO's binding at the same moment deadlock."""
    openvino = import_openvino()
    really, threads = openvino.CompiledModel.__call__, []

    def infer(self, *arguments):
        threads.append(threading.current_thread())
        return really(self, *arguments)

    monkeypatch.setattr(openvino.CompiledModel, "__call__", infer)
    settings = EmbeddingSettings(runtime="openvino", threads=1)
    make_runtime(locate_weights(None), settings, FeatureRequest())
    make_xfeat_runtime(find("models/xfeat.safetensors"), settings)
    assert threads == [threading.current_thread()] * 2


BARE = """
import sys, threading
import numpy as np
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.resources import find
from umf_ros.core.watchdog import watching
from umf_ros.embedding.runtimes import make_xfeat_runtime

runtimes = [make_xfeat_runtime(find("models/xfeat.safetensors"), EmbeddingSettings(threads=1)) for _ in range(6)]
begin = threading.Barrier(len(runtimes))

def infer(runtime):
    begin.wait()
    runtime.run([np.ones((1, 1, 64, 64), np.float32)])

with watching(20.0):
    threads = [threading.Thread(target=infer, args=(runtime,)) for runtime in runtimes]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
"""


def test_concurrent_inference_does_not_deadlock():
    """Without the warm-up one start in six hung."""
    for _ in range(8):
        done = subprocess.run([sys.executable, "-c", BARE], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr


def test_a_network_that_cannot_run_is_refused_at_the_start(monkeypatch):
    from umf_ros.embedding import runtimes

    monkeypatch.setattr(runtimes, "XFEAT_BLANK", np.zeros((1, 3, 384, 512), np.float32))  # three channels
    with pytest.raises(WeightsError, match=r"xfeat.safetensors cannot be run: ."):
        make_xfeat_runtime(find("models/xfeat.safetensors"), EmbeddingSettings(runtime="openvino", threads=1))
