"""The last layers, fitted to whole worlds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny_worlds import TINY
from training.conftest import write_world

from umf_ros.datasets.simulated import SimulatedWorld, WorldFolder
from umf_ros.errors import ConfigError
from umf_ros.networks.umf import UMF
from umf_ros.networks.weights import load_weights, read_card, save_weights
from umf_ros.training.batches import stack_views
from umf_ros.training.config import load_training
from umf_ros.training.heads import HeadFitter, pool_world
from umf_ros.training.labels import Rule
from umf_ros.training.run import train
from umf_ros.training.views import ViewMaker


@pytest.fixture
def network() -> UMF:
    torch.manual_seed(0)
    return UMF(TINY)


def settings_for(folder, **changes):
    small = {"preset": "tiny", "stage": "heads", "steps": 60, "epoch_steps": 20, "learning_rate": 0.01}
    return load_training(None, train=str(folder), **(small | {"warmup_steps": 1} | changes))


def silent(_):
    pass


@pytest.mark.parametrize("mirror", [False, True])
def test_what_is_pooled_becomes_the_descriptor_of_the_whole_network(network, world, mirror):
    rows = np.array([0, 3, 7])
    found = pool_world(network, world, rows, mirror, Rule())
    inputs = stack_views([ViewMaker(TINY).plain(world.sample(int(row)), mirror) for row in rows], TINY)
    features, every, none = network.encode(inputs), torch.ones(3, dtype=torch.bool), torch.zeros(3, dtype=torch.bool)
    for mode, there in {"fused": (every, every), "image": (every, none), "cloud": (none, every)}.items():
        frames = found.frames[mode]
        again = network.fusion.unite(frames.pooled, frames.images, frames.clouds).descriptor
        torch.testing.assert_close(again, network.fuse(features, *there).descriptor, atol=1e-5, rtol=0)
    plain = pool_world(network, world, rows, False, Rule()).frames["fused"]
    assert torch.equal(found.frames["fused"].pooled.image, plain.pooled.image) != mirror


def test_right_near_and_wrong_are_told_by_pass_distance_and_heading(network, world):
    """Two passes of six frames each, 8 m apart along the line and 2 m between the passes."""
    found = pool_world(network, world, np.arange(len(world)), False, Rule(positive_m=9.0))
    half = len(world) // 2
    for query in range(len(world)):
        for reference in range(len(world)):
            metres = np.linalg.norm(world.world_T_body[query, :2, 3] - world.world_T_body[reference, :2, 3])
            other = (query < half) != (reference < half)
            kinds = [bool(kind[query, reference]) for kind in (found.right, found.near, found.wrong)]
            assert kinds == [other and metres < 9, other and metres < 5, other and metres >= 11]


def test_only_the_heads_move_and_they_find_more(folder, tmp_path, network):
    save_weights(network, tmp_path / "start.safetensors", {"command": "x", "settings": {}, "steps": 1})
    chosen = settings_for(folder, start=str(tmp_path / "start.safetensors"), validation=str(folder))
    reported: list[float] = []
    path = train(chosen, tmp_path / "run", False, lambda progress: reported.append(progress.losses["total"]))
    before, after = (load_weights(file).state_dict() for file in (tmp_path / "start.safetensors", path))
    card = read_card(path)
    moved = {name for name, value in before.items() if not torch.equal(value, after[name])}
    heads = ("fusion.image_head.", "fusion.cloud_head.", "fusion.weigh.")
    assert moved == {name for name in after if name.startswith(heads)}
    assert len(reported) == 60 and reported[-1] < 0.8 * reported[0]
    assert card["steps"] == 60 and 0 <= card["validation"]["world_00001"]["fused"]["recall1"] <= 1
    assert [line.split(",")[0] for line in (tmp_path / "run" / "log.csv").read_text().split()] == [
        "step", "20", "40", "60",
    ]  # fmt: skip


def test_heads_repeat_themselves_from_their_seed(folder, tmp_path, network):
    found = []
    for seed in (3, 3, 4):
        torch.manual_seed(0)
        copy = UMF(TINY)
        HeadFitter(copy, settings_for(folder, seed=seed, steps=9), WorldFolder(folder).refresh, list, tmp_path).run(
            silent, lambda *_: None
        )
        found.append(copy.fusion.image_head.weight.detach().clone())
    assert torch.equal(found[0], found[1]) and not torch.equal(found[0], found[2])


def test_heads_need_both_modalities(folder):
    with pytest.raises(ConfigError, match="branch must be both"):
        settings_for(folder, branch="image", local_pairs=0)


def test_heads_are_not_resumed(folder, tmp_path):
    with pytest.raises(ConfigError, match="nothing to resume"):
        train(settings_for(folder), tmp_path / "run", True, silent)


def test_worlds_without_a_revisit_teach_no_heads(tmp_path, network):
    write_world(tmp_path / "world_00001.npz", 1)
    lonely = SimulatedWorld(tmp_path / "world_00001.npz")
    lonely.pass_index[:] = 0
    with pytest.raises(ConfigError, match="visited twice"):
        HeadFitter(network, settings_for(tmp_path), lambda: [lonely], list, tmp_path).run(silent, lambda *_: None)
