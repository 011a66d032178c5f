from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_worlds import TINY, flat_sample, world_arrays, write_world

from umf_ros.core.errors import ConfigError, WeightsError
from umf_ros.lab.datasets.simulated import WorldFolder
from umf_ros.lab.training.masked_objectives import MaskedImagesObjective
from umf_ros.lab.training.networks import read_card
from umf_ros.lab.training.objective import Progress, find_objective
from umf_ros.lab.training.trainer import Team, Trainer, load_run, train
from umf_ros.networks.umf import UMF
from umf_ros.networks.weights import load_weights


@pytest.fixture
def worlds(tmp_path: Path) -> Path:
    (tmp_path / "worlds").mkdir()
    write_world(tmp_path / "worlds" / "world_00001.npz", 3, count=12)
    return tmp_path / "worlds"


QUICK = {"batch": 4, "threads": 1, "decoder_width": 16, "half": False}
CPU = Team(0, 1, torch.device("cpu"))
METHODS = ("masked_images", "masked_scans")


def ignore(*_: object) -> None:
    pass


def trainer(worlds: Path, folder: Path, method: str, **chosen: object) -> tuple[UMF, Trainer]:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    folder.mkdir(exist_ok=True)
    settings = load_run(None, method=method, train=str(worlds), **(QUICK | chosen))
    network = UMF(TINY).train()
    objective = find_objective(method)(network, settings)
    return network, Trainer(objective, WorldFolder(worlds).refresh, settings, folder, CPU)


@pytest.mark.parametrize(("method", "share"), [("masked_images", 0.97), ("masked_scans", 0.8)])
def test_the_loss_falls(worlds: Path, tmp_path: Path, method: str, share: float) -> None:
    chosen = {"steps": 60, "epoch_steps": 15, "warmup_steps": 5, "learning_rate": 5e-3}
    network, run = trainer(worlds, tmp_path / "run", method, **chosen)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    run.run(ignore, ignore)
    with (tmp_path / "run" / "log.csv").open() as stream:
        losses = [float(row["total"]) for row in csv.DictReader(stream)]
    assert len(losses) == 4 and losses[-1] < share * losses[0]
    trained = "image_encoder.backbone" if method == "masked_images" else "voxel_encoder.stem"
    other = "voxel_encoder" if method == "masked_images" else "image_encoder"
    after = network.state_dict()
    assert any(not torch.equal(before[name], after[name]) for name in before if name.startswith(trained))
    assert all(torch.equal(before[name], after[name]) for name in before if name.startswith(other))


@pytest.mark.parametrize("method", METHODS)
def test_a_resumed_run_repeats_an_uninterrupted_one(worlds: Path, tmp_path: Path, method: str) -> None:
    chosen = {"steps": 6, "epoch_steps": 3}
    whole, run = trainer(worlds, tmp_path / "whole", method, **chosen)
    run.run(ignore, ignore)

    def stop(progress: Progress) -> None:
        if progress.step == 5:
            raise KeyboardInterrupt

    _, first = trainer(worlds, tmp_path / "parts", method, **chosen)
    with pytest.raises(KeyboardInterrupt):
        first.run(stop, ignore)
    second, rest = trainer(worlds, tmp_path / "parts", method, **chosen)
    rest.resume()
    assert rest.progress.step == 3
    rest.run(ignore, ignore)
    assert all(torch.equal(value, second.state_dict()[name]) for name, value in whole.state_dict().items())


@pytest.mark.parametrize("method", METHODS)
def test_reconstructions_are_drawn(worlds: Path, tmp_path: Path, method: str) -> None:
    _, run = trainer(worlds, tmp_path, method, steps=2, epoch_steps=1)
    run.run(ignore, ignore)
    for step in (1, 2):
        picture = cv2.imread(str(tmp_path / f"reconstructions_{step:06d}.png"), cv2.IMREAD_GRAYSCALE)
        assert picture is not None and picture.std() > 10


def test_image_then_lidar_gives_weights_with_both(worlds: Path, tmp_path: Path) -> None:
    small = {"preset": "tiny", "train": str(worlds), "steps": 1, "batch": 2}
    first = train(load_run(None, method="masked_images", seed=4, **small), tmp_path / "image", False, ignore)
    settings = load_run(None, method="masked_scans", seed=5, start=str(first), **small)
    second = train(settings, tmp_path / "lidar", False, ignore)
    assert (first.name, second.name) == ("tiny_image.safetensors", "tiny_lidar.safetensors")
    before, after = (load_weights(path).state_dict() for path in (first, second))
    kept = [name for name in before if name.startswith("image_encoder")]
    assert kept and all(torch.equal(before[name], after[name]) for name in kept)
    assert not torch.equal(before["voxel_encoder.stem.0.0.weight"], after["voxel_encoder.stem.0.0.weight"])
    card = read_card(second)
    assert card["settings"]["start"] == first.name and card["training_worlds"] == ["world_00001"]
    assert [run["settings"]["method"] for run in card["earlier_runs"]] == ["masked_images"]
    assert load_run(tmp_path / "lidar" / "training.yaml") == settings  # its method is in the file


def test_two_processes_would_wait_for_no_gradient(worlds: Path, tmp_path: Path) -> None:
    for method in METHODS:
        _, run = trainer(worlds, tmp_path / method, method, steps=1)
        run.run(ignore, ignore)
        named = find_objective(method)(UMF(TINY), load_run(None, method=method, train="")).named_parameters()
        wanted = {name for name, parameter in named if parameter.requires_grad}
        learned = {name for name, value in run._objective.named_parameters() if value.grad is not None}
        assert learned == wanted and any(name.startswith("network.") for name in learned)


def test_what_cannot_be_is_said_in_one_line(worlds: Path, tmp_path: Path) -> None:
    def settings(method: str, **chosen: object):
        return load_run(None, **({"method": method, "train": str(worlds), "preset": "tiny"} | chosen))

    with pytest.raises(ConfigError, match="mask_ratio"):
        settings("masked_images", mask_ratio=1.5)
    with pytest.raises(ConfigError, match="unknown parameter mask_ratio"):
        settings("masked_scans", mask_ratio=0.5)
    with pytest.raises(ConfigError, match="ring_ratios"):
        settings("masked_scans", ring_ratios=(0.2, 0.5, 0.7))
    with pytest.raises(ConfigError, match="unknown method 'telepathy'; known: adafusion, masked_images, "):
        settings("telepathy")
    with pytest.raises(ConfigError, match="unknown network alexnet"):
        train(settings("masked_images", preset="alexnet"), tmp_path, False, ignore)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="no worlds"):
        train(settings("masked_images", train=str(tmp_path / "empty")), tmp_path, False, ignore)
    with pytest.raises(WeightsError, match="cannot resume"):
        train(settings("masked_images", steps=1), tmp_path / "new", True, ignore)


def test_data_without_images_is_refused(tmp_path: Path) -> None:
    class Blind:
        name = place = "dark"
        setting = "hard"
        world_T_body = world_arrays(2)["world_T_body"]
        pass_index = np.zeros(2, int)

        def __len__(self) -> int:
            return 2

        def sample(self, index: int):
            return replace(flat_sample(np.eye(4)), image=None)

    settings = load_run(None, method="masked_images", train="", steps=1, **QUICK)
    run = Trainer(MaskedImagesObjective(UMF(TINY), settings), lambda: [Blind()], settings, tmp_path, CPU)
    with pytest.raises(ConfigError, match="has what masked_images needs"):
        run.run(ignore, ignore)
