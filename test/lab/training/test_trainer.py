"""Whole runs on a world small enough to train in seconds."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_worlds import TINY

from umf_ros.core.errors import ConfigError, UmfError, WeightsError
from umf_ros.lab.datasets.sample import Rule
from umf_ros.lab.datasets.simulated import WorldFolder
from umf_ros.lab.datasets.views import Augmentation, ViewMaker
from umf_ros.lab.training.batches import BatchMaker, PairSampler, places_drawn
from umf_ros.lab.training.metric_objective import MetricObjective, rule_of, validate
from umf_ros.lab.training.networks import read_card
from umf_ros.lab.training.trainer import Team, Trainer, load_run, train
from umf_ros.networks.umf import UMF
from umf_ros.networks.weights import load_weights

RULE = Rule(positive_m=5)


def settings_for(folder, **changes):
    small = {
        "preset": "tiny",
        "steps": 4,
        "epoch_steps": 2,
        "batch": 8,
        "local_pairs": 2,
        "bank_from_step": 2,
        "warmup_steps": 1,
    }
    return load_run(None, train=str(folder), **(small | changes))


def silent(*_):
    pass


def run(network, settings, folder, out, report=silent):
    """Train with no validation; the objective, and the trainer when it is done."""
    objective = MetricObjective(network, settings, list)
    trainer = Trainer(objective, WorldFolder(folder).refresh, settings, out, Team(0, 1, torch.device("cpu")))
    trainer.run(report, silent)
    return objective, trainer


def weights_of(path):
    return torch.cat([value.flatten().float() for value in load_weights(path).state_dict().values()])


def batch_of(world, seed=0):
    pairs = PairSampler([world], RULE).draw(4, np.random.default_rng(seed))
    return BatchMaker([world], ViewMaker(TINY, Augmentation()), 2, 16).make(pairs, np.random.default_rng(seed))


def test_pairs_show_one_place_in_different_passes(world):
    for anchor, positive in PairSampler([world], RULE).draw(8, np.random.default_rng(0)):
        assert anchor.mirror == positive.mirror
        assert world.pass_index[anchor.index] != world.pass_index[positive.index]
        apart = world.world_T_body[anchor.index, :2, 3] - world.world_T_body[positive.index, :2, 3]
        assert np.linalg.norm(apart) < 5


def test_a_mirrored_world_is_another_world(world):
    sampler, rng = PairSampler([world], RULE), np.random.default_rng(1)
    places = places_drawn([draw for _ in range(8) for pair in sampler.draw(8, rng) for draw in pair], [world])
    mirrored = places.world == 1
    assert 0 < mirrored.sum() < 128
    assert (places.position[mirrored, 1] <= 0).all()
    assert (places.position[~mirrored, 1] >= 0).all()


@pytest.mark.parametrize("loss", ["multi_similarity", "triplet"])
def test_every_parameter_of_the_run_learns(world, folder, loss):
    torch.manual_seed(0)
    network = UMF(TINY).train()
    batch = batch_of(world)
    image = torch.tensor([True] * 7 + [False])
    cloud = torch.tensor([False] + [True] * 7)
    objective = MetricObjective(network, settings_for(folder, loss=loss), list)
    losses = objective(replace(batch, image_kept=image, cloud_kept=cloud))
    losses["total"].backward()
    idle = [n for n, p in network.named_parameters() if p.grad is None or not p.grad.abs().any()]
    assert [name for name in idle if not name.endswith("key_value.bias")] == []


def test_what_only_local_features_teach_is_switched_off_without_them(folder, tmp_path):
    """Else it would stay at random, and several processes would wait for its gradient for ever."""
    torch.manual_seed(1)
    network = UMF(TINY)
    settings = settings_for(folder, local_pairs=0, modality_dropout=0.0, steps=1)
    run(network, settings, folder, tmp_path)
    idle = [n for n, p in network.named_parameters() if p.requires_grad and p.grad is None]
    assert idle == []
    assert not network.image_encoder.pyramid.fine.weight.requires_grad


def learned_by(folder, out, **changes):
    """A network after two steps, and the names of what they changed."""
    torch.manual_seed(3)
    network = UMF(TINY)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    run(network, settings_for(folder, steps=2, **changes), folder, out)
    return network, {name for name, value in network.state_dict().items() if not torch.equal(value, before[name])}


def test_frozen_encoders_stay(folder, tmp_path):
    _, moved = learned_by(folder, tmp_path, freeze_encoders=True)
    fine = ("pyramid.fine", "laterals.0", "laterals.1", "voxel_encoder.fine", "up_fine")  # of the local features
    encoders = {name for name in moved if "encoder" in name}  # running statistics included
    assert encoders and not [name for name in encoders if not any(part in name for part in fine)]
    assert "fusion.image_head.weight" in moved


def test_fixed_statistics_stay_while_the_encoders_learn(folder, tmp_path):
    _, moved = learned_by(folder, tmp_path, fixed_statistics=True)
    assert not [name for name in moved if "running" in name or "placed" in name]
    assert {"image_encoder", "voxel_encoder"} <= {name.split(".")[0] for name in moved}


@pytest.mark.parametrize(("branch", "other"), [("image", "voxel_encoder"), ("cloud", "image_encoder")])
def test_one_branch_learns_and_leaves_the_other_as_it_was(folder, tmp_path, branch, other):
    network, moved = learned_by(folder, tmp_path, branch=branch, local_pairs=0)
    assert f"fusion.{branch}_head.weight" in moved and f"fusion.layers.0.{branch}_self.attention.query.weight" in moved
    assert not [name for name in moved if other in name or "cross" in name or "absent" in name or "local" in name]
    idle = [n for n, p in network.named_parameters() if p.requires_grad and p.grad is None]
    assert idle == []


def test_neighbours_are_drawn_from_whole_worlds(folder, tmp_path):
    """Every row finds its place in the other pass, and a nearer and a farther one."""
    settings = settings_for(folder, loss="neighbourhood", local_pairs=0, batch=24, steps=2, modality_dropout=0.0)
    losses = []
    run(UMF(TINY), settings, folder, tmp_path, lambda progress: losses.append(progress.losses))
    assert all(found[name] > 0.1 for found in losses for name in ("fused", "image", "cloud", "graded"))


def test_a_run_leaves_weights_card_log_and_settings(folder, tmp_path):
    settings = settings_for(folder, validation=str(folder), validate_epochs=1)
    path = train(settings, tmp_path / "run", resume=False, report=silent)
    assert load_weights(path).config == TINY
    card = read_card(path)
    assert card["training_worlds"] == ["world_00001", "world_00002"]
    assert card["settings"]["train"] == "worlds"
    assert 0 <= card["validation"]["world_00001"]["fused"]["recall1"] <= 1
    rows = list(csv.DictReader((tmp_path / "run" / "log.csv").open()))
    assert [row["step"] for row in rows] == ["2", "4"]
    assert float(rows[0]["recall1_fused"]) >= 0
    assert load_run(tmp_path / "run" / "training.yaml") == settings
    json.dumps(card, allow_nan=False)


def test_a_run_repeats_itself_and_resumes_as_if_never_stopped(folder, tmp_path):
    whole = train(settings_for(folder), tmp_path / "whole", False, silent)
    again = train(settings_for(folder), tmp_path / "again", False, silent)
    torch.testing.assert_close(weights_of(whole), weights_of(again))

    class StoppedError(Exception):
        pass

    def stop(progress):
        if progress.step == 3:
            raise StoppedError

    with pytest.raises(StoppedError):
        train(settings_for(folder), tmp_path / "halves", False, stop)
    halves = train(settings_for(folder), tmp_path / "halves", True, silent)
    torch.testing.assert_close(weights_of(whole), weights_of(halves))
    other = train(settings_for(folder, seed=1), tmp_path / "other", False, silent)
    assert not torch.allclose(weights_of(whole), weights_of(other))


AHEAD = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from tiny_worlds import TINY
from umf_ros.lab.training.networks import PRESETS
from umf_ros.lab.training.trainer import load_run, train
PRESETS["tiny"] = TINY
for workers in (0, 3):
    small = dict(preset="tiny", steps=4, epoch_steps=2, batch=8, local_pairs=2, bank_from_step=2, warmup_steps=1)
    settings = load_run(None, train=sys.argv[2], workers=workers, **small)
    train(settings, Path(sys.argv[3]) / str(workers), False, lambda progress: None)
"""


