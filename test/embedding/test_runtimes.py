"""Runtimes of the networks, and the models beside their weights."""

from __future__ import annotations

import shutil
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from sources import run
from tiny_worlds import TINY, some_scan

from umf_ros.core.config import Database, EmbeddingSettings
from umf_ros.core.errors import ConfigError, UmfError, WeightsError
from umf_ros.core.resources import find
from umf_ros.embedding import FeatureRequest
from umf_ros.embedding.inputs import pack, prepare_scan, standardise
from umf_ros.embedding.runtimes import (
    OUTPUTS,
    SCAN_TOKENS,
    SCENE_MAP,
    SUPERS,
    OpenVinoRuntime,
    Runtime,
    TorchRuntime,
    import_openvino,
    make_runtime,
    name_outputs,
    outputs_of,
)
from umf_ros.lab.training.networks import save_weights
from umf_ros.networks.config import XFEAT_OUTPUTS, locate_weights, read_config
from umf_ros.networks.umf import UMF
from umf_ros.networks.weights import load_weights
from umf_ros.places.database import PlaceDatabase

XFEAT = find("models/xfeat.safetensors")
IMAGE = np.random.default_rng(0).uniform(0, 255, (1, 1, 64, 96)).astype(np.float32)


@pytest.fixture
def network() -> UMF:
    torch.manual_seed(0)
    return UMF(TINY)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of XFeat's weights, with the model beside it."""
    for suffix in (".safetensors", ".openvino"):
        shutil.copy(XFEAT.with_suffix(suffix), tmp_path)
    return tmp_path / XFEAT.name


def settings(runtime: str = "auto") -> EmbeddingSettings:
    return EmbeddingSettings.model_validate({"runtime": runtime, "threads": 1})


def xfeat(weights: Path, runtime: str = "auto") -> Runtime:
    return make_runtime(weights, settings(runtime), XFEAT_OUTPUTS)


def test_torch_runtime_gives_the_outputs_of_the_network(network, tmp_path):
    image = np.random.default_rng(0).normal(size=TINY.image_size).astype(np.float32)
    batch = pack([image], [prepare_scan(some_scan(0), None, TINY)], TINY)
    outputs = outputs_of(FeatureRequest(supers=True))
    save_weights(network, tmp_path / "tiny.safetensors", {})
    network = load_weights(tmp_path / "tiny.safetensors")
    found = TorchRuntime(tmp_path / "tiny.safetensors", outputs, "cpu", 1).run(batch)
    wanted = network.eval()(batch.tensors(), super_features=True)
    assert set(found) == {*OUTPUTS, *SUPERS}
    np.testing.assert_allclose(found["descriptor"], wanted.descriptor[0].detach(), atol=1e-6)
    np.testing.assert_allclose(found["cloud_saliency"], wanted.cloud.saliency[0].detach(), atol=1e-6)
    np.testing.assert_allclose(found["super_image_strength"], wanted.super_image.strength[0].detach(), atol=1e-5)
    assert {values.dtype for values in found.values()} == {np.dtype(np.float32)}


def test_half_precision_of_a_gpu_changes_descriptors_little():
    """The same code on the CPU, as a GPU would run it; its descriptors have another name."""
    config = read_config(locate_weights(None))
    image = np.random.default_rng(0).normal(size=config.image_size).astype(np.float32)
    umf = pack([image], [prepare_scan(some_scan(0), None, config)], config)
    for weights, outputs, inputs in (locate_weights(None), OUTPUTS, umf), (XFEAT, XFEAT_OUTPUTS, [IMAGE]):
        runtime = TorchRuntime(weights, outputs, "cpu", 1)
        single, name = runtime.run(inputs)[outputs[0]], name_outputs(weights, runtime)
        runtime.precision = "float16"
        half = runtime.run(inputs)[outputs[0]]
        assert half.dtype == np.float32 and not np.array_equal(half, single)
        assert (half * single).sum() / np.linalg.norm(half) / np.linalg.norm(single) > 0.999
        assert name_outputs(weights, runtime) == name.replace("-", "-float16-")


