"""What runs the network, and where a converted one is kept."""

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
from umf_ros.embedding.export import cached, convert, import_openvino, kept_or_made, openvino_core, save
from umf_ros.embedding.inputs import pack, prepare_scan
from umf_ros.embedding.runtimes import OUTPUTS, SUPERS, make_runtime, make_xfeat_runtime, outputs_of
from umf_ros.embedding.torch_runtimes import TorchRuntime, to_tensors
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
    run = openvino_core().compile_model(model, "CPU", {"INFERENCE_NUM_THREADS": 1})
    return run({"values": np.ones((1, 3), np.float32), "offset": np.full((1, 3), 0.5, np.float32)})[0][0].tolist()


@pytest.fixture
def network() -> UMF:
    torch.manual_seed(0)
    return UMF(TINY)


def test_torch_says_by_name_what_the_network_says(network):
    image = np.random.default_rng(0).normal(size=TINY.image_size).astype(np.float32)
    batch = pack([image], [prepare_scan(some_scan(0), None, TINY)], TINY)
    found = TorchRuntime(network, "cpu", 1, (*OUTPUTS, *SUPERS)).run(batch)
    wanted = network.eval()(to_tensors(batch), super_features=True)
    assert set(found) == {*OUTPUTS, *SUPERS}
    np.testing.assert_allclose(found["descriptor"], wanted.descriptor[0].detach(), atol=1e-6)
    np.testing.assert_allclose(found["cloud_saliency"], wanted.cloud.saliency[0].detach(), atol=1e-6)
    np.testing.assert_allclose(found["super_image_strength"], wanted.super_image.strength[0].detach(), atol=1e-5)
    assert {values.dtype for values in found.values()} == {np.dtype(np.float32)}


def test_only_what_is_asked_for_is_computed():
    assert outputs_of(FeatureRequest()) == OUTPUTS
    assert outputs_of(FeatureRequest(supers=True)) == (*OUTPUTS, *SUPERS)
    assert outputs_of(FeatureRequest(image=False)) == ("descriptor", "cloud", "cloud_saliency")


@pytest.mark.parametrize(("runtime", "device"), [("openvino", "cuda"), ("torch", "abacus"), ("auto", "abacus")])
def test_what_cannot_run_is_refused_in_one_line(runtime, device):
    with pytest.raises(ConfigError, match="embedding") as raised:
        make_runtime(locate_weights(None), EmbeddingSettings(runtime=runtime, device=device), FeatureRequest())
    assert "\n" not in str(raised.value)


def test_a_converted_model_has_named_inputs_of_fixed_size():
    model = convert(Scale(2.0), EXAMPLE)
    assert [port.any_name for port in model.inputs] == ["values", "offset"]
    assert [tuple(port.shape) for port in model.inputs] == [(1, 3), (1, 3)]
    assert answer(model) == [2.5] * 3


def test_a_model_is_made_once_and_then_kept(tmp_path):
    path = tmp_path / "cache" / "model.xml"
    assert answer(kept_or_made(path, lambda: convert(Scale(2.0), EXAMPLE))) == [2.5] * 3
    assert sorted(file.name for file in path.parent.iterdir()) == ["model.bin", "model.xml"]
    assert answer(kept_or_made(path, lambda: pytest.fail("made again"))) == [2.5] * 3


@pytest.mark.parametrize("part", [".xml", ".bin"])
def test_a_damaged_model_is_made_anew(tmp_path, part):
    path = tmp_path / "model.xml"
    save(convert(Scale(2.0), EXAMPLE), path)
    path.with_suffix(part).write_bytes(b"<net" if part == ".xml" else b"")
    assert answer(kept_or_made(path, lambda: convert(Scale(3.0), EXAMPLE))) == [3.5] * 3
    assert answer(kept_or_made(path, lambda: pytest.fail("made again"))) == [3.5] * 3


def test_where_nothing_can_be_kept_it_still_runs(tmp_path):
    (tmp_path / "file").write_text("")
    path = tmp_path / "file" / "model.xml"
    assert answer(kept_or_made(path, lambda: convert(Scale(2.0), EXAMPLE))) == [2.5] * 3
    with pytest.raises(OutputError, match="cannot write"):
        save(convert(Scale(2.0), EXAMPLE), path)


def test_new_weights_and_other_outputs_are_kept_apart(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    one, other = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    one.write_bytes(b"one")
    other.write_bytes(b"other")
    paths = {cached(one), cached(one, OUTPUTS), cached(other)}
    assert len(paths) == 3 and {path.parent for path in paths} == {tmp_path / "cache" / "umf_ros"}
    other.write_bytes(b"one")
    assert cached(other) == cached(one)  # the content counts, not the name


def test_ctrl_c_after_networks_came_and_went_is_survived() -> None:
    script = """
import gc, os, signal
import torch
from umf_ros.embedding import export, runtimes
for _ in range(2):
    model = export.import_openvino().convert_model(torch.nn.Linear(4, 4), example_input=torch.zeros(1, 4))
    compiled = runtimes._compiled(model, 1)
    del compiled, model
    gc.collect()
signal.signal(signal.SIGINT, lambda *_: print("alive"))
os.kill(os.getpid(), signal.SIGINT)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "alive\n"), done.stderr


def test_nobody_is_told_that_a_network_was_converted() -> None:
    script = """
import sys, torch
from umf_ros.embedding.export import convert
convert(torch.nn.Linear(4, 4), {"x": torch.zeros(1, 4)})
print([name for name, module in sys.modules.items() if "openvino_telemetry" in name and module], len(sys.modules) > 9)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "[] True\n"), done.stderr


def test_the_first_inference_happens_where_the_runtime_is_made(monkeypatch):
    """Two threads that initialise OpenVINO's binding at the same moment wait for each other for ever."""
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
    runtime.run(np.ones((64, 64), np.float32))

with watching(20.0):
    threads = [threading.Thread(target=infer, args=(runtime,)) for runtime in runtimes]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
"""


def test_many_threads_infer_at_once_and_none_waits_for_ever():
    """One start of six or so hung before the first inference was made in one thread."""
    for _ in range(8):
        done = subprocess.run([sys.executable, "-c", BARE], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr


def test_weights_that_cannot_be_run_are_refused_at_the_start(monkeypatch):
    from umf_ros.embedding import runtimes

    monkeypatch.setattr(runtimes, "XFEAT_BLANK", np.zeros((384, 7), np.float32))  # no multiple of 32
    with pytest.raises(WeightsError, match=r"xfeat.safetensors cannot be run: ."):
        make_xfeat_runtime(find("models/xfeat.safetensors"), EmbeddingSettings(runtime="openvino", threads=1))