def test_batches_made_by_other_processes_are_the_same(folder, tmp_path):
    command = [sys.executable, "-c", AHEAD, str(Path(__file__).parents[2]), str(folder), str(tmp_path / "runs")]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    here, ahead = (weights_of(tmp_path / "runs" / workers / "tiny.safetensors") for workers in "03")
    torch.testing.assert_close(here, ahead, rtol=0, atol=0)
    assert "Sparse" not in said.stderr  # no warning of torch's own


def test_training_lowers_the_loss(world, folder, tmp_path):
    """Of a batch that is the same before and after: those on the way are not equally hard."""
    torch.manual_seed(0)
    network = UMF(TINY)
    settings = settings_for(folder, steps=120, weight_local=0, weight_super=0, local_pairs=0, bank=0)
    objective, batch = MetricObjective(network, settings, list), batch_of(world)

    def loss():
        with torch.no_grad():
            return objective.train()(batch)["fused"].item()

    before = loss()
    run(network, settings, folder, tmp_path)
    assert loss() < 0.9 * before


def test_batches_grow_while_triplets_sleep(folder, tmp_path):
    torch.manual_seed(0)
    settings = settings_for(folder, loss="triplet", active_share=1.0, batch_limit=10, steps=4)
    objective = MetricObjective(UMF(TINY), settings, list)
    sizes = []
    for active in (1.0, 0.99, 0.0):
        objective.finish_epoch({"active": active})
        sizes.append(objective.batch_size)
    assert sizes == [8, 10, 10]
    batch = objective.batch_maker(WorldFolder(folder).refresh(), 0)(0)
    assert len(batch.input.image) == 10
    calm = MetricObjective(UMF(TINY), settings_for(folder), list)
    calm.finish_epoch({"active": 0.0})
    assert calm.batch_size == 8