def test_the_map_of_the_trunk_and_tokens_of_the_scan_come_with_the_descriptor_in_eight_bits_as_well():
    """The shipped model was exported without these outputs."""
    weights = locate_weights(None)
    config = read_config(weights)
    rows, columns = np.indices(config.image_size)
    image = standardise((128 + 60 * np.sin(rows / 9) + 60 * np.sin(rows * columns / 4000)).astype(np.uint8))
    scan, names = prepare_scan(some_scan(0), None, config), ("descriptor", SCENE_MAP, SCAN_TOKENS)
    umf = pack([image], [scan], config)
    quantised, single = (make_runtime(weights, settings(runtime), names).run(umf) for runtime in ("auto", "torch"))
    assert set(quantised) == set(single) == set(names)
    assert quantised[SCENE_MAP].shape == (112, *(side // 16 for side in config.image_size))
    for found in (quantised, single):
        found[SCAN_TOKENS] = found[SCAN_TOKENS][scan.coarse_mask].T
    for name in names[1:]:
        ours, theirs = (found[name] / np.linalg.norm(found[name], axis=0) for found in (quantised, single))
        assert np.median((ours * theirs).sum(axis=0)) > 0.9
    without = make_runtime(weights, settings(), ("descriptor",)).run(umf)
    np.testing.assert_array_equal(without["descriptor"], quantised["descriptor"])


def test_only_requested_outputs_are_computed():
    assert outputs_of(FeatureRequest()) == OUTPUTS
    assert outputs_of(FeatureRequest(supers=True)) == (*OUTPUTS, *SUPERS)
    assert outputs_of(FeatureRequest(image=False)) == ("descriptor", "cloud_local", "cloud_saliency")
    assert set(OpenVinoRuntime(XFEAT, XFEAT_OUTPUTS[:2], 1).run([IMAGE])) == set(XFEAT_OUTPUTS[:2])


@pytest.mark.parametrize(("runtime", "device"), [("openvino", "cuda"), ("torch", "abacus"), ("auto", "abacus")])
def test_an_unusable_runtime_or_device_is_refused_in_one_line(runtime, device):
    with pytest.raises(ConfigError, match="embedding") as raised:
        make_runtime(locate_weights(None), EmbeddingSettings(runtime=runtime, device=device), OUTPUTS)
    assert "\n" not in str(raised.value)


def test_weights_with_a_model_beside_them_run_in_openvino_and_others_in_torch(copy):
    assert xfeat(copy).precision == "int8"
    assert xfeat(copy, "torch").precision == "float32"
    copy.with_suffix(".openvino").unlink()
    assert isinstance(xfeat(copy), TorchRuntime)
    with pytest.raises(ConfigError, match=r"cannot use openvino: xfeat.openvino is not beside the weights.*umf export"):
        xfeat(copy, "openvino")


def test_without_torch_one_line_names_the_package(monkeypatch, copy):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ConfigError, match=r"^torch is not installed: .* needs pip install 'umf_ros\[torch\]'$"):
        xfeat(copy, "torch")


def test_without_openvino_torch_runs_the_same_weights(monkeypatch):
    monkeypatch.setattr("umf_ros.embedding.runtimes.find_spec", lambda name: None)
    assert isinstance(xfeat(XFEAT), TorchRuntime)
    with pytest.raises(ConfigError, match="it is not installed"):
        xfeat(XFEAT, "openvino")


def test_the_norm_of_the_descriptor_keeps_its_precision():
    """In eight bits, the norm was cut off for an image alone or a strange one, whose parts are longer."""
    config, rng = read_config(locate_weights(None)), np.random.default_rng(0)
    runtime = make_runtime(locate_weights(None), settings("openvino"), ("descriptor",))
    assert runtime.precision == "int8"
    image = np.kron(rng.normal(size=(5, 7)), np.ones((32, 32))).astype(np.float32)
    for left, points in (image, some_scan(0)), (image, np.empty((0, 3), np.float32)), (None, some_scan(0)):
        found = runtime.run(pack([left], [prepare_scan(points, None, config)], config))["descriptor"]
        assert np.linalg.norm(found) == pytest.approx(1, abs=1e-5)


def test_a_model_of_other_weights_is_refused(copy):
    copy.write_bytes(copy.read_bytes() + b" ")
    with pytest.raises(WeightsError, match=r"xfeat.openvino was made from other weights; .* umf export"):
        xfeat(copy)


@pytest.mark.parametrize("keep", [0, 1000, 400_000])
def test_a_damaged_model_is_refused_in_one_line(copy, keep):
    model = copy.with_suffix(".openvino")
    model.write_bytes(model.read_bytes()[:keep])
    with pytest.raises(WeightsError, match=r"xfeat.openvino is damaged: .") as raised:
        xfeat(copy)
    assert "\n" not in str(raised.value)


def test_the_name_tells_precisions_apart(copy):
    fast, plain = (name_outputs(copy, xfeat(copy, name)) for name in ("openvino", "torch"))
    assert fast.startswith("xfeat-int8-") and plain.startswith("xfeat-") and "int8" not in plain
    assert name_outputs(XFEAT, xfeat(XFEAT)) == fast  # of the content, not of the place
    assert name_outputs(copy, xfeat(copy), b"other preprocessing") != fast


def test_a_store_of_another_precision_is_refused_in_one_line(tmp_path):
    plain, fast = (name_outputs(XFEAT, xfeat(XFEAT, name)) for name in ("torch", "openvino"))
    PlaceDatabase(Database(path=str(tmp_path / "places.db")), plain, 64).close()
    with pytest.raises(UmfError, match=f"places.db was made with embedder {plain}, not {fast}$"):
        PlaceDatabase(Database(path=str(tmp_path / "places.db")), fast, 64)


def test_ctrl_c_after_destroyed_networks_does_not_crash() -> None:
    script = """
import gc, os, signal
from umf_ros.core.resources import find
from umf_ros.embedding import runtimes
for _ in range(2):
    compiled = runtimes.OpenVinoRuntime(find("models/xfeat.safetensors"), runtimes.XFEAT_OUTPUTS, 1)
    del compiled
    gc.collect()
signal.signal(signal.SIGINT, lambda *_: print("alive"))
os.kill(os.getpid(), signal.SIGINT)
"""
    done = run(sys.executable, "-c", script, timeout=120)
    assert (done.returncode, done.stdout) == (0, "alive\n"), done.stderr


def test_openvino_is_loaded_without_its_telemetry_and_without_torch() -> None:
    script = """
import sys
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.resources import find
from umf_ros.embedding.runtimes import XFEAT_OUTPUTS, make_runtime
make_runtime(find("models/xfeat.safetensors"), EmbeddingSettings(threads=1), XFEAT_OUTPUTS)
print([name for name in ("openvino_telemetry", "torch", "nncf") if sys.modules.get(name)], "openvino" in sys.modules)
"""
    done = run(sys.executable, "-c", script, timeout=120)
    assert (done.returncode, done.stdout) == (0, "[] True\n"), done.stderr


def test_the_first_inference_runs_in_the_thread_that_makes_the_runtime(monkeypatch):
    """Two threads that initialise OpenVINO's binding at the same moment deadlock."""
    openvino = import_openvino()
    really, threads = openvino.CompiledModel.__call__, []

    def infer(self, *arguments):
        threads.append(threading.current_thread())
        return really(self, *arguments)

    monkeypatch.setattr(openvino.CompiledModel, "__call__", infer)
    make_runtime(locate_weights(None), settings("openvino"), OUTPUTS)
    xfeat(XFEAT, "openvino")
    assert threads == [threading.current_thread()] * 2


BARE = """
import sys, threading
import numpy as np
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.resources import find
from umf_ros.core.watchdog import watching
from umf_ros.embedding.runtimes import XFEAT_OUTPUTS, make_runtime

weights, settings = find("models/xfeat.safetensors"), EmbeddingSettings(threads=1)
runtimes = [make_runtime(weights, settings, XFEAT_OUTPUTS) for _ in range(6)]
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
        done = run(sys.executable, "-c", BARE)
        assert done.returncode == 0, done.stderr


def test_a_network_that_cannot_run_is_refused_at_the_start(monkeypatch):
    monkeypatch.setattr("umf_ros.embedding.runtimes.XFEAT_SHAPE", (1, 3, 384, 512))  # three channels
    with pytest.raises(WeightsError, match=r"xfeat.safetensors cannot be run: ."):
        xfeat(XFEAT, "openvino")


LOADING = """
import locale, threading
from umf_ros.core.config import EmbeddingSettings
from umf_ros.embedding.runtimes import OUTPUTS, XFEAT_OUTPUTS, make_runtime
from umf_ros.core.resources import find

before = locale.setlocale(locale.LC_ALL)
asked = [("umf_scene", OUTPUTS), ("xfeat", XFEAT_OUTPUTS)] * 3
failed, begin = [], threading.Barrier(len(asked))
threading.excepthook = lambda arguments: failed.append(str(arguments.exc_value))

def load(name, outputs):
    weights = find(f"models/{name}.safetensors")
    begin.wait()
    make_runtime(weights, EmbeddingSettings(runtime="openvino", threads=1), outputs)

threads = [threading.Thread(target=load, args=one) for one in asked]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print(failed, locale.setlocale(locale.LC_ALL) == before)
"""


def test_threads_that_load_at_once_neither_fail_nor_change_the_locale():
    """Else a model is "damaged", or all text of the process is ASCII from then on."""
    done = run(sys.executable, "-c", LOADING, timeout=120)
    assert (done.returncode, done.stdout) == (0, "[] True\n"), done.stdout + done.stderr
