from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_worlds import TINY, world_arrays

from umf_ros.errors import ConfigError, WeightsError
from umf_ros.lab.datasets.simulated import WorldFolder
from umf_ros.lab.training.pretraining.pretrainer import Pretrainer, Progress
from umf_ros.lab.training.pretraining.run import pretrain
from umf_ros.lab.training.pretraining.settings import PretrainingSettings, make_settings
from umf_ros.networks.umf import UMF
from umf_ros.networks.weights import load_weights, read_card

QUICK = {"batch": 4, "threads": 1, "decoder_width": 16, "half": False}


def trainer(worlds: Path, folder: Path, modality: str, **chosen: object) -> tuple[UMF, Pretrainer]:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    folder.mkdir(exist_ok=True)
    settings = PretrainingSettings(modality=modality, data=str(worlds), **(QUICK | chosen))
    network = UMF(TINY).train()
    return network, Pretrainer(network, settings, WorldFolder(worlds).refresh, folder, torch.device("cpu"))


@pytest.mark.parametrize(("modality", "share"), [("image", 0.97), ("lidar", 0.8)])
def test_the_loss_falls(worlds: Path, tmp_path: Path, modality: str, share: float) -> None:
    chosen = {"steps": 60, "epoch_steps": 15, "warmup_steps": 5, "learning_rate": 5e-3}
    network, run = trainer(worlds, tmp_path / "run", modality, **chosen)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    run.run(lambda progress: None)
    with (tmp_path / "run" / "log.csv").open() as stream:
        losses = [float(row["loss"]) for row in csv.DictReader(stream)]
    assert len(losses) == 4 and losses[-1] < share * losses[0]
    trained = "image_encoder.backbone" if modality == "image" else "voxel_encoder.stem"
    other = "voxel_encoder" if modality == "image" else "image_encoder"
    after = network.state_dict()
    assert any(not torch.equal(before[name], after[name]) for name in before if name.startswith(trained))
    assert all(torch.equal(before[name], after[name]) for name in before if name.startswith(other))


@pytest.mark.parametrize("modality", ["image", "lidar"])
def test_a_resumed_run_repeats_an_uninterrupted_one(worlds: Path, tmp_path: Path, modality: str) -> None:
    chosen = {"steps": 6, "epoch_steps": 3}
    whole, run = trainer(worlds, tmp_path / "whole", modality, **chosen)
    run.run(lambda progress: None)

    def stop(progress: Progress) -> None:
        if progress.step == 5:
            raise KeyboardInterrupt

    _, first = trainer(worlds, tmp_path / "parts", modality, **chosen)
    with pytest.raises(KeyboardInterrupt):
        first.run(stop)
    second, rest = trainer(worlds, tmp_path / "parts", modality, **chosen)
    rest.resume()
    assert rest.progress.step == 3
    rest.run(lambda progress: None)
    assert all(torch.equal(value, second.state_dict()[name]) for name, value in whole.state_dict().items())


@pytest.mark.parametrize("modality", ["image", "lidar"])
def test_reconstructions_are_drawn(worlds: Path, tmp_path: Path, modality: str) -> None:
    _, run = trainer(worlds, tmp_path, modality, steps=2, epoch_steps=1)
    run.run(lambda progress: None)
    for step in (1, 2):
        picture = cv2.imread(str(tmp_path / f"reconstructions_{step:06d}.png"), cv2.IMREAD_GRAYSCALE)
        assert picture is not None and picture.std() > 10


def test_image_then_lidar_gives_weights_with_both(worlds: Path, tmp_path: Path) -> None:
    settings = make_settings("image", worlds, steps=1, batch=2, seed=4)
    first = pretrain(settings, tmp_path / "image", False, lambda progress: None)
    settings = make_settings("lidar", worlds, steps=1, batch=2, seed=5, start=str(first))
    second = pretrain(settings, tmp_path / "lidar", False, lambda progress: None)
    before, after = (load_weights(path).state_dict() for path in (first, second))
    kept = [name for name in before if name.startswith("image_encoder")]
    assert kept and all(torch.equal(before[name], after[name]) for name in kept)
    assert not torch.equal(before["voxel_encoder.stem.0.0.weight"], after["voxel_encoder.stem.0.0.weight"])
    card = read_card(second)
    assert card["settings"]["start"] == str(first) and card["training_worlds"] == ["hills"]


def test_what_cannot_be_is_said_in_one_line(worlds: Path, tmp_path: Path) -> None:
    def ignore(progress: Progress) -> None:
        pass

    with pytest.raises(ConfigError, match="mask_ratio"):
        make_settings("image", worlds, mask_ratio=1.5)
    with pytest.raises(ConfigError, match="ring_ratios"):
        make_settings("lidar", worlds, ring_ratios=(0.2, 0.5, 0.7))
    with pytest.raises(ConfigError, match="unknown network alexnet"):
        pretrain(make_settings("image", worlds, preset="alexnet"), tmp_path, False, ignore)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="no worlds"):
        pretrain(make_settings("image", tmp_path / "empty"), tmp_path, False, ignore)
    with pytest.raises(WeightsError, match="cannot resume"):
        pretrain(make_settings("image", worlds, steps=1), tmp_path / "new", True, ignore)


def test_data_without_images_is_refused(tmp_path: Path) -> None:
    class Blind:
        name = place = "dark"
        setting = "hard"
        world_T_body = world_arrays(2)["world_T_body"]
        pass_index = np.zeros(2, int)

        def __len__(self) -> int:
            return 2

        def sample(self, index: int):
            from umf_ros.frames import StereoCamera
            from umf_ros.lab.datasets.sample import Sample

            camera = StereoCamera(688, 512, 580, 580, 342, 256, 0)
            return Sample(None, np.zeros((50, 3), np.float32), None, np.eye(4), camera, np.eye(4))

    settings = PretrainingSettings(modality="image", data="", steps=1, **QUICK)
    run = Pretrainer(UMF(TINY), settings, lambda: [Blind()], tmp_path, torch.device("cpu"))
    with pytest.raises(ConfigError, match="image pretraining"):
        run.run(lambda progress: None)