def test_early_stopping(folder, tmp_path):
    settings = settings_for(folder, validation=str(folder), validate_epochs=1, patience=1, steps=40, learning_rate=1e-9)
    steps = []
    train(settings, tmp_path / "run", False, lambda progress: steps.append(progress.step))
    assert len(steps) < 40


def test_weights_of_another_image_size_can_start_a_run(folder, tmp_path):
    first = train(settings_for(folder, steps=2), tmp_path / "a", False, silent)
    second = train(settings_for(folder, steps=2, start=str(first), image_size=(32, 64)), tmp_path / "b", False, silent)
    assert load_weights(second).config == replace(TINY, image_size=(32, 64))
    with pytest.raises(ConfigError, match="is not a umf_light"):
        train(settings_for(folder, preset="umf_light", start=str(first)), tmp_path / "c", False, silent)


def test_validation_of_a_perfect_world(world):
    found = validate(UMF(TINY), [world])[world.name]
    # the passes of this world show the same images and scans
    assert found["fused"].recall1 == found["image"].recall1 == found["cloud"].recall1 == 1


def test_wrong_settings_and_missing_data(folder, tmp_path):
    with pytest.raises(ConfigError, match="learning_rate"):
        load_run(None, train="x", learning_rate=-1)
    with pytest.raises(ConfigError, match="unknown parameter teh_steps"):
        load_run(None, train="x", teh_steps=1)
    with pytest.raises(ConfigError, match="local_pairs must be 0"):
        load_run(None, train="x", branch="image", local_pairs=4)
    with pytest.raises(ConfigError, match="unknown network"):
        train(settings_for(folder, preset="umf_giant"), tmp_path / "run", False, silent)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="no worlds"):
        train(settings_for(tmp_path / "empty"), tmp_path / "run", False, silent)
    with pytest.raises(WeightsError, match="resume"):
        train(settings_for(folder), tmp_path / "fresh", True, silent)


def test_what_is_the_same_place_depends_on_the_data_set(folder):
    kinds = [rule_of(settings_for(folder, **one)) for one in ({}, {"rule": "robotcar"}, {"loss": "neighbourhood"})]
    thesis, robotcar, whole = kinds
    assert (thesis.positive_m, thesis.positive_deg, thesis.between_passes) == (12, 30, False)
    assert (robotcar.positive_m, robotcar.positive_deg, robotcar.negative_m) == (10, 180, 50)
    assert (whole.positive_m, whole.negative_m, whole.negative_deg, whole.between_passes) == (12, 14, 35, True)


def test_a_list_of_sequences_trains_and_is_named_in_the_card(folder, tmp_path):
    (tmp_path / "data.yaml").write_text(f"- worlds: {folder}\n")
    settings = settings_for(tmp_path / "data.yaml", validation=str(tmp_path / "data.yaml"), steps=1, validate_epochs=1)
    path = train(settings, tmp_path / "run", resume=False, report=silent)
    card = read_card(path)
    assert card["training_worlds"] == ["world_00001", "world_00002"] and set(card["validation"]) == {
        *card["training_worlds"]
    }
    with pytest.raises(UmfError, match="nowhere"):
        train(settings_for(tmp_path / "nowhere.yaml", steps=1), tmp_path / "b", resume=False, report=silent)
