"""A new way of training is one file."""

from __future__ import annotations

import csv
import re

import pytest

from umf_ros.core.errors import ConfigError
from umf_ros.lab import training
from umf_ros.lab.training.networks import read_card
from umf_ros.lab.training.objective import OBJECTIVES, generator
from umf_ros.lab.training.trainer import load_run, train

NEW = """
from dataclasses import dataclass
from typing import Literal

import torch
from pydantic import Field

from umf_ros.lab.training.objective import Judgement, Objective, generator
from umf_ros.lab.training.networks import RunSettings


@dataclass
class Wish:
    value: torch.Tensor

    def to(self, device):
        return Wish(self.value.to(device))


class ExponentSettings(RunSettings):
    weights_suffix = "_exponent"
    method: Literal["exponent"] = "exponent"
    goal: float = Field(4.0, description="exponent of the pooling")


class ExponentObjective(Objective):
    settings_type = ExponentSettings

    def __init__(self, network, settings):
        super().__init__(network, settings)
        network.requires_grad_(False)
        network.fusion.image_pool.requires_grad_(True)
        self.goal, self.seed = settings.goal, settings.seed

    def batch_maker(self, sequences, rank):
        return lambda step: Wish(torch.tensor(self.goal + 0.01 * generator(self.seed, step, rank).normal()))

    def forward(self, batch):
        return {"total": (self.network.fusion.image_pool.exponent - batch.value).square()}

    def judge(self, step):
        return Judgement(stop=step >= 4, figures={"exponent": self.network.fusion.image_pool.exponent.item()})

    def card(self):
        return {"goal": self.goal}
"""


def test_a_new_way_of_training_is_one_file_and_one_line(folder, tmp_path, monkeypatch):
    (tmp_path / "exponent_objective.py").write_text(NEW)
    monkeypatch.setattr(training, "__path__", [*training.__path__, str(tmp_path)])
    kind = re.search(r"class (\w+)\(Objective\)", NEW)[1]
    monkeypatch.setitem(OBJECTIVES, "exponent", ("exponent_objective", kind))
    config = tmp_path / "run.yaml"
    config.write_text("method: exponent\npreset: tiny\nsteps: 9\nepoch_steps: 2\nlearning_rate: 0.1\ngoal: 3.5\n")
    weights = train(load_run(config, train=str(folder)), tmp_path / "run", False, lambda progress: None)
    assert weights.name == "tiny_exponent.safetensors" and read_card(weights)["goal"] == 3.5
    rows = list(csv.DictReader((tmp_path / "run" / "log.csv").open()))
    assert [row["step"] for row in rows] == ["2", "4"]  # it wanted no more
    assert 3 < float(rows[0]["exponent"]) < float(rows[1]["exponent"]) <= 3.6
    assert float(rows[1]["total"]) < float(rows[0]["total"])
    with pytest.raises(ConfigError, match="goal: "):
        load_run(config, train=str(folder), goal="far")


def test_draws_follow_from_seed_step_rank_and_purpose():
    first = generator(3, 5).random()
    assert first == generator(3, 5, 0, 0).random()
    others = [generator(4, 5), generator(3, 6), generator(3, 5, rank=1), generator(3, 5, purpose=1)]
    assert len({first, *(other.random() for other in others)}) == 5
